"""What a build has done so far, on disk: one line a variant, so that a build that was cut short goes on from there."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from embomatrix.factory.admission import RefusalReason
from embomatrix.factory.metrics.figures import EvaluationError
from embomatrix.world.dataset import (
    BUNDLES_FOLDER,
    DatasetError,
    TaskRecord,
    bundle_file,
    record_from_json,
    record_to_json,
)
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from _typeshed import DataclassInstance


BUILD_FILE: Final = "build.jsonl"
ATTEMPTS_FILE: Final = "attempts.jsonl"
"""The ledger: a line for every draft, with the reason where it was not admitted."""
TIMES_FILE: Final = "times.jsonl"
"""Seconds of processor time, a line for each variant and one for the base scenes of each call: no part of the dataset."""
TRANSCRIPTS_FOLDER: Final = "transcripts"
TREES_FOLDER: Final = "trees"
"""Layout trees as nested JSON, a file for each task."""
_BEFORE_PROOFS: Final = MappingProxyType({"physical": False})
"""What builds of before decision 0047 don't tell: robots proved nothing."""


@dataclass(frozen=True, slots=True)
class Rejection:
    """A draft that was not admitted; ``instruction`` and ``goal`` are empty where nobody gave one."""

    scene: str
    category: str
    instruction: str
    goal: str
    reason: RefusalReason
    sentence: str


@dataclass(frozen=True, slots=True)
class VariantResult:
    """What one variant yielded."""

    split: str
    number: int
    records: tuple[TaskRecord, ...]
    rejections: tuple[Rejection, ...]


@dataclass
class BuildStore:
    """The folder of a build. The first line of its file holds the settings, each other line a variant."""

    folder: Path
    results: list[VariantResult] = field(default_factory=list)

    @staticmethod
    def open(folder: Path, settings: Mapping[str, Any]) -> BuildStore:
        """Start a build or take one up again. Raises DatasetError when the folder holds one of other settings."""
        wanted = {**_BEFORE_PROOFS, **json.loads(json.dumps(settings))}
        path = folder / BUILD_FILE
        try:
            (folder / BUNDLES_FOLDER).mkdir(parents=True, exist_ok=True)
            if not path.exists():
                write_whole(path, (json.dumps({"settings": wanted}) + "\n").encode("ascii"))
            first, *lines = path.read_text(encoding="utf-8").splitlines()
            found = settings_of(first)
        except OSError as error:
            raise DatasetError(
                f"the folder {folder} can't be written ({error.strerror}): choose another one"
            ) from error
        except (ValueError, LookupError, TypeError) as error:
            raise DatasetError(
                f"{path} is damaged: expected the settings of the build in its first line; choose another folder"
            ) from error
        if found != wanted:
            raise DatasetError(
                f"{folder} holds a build of other settings ({_differences(found, wanted)}): give the same again, or choose "
                "another folder"
            )
        store = BuildStore(folder, _whole(path, lines))
        store._write_attempts()
        return store

    def has(self, split: str, number: int) -> bool:
        return any(result.split == split and result.number == number for result in self.results)

    def records_of(self, split: str) -> list[TaskRecord]:
        return [record for result in self.results if result.split == split for record in result.records]

    def add(
        self,
        result: VariantResult,
        bundle: bytes,
        transcripts: Mapping[str, str],
        trees: Mapping[str, Mapping[str, Any]],
        cpu_s: float,
    ) -> None:
        """Keep a variant's result. What goes into files of its own is written first: a line means that it is there."""
        self._spent({"split": result.split, "variant": result.number, "cpu_s": round(cpu_s, 3)})
        if result.records:
            path = self.folder / BUNDLES_FOLDER / bundle_file(result.records[0].bundle_digest)
            write_whole(path, bundle)
        drawn = {task_id: json.dumps(tree, indent=1) + "\n" for task_id, tree in trees.items() if tree}
        for name, suffix, texts in ((TRANSCRIPTS_FOLDER, "md", transcripts), (TREES_FOLDER, "json", drawn)):
            if texts:
                (self.folder / name).mkdir(exist_ok=True)
            for task_id, text in texts.items():
                write_whole(self.folder / name / f"{task_id}.{suffix}", text.encode("utf-8"))
        with (self.folder / BUILD_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(_to_json(result)) + "\n")
        self.results.append(result)
        with (self.folder / ATTEMPTS_FILE).open("a", encoding="utf-8") as file:
            file.write(_attempt_lines(result))

    def spent_on_scenes(self, scenes: int, cpu_s: float) -> None:
        """Keep how long the base scenes of one call took. Raises OSError."""
        self._spent({"base_scenes": scenes, "cpu_s": round(cpu_s, 3)})

    def _spent(self, line: Mapping[str, str | int | float]) -> None:
        with (self.folder / TIMES_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def _write_attempts(self) -> None:
        """The whole ledger, from what is known: a build that was cut short may lack its last lines."""
        text = "".join(_attempt_lines(result) for result in self.results)
        write_whole(self.folder / ATTEMPTS_FILE, text.encode("utf-8"))


def settings_of(line: str) -> dict[str, Any]:
    """The settings in the first line of a build's file. Raises ValueError, LookupError or TypeError for another line."""
    return {**_BEFORE_PROOFS, **json.loads(line)["settings"]}


def _attempt_lines(result: VariantResult) -> str:
    """A line for each draft of a variant: the admitted ones, then the others."""
    lines: list[dict[str, str | int]] = [
        {
            "split": result.split,
            "variant": result.number,
            "scene": record.task.scene_id,
            "category": record.task.category.value,
            "instruction": record.task.instruction,
            "goal": record.task.goal_bddl,
            "outcome": "admitted",
            "task": record.task.task_id,
        }
        for record in result.records
    ]
    lines += [
        {
            "split": result.split,
            "variant": result.number,
            "scene": item.scene,
            "category": item.category,
            "instruction": item.instruction,
            "goal": item.goal,
            "outcome": item.reason.value,
            "sentence": item.sentence,
        }
        for item in result.rejections
    ]
    return "".join(json.dumps(line) + "\n" for line in lines)


def _differences(found: object, wanted: Mapping[str, Any]) -> str:
    known = found if isinstance(found, dict) else {}
    return ", ".join(
        f"{name} {known.get(name)}, now {value}" for name, value in wanted.items() if known.get(name) != value
    )


def _whole(path: Path, lines: list[str]) -> list[VariantResult]:
    """Results of the lines. A last line that was cut short is dropped from the file: its variant is made again."""
    results: list[VariantResult] = []
    for number, line in enumerate(lines):
        try:
            results.append(_from_json(json.loads(line)))
        except ValueError as error:
            if number != len(lines) - 1:
                raise DatasetError(f"{path}:{number + 2}: {error}; choose another folder") from error
            kept = path.read_text(encoding="utf-8").splitlines()[:-1]
            write_whole(path, "".join(f"{item}\n" for item in kept).encode("utf-8"))
    return results


def _to_json(result: VariantResult) -> dict[str, Any]:
    return {
        "split": result.split,
        "number": result.number,
        "records": [record_to_json(record) for record in result.records],
        "rejections": [asdict(item) for item in result.rejections],
    }


def _from_json(value: dict[str, Any]) -> VariantResult:
    return VariantResult(
        value["split"],
        value["number"],
        tuple(record_from_json(record) for record in value["records"]),
        tuple(Rejection(**{**item, "reason": RefusalReason(item["reason"])}) for item in value["rejections"]),
    )


T = TypeVar("T", bound="DataclassInstance")


@dataclass
class ResumableLog(Generic[T]):
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
