"""Text of other machines, made safe for terminals and log files."""

import json
import re
from typing import Final

_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters, line separators, marks that reverse the reading order, and halves of surrogate pairs."""
_CONTROL_WITHIN_LINES: Final = re.compile(rf"(?![\n\t]){_CONTROL.pattern}")


def printable(text: str, *, lines: bool = False) -> str:
    """Return the text with control characters written as JSON's escapes, such as ``\\u001b``.

    ``lines`` keeps newlines and tabs. JSON stays JSON.
    """
    return (_CONTROL_WITHIN_LINES if lines else _CONTROL).sub(_escape, text)


def _escape(found: re.Match[str]) -> str:
    return json.dumps(found[0])[1:-1]
