"""Sanitising of model texts for EAI's judge, whose parser calls ``eval`` on them."""

import ast
import json
import re
from collections.abc import Iterator
from typing import Any, Final

MAX_CHARS: Final = 64 * 1024
MAX_STARTS: Final = 256
"""Maximum brackets at which a list is looked for: bounds the work on adversarial text."""
_FORBIDDEN_CHARACTERS: Final = re.compile(r"[^A-Za-z0-9_., -]")
"""Characters that no name in the benchmark contains. Brackets or quotes could break out of the published parser's text."""


def sanitise_answer(text: str) -> str:
    """Return the last list of steps as JSON with only ``action`` and ``object``; "" if there is none.

    Text before the last </think> is ignored. Forbidden characters become "?", so such a name stays unknown.
    """
    answer = text.rpartition("</think>")[2][:MAX_CHARS]
    found: list[dict[str, str]] = []
    for value in _lists(answer):
        steps = _steps(value)
        found = steps or found
    return json.dumps(found) if found else ""


def _lists(text: str) -> Iterator[list[Any]]:
    """All lists in the text that are JSON, or Python literals, which the published parser accepts too."""
    decoder = json.JSONDecoder()
    position = text.find("[")
    for _ in range(MAX_STARTS):
        if position < 0:
            return
        end = position + 1
        try:
            value, end = decoder.raw_decode(text, position)
        except (ValueError, RecursionError):
            value = _literal(text[position : text.find("]", position) + 1])
        if isinstance(value, list):
            yield value
        position = text.find("[", end)


def _literal(text: str) -> Any:
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return None


def _steps(value: list[Any]) -> list[dict[str, str]]:
    return [
        {key: _FORBIDDEN_CHARACTERS.sub("?", step[key]) for key in ("action", "object")}
        for step in value
        if isinstance(step, dict) and all(isinstance(step.get(key), str) for key in ("action", "object"))
    ]
