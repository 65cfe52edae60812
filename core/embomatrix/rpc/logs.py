"""Log lines of the daemons: sentences for people, or JSON for programs, with the ids that they are about, and without secrets.

A message names what it is about as ``name=%s`` ("lease expired rollout=%s worker=%s"): in JSON each of these is a field. What a
task is about from some point on, ``bind`` adds to all of its lines.
"""

from __future__ import annotations

import contextvars
import functools
import json
import logging
import re
import sys
import time
from enum import StrEnum
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping

Id = Literal["run", "batch", "rollout", "lease", "worker", "session", "scene"]
"""What lines are about."""

SHORTEST_SECRET: Final = 4
"""A word shorter than this is hidden nowhere: it would be found inside of others."""
MASK: Final = "***"
_NAMED: Final = re.compile(r"(?:(\w+)=)?(%%|%[-+#0 ]*\d*(?:\.\d+)?[sdrfgixe])")
_BEARER: Final = re.compile(r"(Bearer\s+)\S+", re.IGNORECASE)
_PASSWORD: Final = re.compile(r"(://[^/@:\s]*:)[^/@\s]*@")
_bound: contextvars.ContextVar[Mapping[str, str]] = contextvars.ContextVar(
    "_bound", default=MappingProxyType({})
)
_hidden: set[str] = set()


class LogFormat(StrEnum):
    """How lines are written."""

    HUMAN = "human"
    JSON = "json"


def log_to_stderr(level: str, log_format: LogFormat) -> None:
    """Write log lines of this process to standard error from now on. ValueError for a level that there is none of."""
    known = logging.getLevelNamesMapping()
    if level.upper() not in known:
        raise ValueError("expected debug, info, warning or error")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if log_format is LogFormat.JSON else HumanFormatter())
    # Libraries speak up when something is wrong; what we do ourselves is told as finely as was asked for.
    logging.basicConfig(level=max(logging.WARNING, known[level.upper()]), handlers=[handler], force=True)
    logging.getLogger("embomatrix").setLevel(level.upper())


def bind(name: Id, value: str) -> None:
    """Every further line of this task, and of those that it starts, carries the id; an empty value takes it away."""
    ids = {**_bound.get(), name: value}
    _bound.set({key: kept for key, kept in ids.items() if kept})


def hide(secret: str) -> None:
    """The word is written as ``***`` from now on, wherever it stands."""
    if len(secret) >= SHORTEST_SECRET:
        _hidden.add(secret)


def without_secrets(text: str) -> str:
    """The text without words that are hidden, tokens of calls, and passwords in addresses."""
    for secret in _hidden:
        text = text.replace(secret, MASK)
    return _PASSWORD.sub(rf"\1{MASK}@", _BEARER.sub(rf"\1{MASK}", text))


class HumanFormatter(logging.Formatter):
    """One line: time, level, and the sentence. Ids that the sentence does not name follow it."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)-7s %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  # the standard library's name
        named = set(_fields(record))
        more = "".join(f" {name}={value}" for name, value in _bound.get().items() if name not in named)
        return super().formatMessage(record) + more

    def format(self, record: logging.LogRecord) -> str:
        return without_secrets(super().format(record))


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time in UTC, level, logger, message, and a field for everything that the message names."""

    def format(self, record: logging.LogRecord) -> str:
        second = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        line: dict[str, Any] = {
            "time": f"{second}.{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        for name, value in {**_bound.get(), **_fields(record)}.items():
            line.setdefault(name, value)
        return without_secrets(json.dumps(line, ensure_ascii=False, default=str))


def _fields(record: logging.LogRecord) -> dict[str, Any]:
    """What the message names as ``name=%s``, with numbers as numbers."""
    args = record.args if isinstance(record.args, tuple) else ()
    names = _names(record.msg) if isinstance(record.msg, str) else ()
    if len(names) != len(args):
        return {}
    return {
        name: value if isinstance(value, int | float | bool) else str(value)
        for name, value in zip(names, args, strict=True)
        if name
    }


@functools.lru_cache(maxsize=1024)
def _names(message: str) -> tuple[str, ...]:
    """The name before each place of a message; empty where there is none."""
    return tuple(found[1] or "" for found in _NAMED.finditer(message) if found[2] != "%%")
