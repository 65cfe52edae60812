"""TOML files that people write: bounded reads, and errors that name the key, what was found and what was expected."""

import difflib
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from embomatrix.world.records import Record, SceneInvalidError
from embomatrix.world.whole_file import read_whole


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


def check_keys(key: str, table: object, kind: type[Record], *, needed: Sequence[str] = ()) -> None:
    """Raise SceneInvalidError for a key of a table that its record does not have, and for a needed one that is missing.

    ``key`` is the path of the table, empty for the file. Values that are no tables pass: the record's decoder refuses them.
    """
    if not isinstance(table, dict):
        return
    known = ", ".join(kind.__struct_fields__)
    for name in table:
        if name not in kind.__struct_fields__:
            raise wrong(key or "its top level", f"the key {name[:60]!r}", f"only {known}")
    for name in needed:
        if name not in table:
            raise wrong(key or "its top level", f"no key {name!r}", f"the keys {known}")


def wrong(key: str, found: str, expected: str) -> SceneInvalidError:
    """Return the error of a key with a wrong value."""
    return SceneInvalidError(key, f"found {found}: expected {expected}")


def close_to(word: str, known: Iterable[str]) -> str:
    """Return the known words nearest to a misspelt one: ``did you mean kitchen?``, or a few examples."""
    names = sorted(known)
    close = difflib.get_close_matches(word, names, n=3, cutoff=0.6)
    return f"did you mean {', '.join(close)}?" if close else f"types are {', '.join(names[:6])} and others"
