"""Resumable logs: the folder of a build with one line per variant, and a generic log of outcomes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
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
    from _typeshed import DataclassInstance


T = TypeVar("T", bound="DataclassInstance")


@dataclass
class ResumableLog(Generic[T]):
    """Outcomes of a long run as JSON lines, preceded by the settings that decide them. Without a path, memory only."""

    path: Path | None = None
    outcomes: list[T] = field(default_factory=list)

    def resume(self, settings: Mapping[str, Any], read: Callable[[Any], T]) -> None:
        """Read the outcomes of an earlier run, or start the file. Raise EvaluationError or OSError.

        ``read`` converts the JSON value of a line. It raises ValueError, TypeError or KeyError for an invalid value.
        """
        if self.path is None:
            return
        lines = _read_or_start(self.path, settings)
        wanted = json.loads(json.dumps(settings))
        try:
            found = json.loads(lines[0])
        except (ValueError, IndexError) as error:
            raise EvaluationError(
                f"{self.path} is not a log of outcomes: expected its settings in the first line; name another file"
            ) from error
        if found != wanted:
            raise EvaluationError(
                f"{self.path} holds outcomes of {_in_words(found)}, not of {_in_words(wanted)}: name another file"
            )
        self.outcomes += _read_outcomes(self.path, lines, read, EvaluationError)

    def add(self, outcome: T) -> None:
        """Append an outcome. Raise OSError."""
        if self.path is not None:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(outcome)) + "\n")
        self.outcomes.append(outcome)


def _read_or_start(path: Path, head: Mapping[str, Any]) -> list[str]:
    """Return the lines of a log. A missing log is created with ``head`` as its first line."""
    if not path.exists():
        write_whole(path, (json.dumps(head) + "\n").encode("ascii"))
    return path.read_text(encoding="utf-8").splitlines()


def _read_outcomes(
    path: Path, lines: list[str], read: Callable[[Any], T], error_type: type[Exception]
) -> list[T]:
    """Return the outcomes after the first line. A truncated last line is removed from the file."""
    outcomes: list[T] = []
    for number, line in enumerate(lines[1:], start=2):
        try:
            outcomes.append(read(json.loads(line)))
        except (ValueError, TypeError, KeyError) as error:
            if number != len(lines):
                raise error_type(
                    f"{path}:{number} is not an outcome ({error}): remove the line, or name another path"
                ) from error
            write_whole(path, "".join(f"{kept}\n" for kept in lines[:-1]).encode("utf-8"))
    return outcomes


def _in_words(settings: object) -> str:
    """Return settings as text, such as ``seed 0, method tree``."""
    if not isinstance(settings, dict):
        return repr(settings)
    return ", ".join(f"{name} {value}" for name, value in settings.items())


BUILD_FILE: Final = "build.jsonl"
ATTEMPTS_FILE: Final = "attempts.jsonl"
"""Log with a line for every draft and the reason of each rejection."""
TIMES_FILE: Final = "times.jsonl"
"""CPU seconds of each variant and of the base scenes of each call. They are not part of the dataset."""
TRANSCRIPTS_FOLDER: Final = "transcripts"
TREES_FOLDER: Final = "trees"
"""Layout trees as nested JSON, one file per task."""


@dataclass(frozen=True, slots=True)
class Rejection:
    """Draft that was not admitted. ``instruction`` and ``goal`` are empty if the writer gave none."""

    scene: str
    category: str
    instruction: str
    goal: str
    reason: RefusalReason
    sentence: str


@dataclass(frozen=True, slots=True)
class VariantResult:
    """Records and rejections of one variant."""

    split: str
    number: int
    records: tuple[TaskRecord, ...]
    rejections: tuple[Rejection, ...]


@dataclass
class BuildStore:
    """Folder of a build. Its log holds the settings in the first line and one variant in each further line."""

    folder: Path
    results: list[VariantResult] = field(default_factory=list)

    @staticmethod
    def open(folder: Path, settings: Mapping[str, Any]) -> BuildStore:
        """Start a build or resume one. Raise DatasetError if the folder holds a build with other settings."""
        path = folder / BUILD_FILE
        try:
            (folder / BUNDLES_FOLDER).mkdir(parents=True, exist_ok=True)
            lines = _read_or_start(path, {"settings": settings})
            wanted, found = json.loads(json.dumps(settings)), json.loads(lines[0])["settings"]
            store = BuildStore(folder)
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
                f"{folder} holds a build with other settings ({_differences(found, wanted)}): give the same settings "
                "again, or choose another folder"
            )
        store.results += _read_outcomes(path, lines, _from_json, DatasetError)
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
        """Store a variant's result. Its other files are written before its line in the log."""
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
        """Record the CPU time of the base scenes of one call. Raise OSError."""
        self._spent({"base_scenes": scenes, "cpu_s": round(cpu_s, 3)})

    def _spent(self, line: Mapping[str, str | int | float]) -> None:
        with (self.folder / TIMES_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def _write_attempts(self) -> None:
        """Rewrite the whole log, because an interrupted build may lack its last lines."""
        text = "".join(_attempt_lines(result) for result in self.results)
        write_whole(self.folder / ATTEMPTS_FILE, text.encode("utf-8"))


def _attempt_lines(result: VariantResult) -> str:
    """Return one line per draft of a variant: the admitted drafts, then the rejected ones."""
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
