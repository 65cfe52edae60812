"""Decoder under test: a function that turns foreign bytes into values, the errors that it may raise, and its inputs."""

from __future__ import annotations

import contextlib
import functools
import json
import random
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

MOST_S: Final = 5.0
"""CPU seconds that one input of at most 64 kB may take. A sound decoder needs milliseconds."""

Mutate = Callable[[bytes, random.Random], bytes]


class SlowError(AssertionError):
    """One input took more CPU time than ``MOST_S``."""


@dataclass(frozen=True)
class Decoder:
    """Decoder and its inputs. ``decode`` also does with the value what the program does next, such as encoding it again.

    ``reads`` names the functions with a parsing call that ``seeds`` reach, as ``module:qualified name``.
    """

    decode: Callable[[bytes], object]
    errors: tuple[type[BaseException], ...]
    seeds: Callable[[], Sequence[bytes]]
    reads: frozenset[str]
    mutate: Mutate
    most_s: float = MOST_S

    def check(self, data: bytes) -> type[BaseException] | None:
        """Decode the input; return the type of a documented error. Other errors are raised, and SlowError for slow inputs."""
        began_s = time.process_time()
        found: type[BaseException] | None = None
        try:
            self.decode(data)
        except self.errors as error:
            found = type(error)
        spent_s = time.process_time() - began_s
        if spent_s > self.most_s:
            raise SlowError(
                f"{len(data)} bytes took {spent_s:.1f} s of CPU time: expected at most {self.most_s:g} s"
            )
        return found


@functools.cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
    return tempfile.TemporaryDirectory(prefix="embomatrix-fuzz-", dir=memory)


def in_file(name: str, data: bytes) -> Path:
    """Write the bytes into a file of this name in a folder that the process keeps, and return its path."""
    path = Path(_folder().name, name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def text_of(data: bytes) -> str:
    """Return the bytes as text. Bytes that are not UTF-8 become lone surrogates, as JSON escapes can."""
    return data.decode("utf-8", "surrogateescape")


ODD: Final = (
    None, True, False, 0, -1, 1, 255, 2**31, 2**63, -(2**63) - 1, 10**400, 0.5, -0.0, 1e308, float("inf"), float("nan"),
    "", " ", "a", "\ud800", "\x00", "a\nb", "\x1b[2J", "../x", "é" * 300, "9" * 5_000, [], {}, [[]], {"": {}},
)  # fmt: skip
"""Values that break careless readers of JSON."""
DEEP: Final = 2_000
WORDS: Final = (
    b"[" * DEEP,
    b'{"a":' * DEEP,
    b"(" * DEEP,
    b"\x00",
    b"\xff\xfe",
    b"\r\n",
    b"NaN",
    b"1e999",
    b"-",
    b'"\\ud800"',
)


def mutate_bytes(data: bytes, rng: random.Random) -> bytes:
    """Return the bytes with a few of them changed, dropped, repeated or inserted."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randint(0, len(changed))
        end = min(len(changed), at + rng.choice((1, 1, 2, 4, 16, 64)))
        match rng.randrange(5):
            case 0:
                changed[at:end] = rng.randbytes(end - at)
            case 1:
                del changed[at:end]
            case 2:
                changed[at:at] = changed[at:end]
            case 3:
                changed[at:at] = rng.choice(WORDS) if rng.random() < 0.2 else rng.randbytes(rng.randint(1, 8))
            case _:
                del changed[at:]
    return bytes(changed)


def mutate_json(data: bytes, rng: random.Random) -> bytes:
    """Return JSON text with one value replaced, dropped, repeated or renamed, or now and then damaged text."""
    if rng.random() < 0.2:
        return mutate_bytes(data, rng)
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return mutate_bytes(data, rng)
    return json.dumps(mutated(value, rng)).encode("utf-8", "surrogatepass")


def mutate_json_lines(data: bytes, rng: random.Random) -> bytes:
    """Apply ``mutate_json`` to one line."""
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    lines[at] = mutate_json(lines[at], rng)
    return b"\n".join(lines)


def mutated(value: object, rng: random.Random) -> object:
    """Return a JSON value with a change at a random place."""
    if isinstance(value, dict) and value and rng.random() < 0.85:
        key = rng.choice(list(value))
        return _mutated_dict(value, key, rng)
    if isinstance(value, list) and value and rng.random() < 0.85:
        return _mutated_list(value, rng.randrange(len(value)), rng)
    if isinstance(value, str) and value and rng.random() < 0.5:
        return mutate_bytes(value.encode("utf-8", "surrogatepass"), rng).decode("utf-8", "surrogateescape")
    if isinstance(value, int | float) and rng.random() < 0.5:
        with contextlib.suppress(OverflowError, ValueError):
            return value * rng.choice((-1, 2, 10, 0.1, 1e6)) + rng.choice((0, 1, -1))
    return rng.choice(ODD)


def _mutated_dict(value: Mapping[str, object], key: str, rng: random.Random) -> object:
    match rng.randrange(10):
        case 0:
            return {name: inner for name, inner in value.items() if name != key}
        case 1:
            return {**value, rng.choice(("", "a", "\ud800", "__class__", key + "_")): value[key]}
        case 2:
            return {**value, key: value[rng.choice(list(value))]}
        case _:
            return {**value, key: mutated(value[key], rng)}


def _mutated_list(value: Sequence[object], at: int, rng: random.Random) -> object:
    match rng.randrange(10):
        case 0:
            return [*value[:at], *value[at + 1 :]]
        case 1:
            return [*value[:at], *[value[at]] * rng.choice((2, 3, 70)), *value[at + 1 :]]
        case 2:
            return [*value[:at], value[rng.randrange(len(value))], *value[at + 1 :]]
        case _:
            return [*value[:at], mutated(value[at], rng), *value[at + 1 :]]
