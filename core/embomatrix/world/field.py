"""Strict reading of decoded JSON: every value knows its path, so that an error can name the field.

A scene is ten thousand values. So a field is little more than the value and where it hangs: its path is put into words
when something is wrong, and lists of numbers are checked at once.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NoReturn, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterator
    from enum import StrEnum

    from embomatrix.world.geometry import Vec2, Vec3
    from embomatrix.world.tables import Tables

    E = TypeVar("E", bound=StrEnum)

MAX_NAME: Final = 200
FORBIDDEN: Final = frozenset("/\\")


class SceneInvalidError(ValueError):
    """Data of a scene, an asset, a task or a pose cache breaks a rule. ``field`` is the path of the value."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(f"{field}: {message}")
        self.field = field


class Field:
    """One JSON value and where it stands. ``tables`` are those that rows in the value refer to, if there are any."""

    __slots__ = ("_parent", "_step", "tables", "value")

    def __init__(
        self,
        value: object,
        path: str | int | tuple[str],
        parent: Field | None = None,
        tables: Tables | None = None,
    ) -> None:
        """``path`` is the whole path without a parent; below one it is a key, an index or, as a tuple, a free key."""
        self.value = value
        self.tables = tables
        self._parent = parent
        self._step = path

    @property
    def path(self) -> str:
        if self._parent is None:
            return str(self._step)
        match self._step:
            case str():
                return f"{self._parent.path}.{self._step}"
            case int():
                return f"{self._parent.path}[{self._step}]"
            case (key,):
                return f"{self._parent.path}[{key!r}]"

    def fail(self, message: str) -> NoReturn:
        raise SceneInvalidError(self.path, message)

    def record(self, *keys: str, optional: tuple[str, ...] = ()) -> dict[str, Field]:
        """An object with exactly these keys; those in ``optional`` may be missing."""
        value = self.value
        if not isinstance(value, dict):
            self.fail(f"expected an object with {', '.join(keys)}, found {_kind(value)}")
        for key in keys:
            if key not in value:
                self.fail(f"lacks {key!r}: expected {', '.join(keys)}")
        if len(value) > len(keys):
            unknown = sorted(value.keys() - {*keys, *optional})
            if unknown:
                self.fail(f"unknown key {unknown[0][:60]!r}: expected {', '.join((*keys, *optional))}")
        tables = self.tables
        return {key: Field(item, key, self, tables) for key, item in value.items()}

    def entries(self) -> Iterator[tuple[str, Field]]:
        """Keys and values of an object with free keys, in their order."""
        if not isinstance(self.value, dict):
            self.fail(f"expected an object, found {_kind(self.value)}")
        for key, item in self.value.items():
            yield key, Field(item, (key,), self, self.tables)

    def items(self, *, at_most: int = 100_000) -> list[Field]:
        value = self.value
        if not isinstance(value, list):
            self.fail(f"expected a list, found {_kind(value)}")
        if len(value) > at_most:
            self.fail(f"has {len(value)} items: expected at most {at_most}")
        tables = self.tables
        return [Field(item, index, self, tables) for index, item in enumerate(value)]

    def text(self) -> str:
        value = self.value
        if not isinstance(value, str):
            self.fail(f"expected text, found {_kind(value)}")
        return value

    def name(self) -> str:
        """Text that is not empty, not long, and no path: a name never leads to a file."""
        text = self.text()
        if not text:
            self.fail("is empty: expected a name")
        if len(text) > MAX_NAME or not text.isprintable() or not FORBIDDEN.isdisjoint(text):
            self.fail(
                f"found {text[:60]!r}: expected a name of at most {MAX_NAME} printable characters without a slash"
            )
        return text

    def texts(self) -> tuple[str, ...]:
        value = self.value
        if isinstance(value, list) and set(map(type, value)) <= _TEXTS:
            return tuple(value)  # the usual case, without a Field for each text
        return tuple(item.text() for item in self.items())

    def flag(self) -> bool:
        if not isinstance(self.value, bool):
            self.fail(f"expected true or false, found {_kind(self.value)}")
        return self.value

    def integer(self) -> int:
        if isinstance(self.value, bool) or not isinstance(self.value, int):
            self.fail(f"expected a whole number, found {_kind(self.value)}")
        return self.value

    def number(self) -> float:
        """A finite number."""
        value = self.value
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.fail(f"expected a number, found {_kind(value)}")
        if not abs(value) < math.inf:
            self.fail(f"expected a finite number, found {value}")
        try:
            return float(value)
        except OverflowError:
            self.fail("expected a finite number, found a whole one of more than 300 digits")

    def numbers(self, count: int) -> tuple[float, ...]:
        value = self.value
        if not isinstance(value, list) or len(value) != count:
            found = f"{len(value)} items" if isinstance(value, list) else _kind(value)
            self.fail(f"expected a list of {count} numbers, found {found}")
        if set(map(type, value)) == _FLOATS and math.isfinite(sum(value)):
            return tuple(value)  # the usual case, without a Field for each number
        return tuple(item.number() for item in self.items())

    def vec2(self) -> Vec2:
        x, y = self.numbers(2)
        return (x, y)

    def vec3(self) -> Vec3:
        x, y, z = self.numbers(3)
        return (x, y, z)

    def member(self, kind: type[E]) -> E:
        """A member of a closed set, by its value."""
        try:
            return kind(self.text())
        except ValueError:
            self.fail(f"found {self.text()[:60]!r}: expected one of {', '.join(kind)}")


_FLOATS: Final = {float}
_TEXTS: Final = {str}


def _kind(value: object) -> str:
    return "nothing" if value is None else type(value).__name__
