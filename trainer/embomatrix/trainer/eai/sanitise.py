"""From what a model wrote to the pure JSON that EAI's judge may be given: its parser calls ``eval`` on it."""

from __future__ import annotations

import ast
import json
import re
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

MAX_CHARS: Final = 64 * 1024
MAX_STARTS: Final = 256
"""Brackets at which a list is looked for: bounds the work on adversarial text."""
_STRANGE: Final = re.compile(r"[^A-Za-z0-9_., -]")
"""No name of the benchmark holds any other character. A bracket would end the published parser's text, a quote its string."""


def sanitised(text: str) -> str:
    """The last list of steps in the text, with nothing but ``action`` and ``object`` of each; "" where there is none.

    What follows the last closed <think> counts. Strange characters of names become "?": such a name stays unknown.
    """
    answer = text.rpartition("</think>")[2][:MAX_CHARS]
    found: list[dict[str, str]] = []
    for value in _lists(answer):
        steps = _steps(value)
        found = steps or found
    return json.dumps(found) if found else ""


def _lists(text: str) -> Iterator[list[Any]]:
    """Every list that begins at a bracket and is JSON or, as the published parser takes it, a Python literal."""
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
        {key: _STRANGE.sub("?", step[key]) for key in ("action", "object")}
        for step in value
        if isinstance(step, dict) and all(isinstance(step.get(key), str) for key in ("action", "object"))
    ]
