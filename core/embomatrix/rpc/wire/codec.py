"""Conversion between dataclasses and protobuf messages whose fields have the same names.

A malformed message raises ConvertError, which names the field by its full path.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from enum import Enum
from typing import TYPE_CHECKING, Any, Final, TypeVar

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

if TYPE_CHECKING:
    from google.protobuf.internal.enum_type_wrapper import _EnumTypeWrapper

WireT = TypeVar("WireT")
ValueT = TypeVar("ValueT")
MessageT = TypeVar("MessageT", bound="Message")
EnumT = TypeVar("EnumT", bound=Enum)
NumberT = TypeVar("NumberT", bound=int)

KNOWN_BYTES: Final = 320
"""Largest message that a cache keeps. A sender chooses its size, by unknown fields too."""
_FLOATS: Final = (FieldDescriptor.CPPTYPE_DOUBLE, FieldDescriptor.CPPTYPE_FLOAT)


class ConvertError(ValueError):
    """A message that has no value. ``field`` is the path of the wrong field: ``rollouts[3].plan[0].yaw``."""

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field}: {problem}")
        self.field = field
        self.problem = problem

    def under(self, parent: str) -> ConvertError:
        """Return the same error with the path prefixed by the field that holds this message."""
        return ConvertError(f"{parent}.{self.field}", self.problem)


def each(
    field: str, convert: Callable[[WireT], ValueT], messages: Iterable[WireT], *, first: int = 0
) -> tuple[ValueT, ...]:
    """Convert a repeated field, or the part of it that begins at index ``first``."""
    values: list[ValueT] = []
    for index, message in enumerate(messages, start=first):
        try:
            values.append(convert(message))
        except ConvertError as error:
            raise error.under(f"{field}[{index}]") from None
    return tuple(values)


def each_known(
    field: str, known: functools._lru_cache_wrapper[ValueT], messages: Sequence[bytes]
) -> tuple[ValueT, ...]:
    """Convert serialized messages through a cache. Without an error, no Python frame runs per cached message."""
    convert: Callable[[bytes], ValueT] = known
    if max(map(len, messages), default=0) > KNOWN_BYTES:
        convert = functools.partial(through, known)
    try:
        return tuple(map(convert, messages))
    except ConvertError:
        return each(field, convert, messages)


def through(known: functools._lru_cache_wrapper[ValueT], message: bytes) -> ValueT:
    """Convert a serialized message through a cache, unless it is too large to be kept."""
    value: ValueT = known(message) if len(message) <= KNOWN_BYTES else known.__wrapped__(message)
    return value


def inside(field: str, convert: Callable[[WireT], ValueT], message: WireT) -> ValueT:
    """Convert a message field and prefix the path of an error with the field's name."""
    try:
        return convert(message)
    except ConvertError as error:
        raise error.under(field) from None


def required(field: str, text: str) -> str:
    """Return the text, or raise ConvertError if it is empty."""
    if not text:
        raise ConvertError(field, "found no value: expected one")
    return text


def finite(field: str, number: float) -> float:
    """Return the number, or raise ConvertError if it is NaN or infinite."""
    if not math.isfinite(number):
        raise ConvertError(field, f"found {number}: expected a finite number")
    return number


def within(field: str, number: float, most: float) -> float:
    """Return the number, or raise ConvertError unless it is between 0 and ``most``."""
    if not 0.0 <= number <= most:
        raise ConvertError(field, f"found {number}: expected 0 to {most:g}")
    return number


def enum_numbers(members: type[EnumT], wire: _EnumTypeWrapper[NumberT], prefix: str) -> dict[EnumT, NumberT]:
    """Return the wire number of each enum member. ``prefix`` precedes the member's name in the .proto file."""
    return {member: wire.Value(f"{prefix}_{member.name}") for member in members}


def enum_member(field: str, members: Mapping[int, EnumT], number: int) -> EnumT:
    """Return the enum member of a wire number. Raise ConvertError for an unknown number."""
    member = members.get(number)
    if member is None:
        raise ConvertError(
            field, f"found the unknown value {number}: if the sender is newer, upgrade this side"
        )
    return member


def maker(
    message_type: type[MessageT], write: Callable[[ValueT, MessageT], None]
) -> Callable[[ValueT], MessageT]:
    """Return the function that makes the message of a value. ``write`` fills an empty message."""

    def to_proto(value: ValueT) -> MessageT:
        message = message_type()
        write(value, message)
        return message

    return to_proto


def converters(
    value_type: type[ValueT],
    message_type: type[MessageT],
    *,
    required_names: Collection[str] = (),
    absent: Mapping[str, Any] | None = None,
    enums: Mapping[str, Mapping[Any, Any]] | None = None,
    parts: Mapping[str, tuple[Callable[..., Any], Callable[..., Any]]] | None = None,
) -> tuple[Callable[[ValueT], MessageT], Callable[[MessageT], ValueT]]:
    """Return the functions that convert a value to its message and back. The two have fields of the same names.

    ``required_names`` are texts that may not be empty. ``enums`` maps an enum field to its wire numbers, ``parts`` a message
    field to its own two converters, ``absent`` a field to its value when it is not set. Numbers must be finite.
    """
    absent = absent or {}
    values: Any = value_type
    names = getattr(values, "_fields", None) or [f.name for f in dataclasses.fields(values) if f.init]
    readers: dict[str, Callable[[str, Any], Any]] = dict.fromkeys(names, _plain)
    writers: dict[str, Callable[[Any], Any]] = {}
    for name in names:
        field: Any = message_type.DESCRIPTOR.fields_by_name[name]
        repeated = field.default_value == []  # protobuf 7 has no `label`, protobuf 5 no `is_repeated`
        if enums and name in enums:
            writers[name], readers[name] = _enum(enums[name])
        elif parts and name in parts:
            writers[name], readers[name] = _message(*parts[name], repeated=repeated)
        elif field.message_type is not None:
            readers[name] = _mapping
        elif repeated:
            readers[name] = _sequence
        elif field.cpp_type in _FLOATS:
            readers[name] = finite
        elif name in required_names:
            readers[name] = required

    def to_proto(value: ValueT) -> MessageT:
        fields = {name: getattr(value, name) for name in names}
        for name, write in writers.items():
            if fields[name] is not None:
                fields[name] = write(fields[name])
        return message_type(**fields)

    def from_proto(message: MessageT) -> ValueT:
        return value_type(
            **{
                name: absent[name]
                if name in absent and not _is_set(message, name)
                else read(name, getattr(message, name))
                for name, read in readers.items()
            }
        )

    return to_proto, from_proto


def _is_set(message: Message, name: str) -> bool:
    """Return whether the field has a value. A number without presence counts as unset if it is 0."""
    has_presence = message.DESCRIPTOR.fields_by_name[name].has_presence
    return message.HasField(name) if has_presence else bool(getattr(message, name))


def _plain(_: str, value: Any) -> Any:
    return value


def _sequence(_: str, values: Iterable[Any]) -> tuple[Any, ...]:
    return tuple(values)


def _mapping(_: str, values: Mapping[str, Any]) -> dict[str, Any]:
    return dict(values)


def _enum(numbers: Mapping[Any, int]) -> tuple[Callable[[Any], int], Callable[[str, int], Any]]:
    members = {number: member for member, number in numbers.items()}
    return numbers.__getitem__, lambda name, number: enum_member(name, members, number)


def _message(
    to_proto: Callable[..., Any], from_proto: Callable[..., Any], *, repeated: bool
) -> tuple[Callable[[Any], Any], Callable[[str, Any], Any]]:
    if repeated:
        return lambda values: list(map(to_proto, values)), lambda name, found: each(name, from_proto, found)
    return to_proto, lambda name, found: inside(name, from_proto, found)
