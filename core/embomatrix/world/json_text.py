"""JSON text of another person, machine or earlier run."""

import json
import re
from typing import Any, Final

_HALF_PAIR: Final = re.compile(r"\\u[dD][89a-fA-F]")
"""Escape of a surrogate, which may lack its other half."""


def parse_json(text: str | bytes) -> Any:
    """Return the value of JSON text in UTF-8. Raises ValueError, and no other exception, for anything else.

    The standard library raises RecursionError for deep nesting. It also accepts escaped halves of surrogate pairs, which make
    texts that no file and no message can carry.
    """
    content = text.decode("utf-8") if isinstance(text, bytes) else text
    try:
        value = json.loads(content)
        if _HALF_PAIR.search(content):
            check_characters(value)
    except RecursionError:
        raise ValueError("it is nested too deep") from None
    return value


def check_characters(value: Any) -> None:
    """Raise ValueError for half of a surrogate pair in a JSON value."""
    try:
        json.dumps(value, ensure_ascii=False).encode("utf-8")
    except UnicodeEncodeError:
        raise ValueError("it contains half of a surrogate pair, which is no character") from None
