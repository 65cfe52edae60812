"""A dataset for other tools: one row a task in JSON lines or Parquet, with a card that says what is in it."""

from __future__ import annotations

import hashlib
import io
import json
from collections import Counter
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from embomatrix.factory.pipeline.store import BUILD_FILE, TRANSCRIPTS_FOLDER
from embomatrix.world.dataset import DatasetError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from embomatrix.world.dataset import Dataset, TaskRecord

FIELDS: Final[Mapping[str, str]] = {
    "task_id": "unique in the dataset",
    "split": "`train` or `heldout`",
    "scene_id": "the scene variant that it belongs to; tasks of one variant share a bundle",
    "base_scene": "the BEHAVIOR-1K inventory that the scene was built from",
    "rooms": "rooms of the goal's objects",
    "category": "`pick_and_place`, `appliance_use`, `kitchen_operation` or `compound`",
    "instruction": "what a person says",
    "goal": "BDDL over the scene's objects",
    "signature": "kind of goal: predicates over categories",
    "table": "names of the objects that a plan may name, by row",
    "types": "JSON: synset to object names, what the goal's quantifiers range over",
    "oracle": "JSON: a plan that reaches the goal, executed in the simulator before the task was kept",
    "oracle_steps": "its calls",
    "profile": "which skills a plan may use",
    "source": "where the task comes from",
    "bundle": "digest of the bundle that it runs in; bundles are not part of the export",
    "transcript": "Markdown: what people said, empty where nobody talked",
}
SUFFIXES: Final = (".jsonl", ".parquet")


def export_rows(dataset: Dataset) -> list[dict[str, Any]]:
    """A row for each task, with the fields of ``FIELDS`` in their order."""
    return [_row(dataset, record) for record in dataset.records]


def _row(dataset: Dataset, record: TaskRecord) -> dict[str, Any]:
    task = record.task
    transcript = dataset.folder / TRANSCRIPTS_FOLDER / f"{task.task_id}.md"
    return {
        "task_id": task.task_id,
        "split": record.split,
        "scene_id": task.scene_id,
        "base_scene": task.scene_id.split("-")[0],
        "rooms": list(record.rooms),
        "category": task.category.value,
        "instruction": task.instruction,
        "goal": task.goal_bddl,
        "signature": record.signature,
        "table": list(task.table),
        "types": json.dumps({name: list(members) for name, members in task.types.items()}),
        "oracle": json.dumps([dict(call) for call in record.oracle]),
        "oracle_steps": len(record.oracle),
        "profile": task.profile.value,
        "source": task.source,
        "bundle": record.bundle_digest,
        "transcript": transcript.read_text(encoding="utf-8") if transcript.is_file() else "",
    }


def encoded(rows: Sequence[Mapping[str, Any]], suffix: str) -> bytes:
    """The rows as a file's content. Raises DatasetError for another suffix, or for Parquet without pyarrow."""
    if suffix == ".jsonl":
        return "".join(f"{json.dumps(row, ensure_ascii=False)}\n" for row in rows).encode("utf-8")
    if suffix != ".parquet":
        raise DatasetError(f"found a file that ends in {suffix!r}: expected {' or '.join(SUFFIXES)}")
    try:
        arrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError as error:
        raise DatasetError(
            "Parquet needs pyarrow: pip install 'embomatrix[export]', or export to .jsonl"
        ) from error
    text, texts = arrow.string(), arrow.list_(arrow.string())
    kinds = {"rooms": texts, "table": texts, "oracle_steps": arrow.int32()}
    schema = arrow.schema([(name, kinds.get(name, text)) for name in FIELDS])
    out = io.BytesIO()
    parquet.write_table(arrow.Table.from_pylist(list(rows), schema=schema), out, compression="zstd")
    return out.getvalue()


def card(dataset: Dataset, file_name: str, data: bytes) -> str:
    """The dataset card in Markdown, with the head that dataset hubs read."""
    records = dataset.records
    scenes = {record.task.scene_id.split("-")[0] for record in records}
    kinds = {record.signature for record in records}
    lines = [
        "---",
        "language: en",
        "pretty_name: EmboMatrix tasks",
        "task_categories: [robotics]",
        f"size_categories: {_size(len(records))}",
        "---",
        "# EmboMatrix tasks",
        "",
        f"{len(records):,} household tasks in {len(scenes)} base scenes, each with a plan of the oracle planner that was "
        f"executed in the simulator and reaches the goal. {len(kinds):,} kinds of goals.",
        "",
        f"File: `{file_name}`, SHA-256 `{hashlib.sha256(data).hexdigest()}`.",
        "",
        *_counts(records),
        "",
        "| field | what it holds |",
        "| --- | --- |",
        *(f"| `{name}` | {words} |" for name, words in FIELDS.items()),
        "",
        "## How it was made",
        "",
        _settings(dataset.folder),
        "",
        "## What it is made of",
        "",
        _SOURCES,
        "",
    ]
    return "\n".join(lines)


def _counts(records: Sequence[TaskRecord]) -> list[str]:
    """A table of how many tasks of each category there are in each split."""
    categories = Counter((record.task.category.value, record.split) for record in records)
    splits = Counter(record.split for record in records)
    lines = ["| category | train | heldout |", "| --- | ---: | ---: |"]
    for category in sorted({category for category, _ in categories}):
        counts = " | ".join(f"{categories[category, split]:,}" for split in ("train", "heldout"))
        lines.append(f"| {category} | {counts} |")
    return [*lines, f"| all | {splits['train']:,} | {splits['heldout']:,} |"]


_SOURCES: Final = (
    "Scenes, categories, sizes and masses come from the BEHAVIOR-1K knowledge base (PyPI `bddl` 3.6.0, MIT, Stanford Vision "
    "and Learning Lab). People, conversations and instructions are made up, by a grammar unless the settings name a language "
    "model; no person is meant. Geometry is generated; there are no meshes of others in it. Tasks were checked in kinematic "
    "execution: a robot with noise, slip or perception may fail where the oracle's plan succeeds."
)


def _settings(folder: Path) -> str:
    """What the build was called with, as far as its file tells."""
    path = folder / BUILD_FILE
    try:
        settings = json.loads(path.read_text(encoding="utf-8").splitlines()[0])["settings"]
    except (OSError, ValueError, LookupError, TypeError):
        return "The folder does not tell the settings of a build: these tasks were imported."
    told = ", ".join(f"{name} `{value}`" for name, value in settings.items() if name != "scenes")
    return f"`embomatrix factory`, settings: {told}, {len(settings.get('scenes', ()))} scenes."


def _size(count: int) -> str:
    """The bracket of sizes that hubs know."""
    for limit, name in ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K")):
        if count < limit:
            return name
    return "n>100K"
