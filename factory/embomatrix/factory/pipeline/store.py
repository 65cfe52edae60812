"""Resumable logs: the folder of a build with one line per variant, and a generic log of outcomes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from embomatrix.factory.admission import RefusalReason
from embomatrix.world.dataset import (
    BUNDLES_FOLDER,
    DatasetError,
    TaskRecord,
    bundle_file,
    record_from_json,
    record_to_json,
)
from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


T = TypeVar("T", bound="DataclassInstance")


@dataclass
class ResumableLog(Generic[T]):
    """Outcomes of a long run as JSON lines, preceded by the settings that decide them. Without a path, memory only."""

    path: Path | None = None
    encode: Callable[[T], Mapping[str, Any]] = asdict
    outcomes: list[T] = field(default_factory=list)

    def resume(self, settings: Mapping[str, Any], read: Callable[[Any], T]) -> None:
        """Read the outcomes of an earlier run, or start the file. Raise DatasetError or OSError.

        ``read`` converts the JSON value of a line. It raises ValueError, TypeError or KeyError for an invalid value.
        """
        if self.path is None:
            return
        if not self.path.exists():
            write_whole(self.path, (json.dumps(settings) + "\n").encode("ascii"))
        wanted = json.loads(json.dumps(settings))
        try:
            lines = self.path.read_text(encoding="utf-8").splitlines()
            found = parse_json(lines[0])
        except (ValueError, IndexError):
            found = None
        if not isinstance(found, dict) or found.keys() != wanted.keys():
            raise DatasetError(
                f"{self.path} is damaged: expected the settings of the run in its first line; name another file or folder"
            )
        if found != wanted:
            raise DatasetError(
                f"{self.path} holds a run with other settings ({_differences(found, wanted)}): give the same settings "
                "again, or name another file or folder"
            )
        self.outcomes += _read_outcomes(self.path, lines, read)

    def add(self, outcome: T) -> None:
        """Append an outcome. Raise OSError."""
        if self.path is not None:
            _append(self.path, json.dumps(self.encode(outcome)) + "\n")
        self.outcomes.append(outcome)


def _read_outcomes(path: Path, lines: list[str], read: Callable[[Any], T]) -> list[T]:
    """Return the outcomes after the first line. A truncated last line is removed from the file."""
    outcomes: list[T] = []
    for number, line in enumerate(lines[1:], start=2):
        try:
            outcomes.append(read(parse_json(line)))
        except (ValueError, TypeError, KeyError) as error:
            if number != len(lines):
                raise DatasetError(
                    f"{path}:{number} is not an outcome ({error}): remove the line, or name another path"
                ) from error
            write_whole(path, "".join(f"{kept}\n" for kept in lines[:-1]).encode("utf-8"))
    return outcomes


def _append(path: Path, text: str) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(text)


def _differences(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """Return the settings that differ, such as ``seed 1, now 2``."""
    return ", ".join(
        _differences(found[name], value)
        if isinstance(value, dict) and isinstance(found.get(name), dict)
        else f"{name} {found.get(name)}, now {value}"
        for name, value in wanted.items()
        if found.get(name) != value
    )


BUILD_FILE: Final = "build.jsonl"
ATTEMPTS_FILE: Final = "attempts.jsonl"
"""Log with a line for every draft and the reason of each rejection."""
TIMES_FILE: Final = "times.jsonl"
"""CPU seconds of each variant and of the base scenes of each call. They are not part of the dataset."""
RETOLD: Final = "retold"
"""Mark in `TIMES_FILE` of a variant whose tasks an earlier build proved. Such variants are not part of admission figures."""
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


@dataclass(frozen=True, slots=True)
class VariantYield:
    """Result of a variant: records, their bundle, and transcripts and layout trees by task id.

    ``cpu_s`` is the CPU time. ``retold`` says that an earlier build proved the tasks. Neither affects equality.
    """

    result: VariantResult
    bundle: bytes
    transcripts: Mapping[str, str]
    trees: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    cpu_s: float = field(default=0.0, compare=False)
    retold: bool = field(default=False, compare=False)


def build_settings(folder: Path) -> dict[str, Any]:
    """Return the settings of a build. Raise DatasetError if the folder holds none."""
    path = folder / BUILD_FILE
    try:
        with path.open(encoding="utf-8") as file:
            return dict(parse_json(file.readline())["settings"])
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise DatasetError(
            f"{path} does not hold the settings of a build ({error}): name a folder written by `factory build`, "
            "`generate` or `corpus`"
        ) from error


def build_results(folder: Path) -> list[VariantResult]:
    """Return the finished variants of a build. Raise DatasetError if the folder holds no build, or OSError."""
    log = ResumableLog[VariantResult](folder / BUILD_FILE, _to_json)
    log.resume({"settings": build_settings(folder)}, _from_json)
    return log.outcomes


class BuildStore:
    """Folder of a build. Its log holds the settings in the first line and one variant in each further line."""

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        """Start a build or resume one. Raise DatasetError if the folder holds a build with other settings; OSError."""
        self._folder = folder
        (folder / BUNDLES_FOLDER).mkdir(parents=True, exist_ok=True)
        self._log = ResumableLog[VariantResult](folder / BUILD_FILE, _to_json)
        self._log.resume({"settings": settings}, _from_json)
        # An interrupted build may lack the last lines of the ledger, so it is written anew.
        text = "".join(_attempt_lines(result) for result in self.results)
        write_whole(folder / ATTEMPTS_FILE, text.encode("utf-8"))

    @property
    def results(self) -> list[VariantResult]:
        return self._log.outcomes

    def add(self, variant: VariantYield) -> None:
        """Store a variant's result. Its other files are written before its line in the log."""
        result = variant.result
        work: dict[str, str | int] = {"split": result.split, "variant": result.number}
        self.spend({**work, RETOLD: True} if variant.retold else work, variant.cpu_s)
        if result.records:
            path = self._folder / BUNDLES_FOLDER / bundle_file(result.records[0].bundle_digest)
            write_whole(path, variant.bundle)
        drawn = {
            task_id: json.dumps(tree, indent=1) + "\n" for task_id, tree in variant.trees.items() if tree
        }
        files = ((TRANSCRIPTS_FOLDER, "md", variant.transcripts), (TREES_FOLDER, "json", drawn))
        for name, suffix, texts in files:
            if texts:
                (self._folder / name).mkdir(exist_ok=True)
            for task_id, text in texts.items():
                write_whole(self._folder / name / f"{task_id}.{suffix}", text.encode("utf-8"))
        self._log.add(result)
        _append(self._folder / ATTEMPTS_FILE, _attempt_lines(result))

    def spend(self, work: Mapping[str, str | int], cpu_s: float) -> None:
        """Record the CPU time of a variant, or of the base scenes of one call. Raise OSError."""
        _append(self._folder / TIMES_FILE, json.dumps({**work, "cpu_s": round(cpu_s, 3)}) + "\n")


def _attempt_lines(result: VariantResult) -> str:
    """Return one line per draft of a variant: the admitted drafts, then the rejected ones."""
    variant: dict[str, str | int] = {"split": result.split, "variant": result.number}
    lines: list[dict[str, str | int]] = [
        {
            **variant,
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
            **variant,
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
