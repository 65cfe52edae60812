"""Strict reading of decoded JSON: every value knows its path, so that an error can name the field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NoReturn, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterator
    from enum import StrEnum

    from embomatrix.world.geometry import Vec2, Vec3

    E = TypeVar("E", bound=StrEnum)


class SceneInvalidError(ValueError):
    """Data of a scene, an asset, a task or a pose cache breaks a rule. ``field`` is the path of the value."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(f"{field}: {message}")
        self.field = field


@dataclass(frozen=True, slots=True)
class Field:
    """One JSON value and where it stands."""

    value: object
    path: str

    def fail(self, message: str) -> NoReturn:
        raise SceneInvalidError(self.path, message)

    def record(self, *keys: str, optional: tuple[str, ...] = ()) -> dict[str, Field]:
        """An object with exactly these keys; those in ``optional`` may be missing."""
        if not isinstance(self.value, dict):
            self.fail(f"expected an object with {', '.join(keys)}, found {_kind(self.value)}")
        found = set(self.value)
        missing = [key for key in keys if key not in found]
        if missing:
            self.fail(f"lacks {missing[0]!r}: expected {', '.join(keys)}")
        unknown = sorted(found - {*keys, *optional})
        if unknown:
            self.fail(f"unknown key {unknown[0][:60]!r}: expected {', '.join((*keys, *optional))}")
        return {key: Field(item, f"{self.path}.{key}") for key, item in self.value.items()}

    def entries(self) -> Iterator[tuple[str, Field]]:
        """Keys and values of an object with free keys, in their order."""
        if not isinstance(self.value, dict):
            self.fail(f"expected an object, found {_kind(self.value)}")
        for key, item in self.value.items():
            yield key, Field(item, f"{self.path}[{key!r}]")

    def items(self, *, at_most: int = 100_000) -> list[Field]:
        if not isinstance(self.value, list):
            self.fail(f"expected a list, found {_kind(self.value)}")
        if len(self.value) > at_most:
            self.fail(f"has {len(self.value)} items: expected at most {at_most}")
        return [Field(item, f"{self.path}[{index}]") for index, item in enumerate(self.value)]

    def text(self) -> str:
        if not isinstance(self.value, str):
            self.fail(f"expected text, found {_kind(self.value)}")
        return self.value

    def name(self) -> str:
        """Text that is not empty."""
        text = self.text()
        if not text:
            self.fail("is empty: expected a name")
        return text

    def texts(self) -> tuple[str, ...]:
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
        return float(value)

    def numbers(self, count: int) -> tuple[float, ...]:
        if not isinstance(self.value, list) or len(self.value) != count:
            found = f"{len(self.value)} items" if isinstance(self.value, list) else _kind(self.value)
            self.fail(f"expected a list of {count} numbers, found {found}")
        if all(type(item) is float and abs(item) < math.inf for item in self.value):
            return tuple(self.value)  # the usual case, without a Field for each number
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


def _kind(value: object) -> str:
    return "nothing" if value is None else type(value).__name__
