"""Outcomes of long work as they come, on disk: what was stopped at any time is taken up where it was."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from embomatrix.factory.metrics.figures import EvaluationError
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")


@dataclass
class LineLog(Generic[T]):
    """What decides the outcomes in the first line of a file, an outcome in each other. Without a path, in memory alone."""

    path: Path | None = None
    outcomes: list[T] = field(default_factory=list)

    def take_up(self, settings: Mapping[str, Any], read: Callable[[Any], T]) -> None:
        """Read what the file holds, or begin it. A last line that was cut short is dropped. Raises EvaluationError, OSError.

        ``read`` makes an outcome of a line's value; it raises ValueError, TypeError or KeyError where that is none.
        """
        if self.path is None:
            return
        wanted = json.loads(json.dumps(settings))
        if not self.path.exists():
            write_whole(self.path, (json.dumps(wanted) + "\n").encode())
        lines = self.path.read_text(encoding="utf-8").splitlines()
        found = _settings(self.path, lines[:1])
        if found != wanted:
            raise EvaluationError(
                f"{self.path} holds outcomes of {_told(found)}, not of {_told(wanted)}: name another file"
            )
        for number, line in enumerate(lines[1:], start=2):
            try:
                self.outcomes.append(read(json.loads(line)))
            except (ValueError, TypeError, KeyError) as error:
                if number != len(lines):
                    raise EvaluationError(
                        f"{self.path}, line {number}, is no outcome ({error}): remove the line"
                    ) from error
                write_whole(self.path, "".join(f"{kept}\n" for kept in lines[:-1]).encode())

    def add(self, outcome: T) -> None:
        """Keep an outcome. Raises OSError."""
        if self.path is not None:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(outcome)) + "\n")
        self.outcomes.append(outcome)


def _told(settings: object) -> str:
    """Settings in words: seed 0, method tree."""
    if not isinstance(settings, dict):
        return repr(settings)
    return ", ".join(f"{name} {value}" for name, value in settings.items())


def _settings(path: Path, first: Sequence[str]) -> Any:
    try:
        return json.loads(first[0])
    except (ValueError, IndexError) as error:
        raise EvaluationError(
            f"{path} is no file of outcomes: expected what decides them in its first line; name another file"
        ) from error
