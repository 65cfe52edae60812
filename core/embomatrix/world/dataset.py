"""Datasets: a folder with task records and the bundles that the tasks run in.

``tasks.jsonl`` holds one record per line, ``bundles/`` one file per digest. A record contains the whole task: a trainer writes
prompts without decoding scenes.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from embomatrix.world.bundle import Bundle, decode_bundle
from embomatrix.world.codec_task import task_of, task_to_json
from embomatrix.world.difficulty import Difficulty
from embomatrix.world.inflation import DEFAULT_LIMITS, BundleError
from embomatrix.world.intent import IntentClause
from embomatrix.world.json_text import parse_json
from embomatrix.world.records import Record, SceneInvalidError, Share, TaskJson, Text, convert
from embomatrix.world.task import Task
from embomatrix.world.whole_file import read_whole, write_whole

TASKS_FILE: Final = "tasks.jsonl"
BUNDLES_FOLDER: Final = "bundles"
SPLITS: Final = ("train", "heldout")
MAX_PLAN_STEPS: Final = 1_000
"""Steps of an oracle's plan in a measured difficulty."""
_REMEDY: Final = "copy the dataset again, or get the shipped one with `embomatrix factory starter`"


class DatasetError(ValueError):
    """Unreadable dataset. The message names the file, the line if there is one, and the remedy."""


@dataclass(frozen=True, slots=True)
class TaskRecord:
    """Admitted task. ``oracle`` is a plan that reaches the goal, as JSON; ``signature`` names the kind of goal.

    ``intent`` is what the instruction demands; empty if its writer did not say. ``difficulty`` is None until it is measured.
    """

    task: Task
    bundle_digest: str
    split: str
    oracle: tuple[Mapping[str, object], ...]
    rooms: tuple[str, ...]
    signature: str
    intent: tuple[IntentClause, ...] = ()
    difficulty: Difficulty | None = None


@dataclass(frozen=True)
class Dataset:
    """Records in the order of the file. Bundles are read on demand."""

    folder: Path
    records: tuple[TaskRecord, ...]
    _decoded: dict[str, Bundle] = field(default_factory=dict, repr=False, compare=False)

    @staticmethod
    def load(folder: Path | str) -> Dataset:
        """Read the records of a folder. Raises DatasetError if it holds no dataset or a wrong record."""
        return Dataset.load_file(Path(folder) / TASKS_FILE)

    @staticmethod
    def load_file(path: Path) -> Dataset:
        """Read the records of a file of any name; its bundles lie beside it. Raises DatasetError."""
        folder = path.parent
        try:
            lines = path.read_text(encoding="utf-8").split("\n")
        except OSError as error:
            if folder.is_file():
                raise DatasetError(f"{folder} is a file: expected the folder of a dataset") from error
            raise DatasetError(
                f"there is no dataset in {folder}: {path} can't be read ({error.strerror}); "
                f"get the shipped one with `embomatrix factory starter --out={folder}`, or name another folder"
            ) from error
        except UnicodeDecodeError as error:
            raise DatasetError(
                f"{path} is damaged: expected text in UTF-8, found other bytes; {_REMEDY}"
            ) from error
        records = tuple(
            _record(line, f"{path}:{number}") for number, line in enumerate(lines, start=1) if line.strip()
        )
        return Dataset(folder, records)

    @property
    def train(self) -> tuple[TaskRecord, ...]:
        return tuple(record for record in self.records if record.split == "train")

    @property
    def heldout(self) -> tuple[TaskRecord, ...]:
        return tuple(record for record in self.records if record.split == "heldout")

    def bundle_bytes(self, digest: str) -> bytes:
        """Compressed bundle. Raises DatasetError if the folder lacks it or it exceeds the size limit."""
        path = self.folder / BUNDLES_FOLDER / bundle_file(digest)
        try:
            return read_whole(path, at_most=DEFAULT_LIMITS.compressed_bytes)
        except OSError as error:
            raise DatasetError(
                f"the bundle {path} of the dataset can't be read ({error.strerror}): {_REMEDY}"
            ) from error

    def has_bundle(self, digest: str) -> bool:
        """Return True if the folder holds the bundle. Raises DatasetError for anything but a digest."""
        return (self.folder / BUNDLES_FOLDER / bundle_file(digest)).is_file()

    def bundle(self, digest: str) -> Bundle:
        """Decoded bundle, cached in memory. Raises DatasetError."""
        if digest not in self._decoded:
            self._decoded[digest] = self.read_bundle(digest)
        return self._decoded[digest]

    def read_bundle(self, digest: str) -> Bundle:
        """Decoded bundle, not cached: many bundles would fill the memory. Raises DatasetError."""
        data = self.bundle_bytes(digest)
        try:
            return decode_bundle(data, digest=digest)
        except BundleError as error:
            path = self.folder / BUNDLES_FOLDER / bundle_file(digest)
            raise DatasetError(f"the bundle {path} of the dataset is damaged ({error}): {_REMEDY}") from error

    def find(self, task_id: str) -> TaskRecord:
        """Record of a task. Raises DatasetError that names close matches."""
        for record in self.records:
            if record.task.task_id == task_id:
                return record
        raise DatasetError(
            f"there is no task {task_id!r} in {self.folder}: "
            f"{_closest(task_id, [record.task.task_id for record in self.records])} "
            f"(`embomatrix factory list --dataset={self.folder}` lists all tasks)"
        )


def bundle_file(digest: str) -> str:
    """File name of a bundle: its hash without the algorithm. Raises DatasetError for anything but a digest."""
    if not is_digest(digest):
        raise DatasetError(f"found the digest {digest[:80]!r}: expected 'sha256:' and 64 hexadecimal digits")
    return f"{digest.removeprefix('sha256:')}.bundle"


def is_digest(text: str) -> bool:
    """Return True if the text has the form of a bundle's digest."""
    algorithm, _, hexdigits = text.partition(":")
    return algorithm == "sha256" and len(hexdigits) == 64 and set(hexdigits) <= set("0123456789abcdef")


def write_dataset(folder: Path | str, records: Sequence[TaskRecord], bundles: Mapping[str, bytes]) -> None:
    """Write the bundles first and the records last: a folder with records is complete."""
    root = Path(folder)
    (root / BUNDLES_FOLDER).mkdir(parents=True, exist_ok=True)
    for digest, data in bundles.items():
        write_whole(root / BUNDLES_FOLDER / bundle_file(digest), data)
    write_whole(root / TASKS_FILE, encode_records(records))


def encode_records(records: Iterable[TaskRecord]) -> bytes:
    """Content of a file of task records, one a line."""
    lines = [json.dumps(record_to_json(record), separators=(",", ":")) for record in records]
    return "".join(f"{line}\n" for line in lines).encode("ascii")


def record_to_json(record: TaskRecord) -> dict[str, Any]:
    """Record as JSON values. An empty intent and an unknown difficulty are left out."""
    value: dict[str, Any] = {
        "task": task_to_json(record.task),
        "bundle": record.bundle_digest,
        "split": record.split,
        "oracle": [dict(call) for call in record.oracle],
        "rooms": [*record.rooms],
        "signature": record.signature,
    }
    if record.intent:
        value["intent"] = [
            {"predicate": clause.predicate, "things": [*clause.things]}
            | ({"places": [*clause.places]} if clause.places else {})
            | ({} if clause.holds else {"holds": False})
            for clause in record.intent
        ]
    if record.difficulty is not None:
        value["difficulty"] = asdict(record.difficulty)
    return value


class IntentJson(Record):
    predicate: str
    things: Annotated[tuple[str, ...], Meta(min_length=1)]
    places: tuple[str, ...] = ()
    holds: bool = True


class DifficultyJson(Record):
    template: bool
    nearest: bool
    greedy: bool
    steps: Annotated[int, Meta(ge=0, le=MAX_PLAN_STEPS)]
    small_policy: Share | None = None


class TaskRecordJson(Record):
    task: TaskJson
    bundle: str
    split: Literal["train", "heldout"]
    oracle: tuple[dict[str, Any], ...]
    rooms: tuple[str, ...]
    signature: Text
    intent: tuple[IntentJson, ...] = ()
    difficulty: DifficultyJson | None = None


def record_from_json(value: object) -> TaskRecord:
    """Decode a record. Raises SceneInvalidError."""
    record = convert(value, TaskRecordJson, "record")
    if not is_digest(record.bundle):
        raise SceneInvalidError(
            "record.bundle", f"found {record.bundle[:80]!r}: expected 'sha256:' and 64 hexadecimal digits"
        )
    return TaskRecord(
        task=task_of(record.task, "record.task"),
        bundle_digest=record.bundle,
        split=record.split,
        oracle=record.oracle,
        rooms=record.rooms,
        signature=record.signature,
        intent=tuple(
            IntentClause(clause.predicate, clause.things, clause.places, clause.holds)
            for clause in record.intent
        ),
        difficulty=None
        if record.difficulty is None
        else Difficulty(**msgspec.structs.asdict(record.difficulty)),
    )


def _record(line: str, place: str) -> TaskRecord:
    try:
        return record_from_json(parse_json(line))
    except SceneInvalidError as error:
        raise DatasetError(f"{place} is damaged: {error}; {_REMEDY}") from error
    except ValueError as error:
        raise DatasetError(f"{place} is damaged: expected a JSON object ({error}); {_REMEDY}") from error


def _closest(name: str, known: list[str]) -> str:
    close = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
    return f"did you mean {', '.join(close)}?" if close else f"it holds {len(known)} others"
