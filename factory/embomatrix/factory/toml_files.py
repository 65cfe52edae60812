"""TOML files that people write: bounded reads, and errors that name the key, what was found and what was expected."""

import difflib
import re
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from embomatrix.world.bddl import ROOM_TYPES
from embomatrix.world.records import Record, SceneInvalidError, convert
from embomatrix.world.whole_file import read_whole

T = TypeVar("T")

_TASK: Final = "; this file is a task, for `embomatrix factory try`"
_FLOOR_PLAN: Final = "; this file is a floor plan, for `embomatrix scene build`"
_USES: Final = {"instruction": _TASK, "goal": _TASK, "rooms": _FLOOR_PLAN, "doors": _FLOOR_PLAN}
"""Commands for the kinds of files that people write, by keys that only one kind has."""


_TYPES: Final = {
    "array": "a list",
    "bool": "true or false",
    "float": "a number",
    "int": "a whole number",
    "object": "a table",
    "str": "text in quotes",
}
"""Types of TOML in words, by their names in msgspec's messages."""


class TomlFileError(ValueError):
    """File that can't be read as TOML. The message names the file and the line."""


def read_toml(path: Path, *, at_most: int, expected: str) -> dict[str, Any]:
    """Return the values of a file of at most ``at_most`` bytes; ``expected`` says in words what it should hold.

    Raises TomlFileError.
    """
    try:
        return tomllib.loads(read_whole(path, at_most=at_most).decode("utf-8"))
    except OSError as error:
        raise TomlFileError(
            f"{path} can't be read ({error.strerror}): expected {expected} in TOML"
        ) from error
    except (ValueError, RecursionError) as error:
        raise TomlFileError(f"{path} is not TOML ({error}): correct that line") from error


def record_of(value: object, kind: type[T], root: str) -> T:
    """Return the record of a file's values. Raises SceneInvalidError with the key as TOML writes it, and types in words."""
    try:
        return convert(value, kind, root)
    except SceneInvalidError as error:
        key = re.sub(r"\['([^']*)'\]", r".\1", error.field)
        raise SceneInvalidError(
            key, re.sub(r"`(\w+)`", lambda found: _TYPES.get(found[1], found[0]), error.message)
        ) from error


def check_keys(key: str, table: object, kind: type[Record], *, needed: Sequence[str] = ()) -> None:
    """Raise SceneInvalidError for a key of a table that its record does not have, and for a needed one that is missing.

    ``key`` is the path of the table, empty for the file. Values that are no tables pass: the record's decoder refuses them.
    """
    if not isinstance(table, dict):
        return
    known = ", ".join(kind.__struct_fields__)
    for name in table:
        if name not in kind.__struct_fields__:
            use = "" if key else _USES.get(name, "")
            raise wrong(key or "its top level", f"the key {name[:60]!r}", f"only {known}{use}")
    for name in needed:
        if name not in table:
            raise wrong(key or "its top level", f"no key {name!r}", f"the keys {known}")


def wrong(key: str, found: str, expected: str) -> SceneInvalidError:
    """Return the error of a key with a wrong value."""
    return SceneInvalidError(key, f"found {found}: expected {expected}")


def wrong_room(key: str, name: str, found: str, expected: str) -> SceneInvalidError:
    """Return the error of a name that is no room; ``expected`` says which names are."""
    word = name.rstrip("_0123456789")
    hint = f"write {word}_0" if word in ROOM_TYPES else close_to(word, ROOM_TYPES)
    return wrong(key, found, f"{expected}; {hint}")


def close_to(word: str, known: Iterable[str]) -> str:
    """Return the known words nearest to a misspelt one: ``did you mean kitchen?``, or a few examples."""
    names = sorted(known)
    close = difflib.get_close_matches(word, names, n=3, cutoff=0.6)
    return f"did you mean {', '.join(close)}?" if close else f"types are {', '.join(names[:6])} and others"
