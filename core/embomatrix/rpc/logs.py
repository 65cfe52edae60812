"""Log lines of the daemons, as text or JSON, with the ids they concern and without secrets.

A message names its ids as ``name=%s`` ("lease expired rollout=%s worker=%s"); in JSON each becomes a field. ``bind``
adds an id to all later lines of a task.
"""

import contextvars
import dataclasses
import functools
import itertools
import json
import logging
import re
import sys
import time
from collections import deque
from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Any, Final, Literal

from embomatrix.host.printable import printable

Id = Literal["run", "batch", "rollout", "lease", "worker", "session", "scene"]
"""Names of ids in log lines."""

SHORTEST_SECRET: Final = 4
"""Shorter words are not masked, since they occur inside other words."""
LINES: Final = 20
"""Warnings and errors of one kind within ``WINDOW_S`` at most."""
WINDOW_S: Final = 10.0
KINDS: Final = 1024
"""Kinds of lines that are counted. The oldest is forgotten first."""
KIND_CHARACTERS: Final = 60
"""Beginning of a message that distinguishes kinds: some libraries fill values in before they log."""
MASK: Final = "***"
_NAMED: Final = re.compile(r"(?:(\w+)=)?(%%|%[-+#0 ]*\d*(?:\.\d+)?[sdrfgixe])")
_BEARER: Final = re.compile(r"(Bearer\s+)\S+", re.IGNORECASE)
_PASSWORD: Final = re.compile(r"(://[^/@:\s]*:)[^/@\s]*@")
_bound: contextvars.ContextVar[Mapping[str, str]] = contextvars.ContextVar(
    "_bound", default=MappingProxyType({})
)
_hidden: set[str] = set()


class LogFormat(StrEnum):
    """Format of log lines."""

    HUMAN = "human"
    JSON = "json"


def log_to_stderr(level: str, log_format: LogFormat) -> None:
    """Write the log lines of this process to standard error. Raises ValueError for an unknown level."""
    known = logging.getLevelNamesMapping()
    if level.upper() not in known:
        raise ValueError("expected debug, info, warning or error")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if log_format is LogFormat.JSON else HumanFormatter())
    handler.addFilter(LineLimit())
    # Libraries log warnings and errors only; our own loggers use the requested level.
    logging.basicConfig(level=max(logging.WARNING, known[level.upper()]), handlers=[handler], force=True)
    logging.getLogger("embomatrix").setLevel(level.upper())


def bind(name: Id, value: str) -> None:
    """Add the id to all later log lines of this task and of the tasks it starts. An empty value removes it."""
    ids = {**_bound.get(), name: value}
    _bound.set({key: kept for key, kept in ids.items() if kept})


def hide(secret: str) -> None:
    """Mask the word as ``***`` in all later log lines."""
    if len(secret) >= SHORTEST_SECRET:
        _hidden.add(secret)


def without_secrets(text: str) -> str:
    """Return the text with hidden words, bearer tokens, and passwords in URLs masked."""
    for secret in _hidden:
        text = text.replace(secret, MASK)
    return _PASSWORD.sub(rf"\1{MASK}@", _BEARER.sub(rf"\1{MASK}", text))


class HumanFormatter(logging.Formatter):
    """Text line: time, level, and message, then bound ids that the message lacks."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)-7s %(message)s")
        # Lines of several machines are read together: UTC.
        self.converter = time.gmtime
        self.default_msec_format = "%s.%03dZ"

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  # the standard library's name
        named = set(_fields(record))
        more = "".join(f" {name}={value}" for name, value in _bound.get().items() if name not in named)
        return printable(super().formatMessage(record) + more)

    def format(self, record: logging.LogRecord) -> str:
        # The message is one line; only a traceback after it has more.
        return printable(without_secrets(super().format(record)), lines=True)


class LineLimit(logging.Filter):
    """Filter that passes at most ``LINES`` lines of one kind per ``WINDOW_S``.

    A kind is a logger with its message before the values are filled in. The next line that passes names the number of
    suppressed lines. ``INFO`` and lower levels pass, since they report work that the manager has accepted.
    """

    def __init__(self) -> None:
        super().__init__()
        self._windows: dict[tuple[str, str], _Window] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno < logging.WARNING:
            return True
        kind = (record.name, str(record.msg)[:KIND_CHARACTERS])
        window = self._windows.get(kind)
        if window is None:
            if len(self._windows) >= KINDS:
                del self._windows[next(iter(self._windows))]
            window = self._windows[kind] = _Window(record.created)
        if record.created - window.begin_s >= WINDOW_S:
            window.begin_s, window.passed = record.created, 0
        if window.passed >= LINES:
            window.suppressed += 1
            return False
        window.passed += 1
        if window.suppressed:
            message = record.getMessage()
            record.msg, record.args = "%s (%d similar lines suppressed)", (message, window.suppressed)
            window.suppressed = 0
        return True


@dataclasses.dataclass(slots=True)
class _Window:
    """Lines of one kind since ``begin_s``, in wall-clock seconds."""

    begin_s: float
    passed: int = 0
    suppressed: int = 0


class LogTail(logging.Handler):
    """Latest lines of this process's own loggers from ``INFO`` on, without secrets and line breaks, numbered from 1."""

    def __init__(self, *, kept: int, characters: int) -> None:
        super().__init__(logging.INFO)
        self._lines: deque[str] = deque(maxlen=kept)
        self._characters = characters
        self._total = 0
        self.setFormatter(HumanFormatter())

    def emit(self, record: logging.LogRecord) -> None:
        try:
            line = printable(self.format(record))
        except Exception:  # noqa: BLE001  # a line that can't be formatted is reported as all handlers do
            self.handleError(record)
            return
        self._lines.append(line if len(line) <= self._characters else f"{line[: self._characters - 1]}…")
        self._total += 1

    def lines(self, after: int, most: int) -> tuple[tuple[str, ...], int]:
        """Return the first lines with a number above ``after``, at most ``most``, and the number of the last of them."""
        begin = max(after, self._total - len(self._lines))
        found = tuple(itertools.islice(self._lines, begin - (self._total - len(self._lines)), None))[:most]
        return found, begin + len(found)


class JsonFormatter(logging.Formatter):
    """JSON line: UTC time, level, logger, message, and a field for each id that the message names."""

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
        line = {
            name: printable(value, lines=True) if isinstance(value, str) else value
            for name, value in line.items()
        }
        return without_secrets(json.dumps(line, ensure_ascii=False, default=str))


def _fields(record: logging.LogRecord) -> dict[str, Any]:
    """Return the values that the message names as ``name=%s``; numbers stay numbers."""
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
    """Return the name before each placeholder of a message; empty where there is none."""
    return tuple(found[1] or "" for found in _NAMED.finditer(message) if found[2] != "%%")
