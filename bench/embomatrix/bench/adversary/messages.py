"""Messages with any field values, made from the protocol's descriptors with a seeded generator."""

import math
import random
from collections.abc import Sequence
from typing import Any, Final, TypeVar

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

from embomatrix.rpc.wire.bounds import is_repeated

MessageT = TypeVar("MessageT", bound=Message)

NUMBERS: Final = (0.0, -0.0, 1.0, -1.0, 5e-324, 1e9, -1e9, 1.7e308, -1.7e308, math.nan, math.inf, -math.inf)
TEXTS: Final = (
    "",
    " ",
    "w1",
    "two lines\n2031-01-01 ERROR the manager is lost",
    "\x1b[2J\x1b[31mred",
    "[/bold]",
    "[red]markup",
    "<script>alert(1)</script>",
    "../../../etc/passwd",
    "%s %n {} {0}",
    "\u202egnp.exe",
    "\x00",
    "😀" * 40,
    "sha256:" + "0" * 64,
    "0" * 64,
)
LONG_TEXT: Final = "x" * 100_000
LONG_SHARE: Final = 0.002
"""Share of texts and lists that are long."""
KNOWN_SHARE: Final = 0.5
"""Share of texts that repeat something the attacker has seen, such as a lease id."""
LONG_LIST: Final = 300
MOST_DEPTH: Final = 4
_UNSIGNED: Final = {FieldDescriptor.CPPTYPE_UINT32: 2**32 - 1, FieldDescriptor.CPPTYPE_UINT64: 2**64 - 1}
_SIGNED: Final = {FieldDescriptor.CPPTYPE_INT32: 2**31 - 1, FieldDescriptor.CPPTYPE_INT64: 2**63 - 1}


class MessageMaker:
    """Fills messages at random. ``known`` holds texts that the attacker has seen; others may add to it."""

    def __init__(self, rng: random.Random, known: Sequence[str] = ()) -> None:
        self.rng = rng
        self.known = list(known)

    def any(self, kind: type[MessageT]) -> MessageT:
        """Return a message with random fields."""
        message = kind()
        self._fill(message, 0)
        return message

    def text(self) -> str:
        """Return a text: known, crafted, or long."""
        if self.known and self.rng.random() < KNOWN_SHARE:
            return self.rng.choice(self.known)
        return LONG_TEXT if self.rng.random() < LONG_SHARE else self.rng.choice(TEXTS)

    def number(self) -> float:
        return self.rng.choice(NUMBERS)

    def count(self, largest: int = 2**64 - 1) -> int:
        """Return an unsigned integer near a power of two or a bound."""
        return min(self.rng.choice((0, 1, 2, 255, 2**31, 2**32 - 1, 2**63, 2**64 - 1)), largest)

    def garbled(self, message: Message) -> bytes:
        """Return the bytes of a message with damaged, missing or additional ones."""
        data = bytearray(message.SerializeToString())
        for _ in range(self.rng.randint(1, 4)):
            at = self.rng.randint(0, len(data))
            match self.rng.randrange(3):
                case 0:
                    data[at : at + 1] = self.rng.randbytes(1)
                case 1:
                    del data[at:]
                case _:
                    data[at:at] = self.rng.randbytes(self.rng.randint(1, 16))
        return bytes(data)

    @staticmethod
    def _fields(message: Message) -> Sequence[Any]:
        """Return the descriptors of the fields. The stubs of protobuf lack their ``label``."""
        return message.DESCRIPTOR.fields

    def _fill(self, message: Message, depth: int) -> None:
        for field in self._fields(message):
            if self.rng.random() < 0.3 or (field.message_type and depth >= MOST_DEPTH):
                continue
            if field.message_type is not None and field.message_type.GetOptions().map_entry:
                entries = getattr(message, field.name)
                for _ in range(self._length()):
                    value = field.message_type.fields_by_name["value"]
                    entries[self.text()] = self._scalar(value)
            elif is_repeated(field):
                self._extend(getattr(message, field.name), field, depth)
            elif field.message_type is not None:
                part = getattr(message, field.name)
                part.SetInParent()
                self._fill(part, depth + 1)
            else:
                setattr(message, field.name, self._scalar(field))

    def _extend(self, values: Any, field: FieldDescriptor, depth: int) -> None:
        for _ in range(self._length()):
            if field.message_type is not None:
                self._fill(values.add(), depth + 1)
            else:
                values.append(self._scalar(field))

    def _length(self) -> int:
        return LONG_LIST if self.rng.random() < LONG_SHARE else self.rng.choice((0, 1, 1, 2, 3))

    def _scalar(self, field: FieldDescriptor) -> Any:
        kind = field.cpp_type
        if kind in _UNSIGNED:
            return self.count(_UNSIGNED[kind])
        if kind in _SIGNED:
            largest = _SIGNED[kind]
            return self.rng.choice((0, 1, -1, largest, -largest - 1, self.rng.randint(-9, 99)))
        match kind:
            case FieldDescriptor.CPPTYPE_DOUBLE | FieldDescriptor.CPPTYPE_FLOAT:
                return self.number()
            case FieldDescriptor.CPPTYPE_BOOL:
                return self.rng.random() < 0.5
            case FieldDescriptor.CPPTYPE_ENUM:
                return self.rng.choice((0, 1, 2, 3, 99, 2**31 - 1))
            case _ if field.type == FieldDescriptor.TYPE_BYTES:
                return self.rng.randbytes(self.rng.choice((0, 1, 100, 10_000)))
            case _:
                return self.text()
