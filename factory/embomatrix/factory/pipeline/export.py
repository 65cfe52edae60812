"""Export of a dataset for other tools: one row per task as JSON lines or Parquet, with a dataset card."""

import hashlib
import io
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from embomatrix.factory.pipeline.merge import MERGED_FILE, MergeSource
from embomatrix.factory.pipeline.store import TRANSCRIPTS_FOLDER, build_settings
from embomatrix.factory.scenes.build import base_scene_of
from embomatrix.world.dataset import Dataset, DatasetError, TaskRecord
from embomatrix.world.json_text import parse_json

FIELDS: Final[Mapping[str, str]] = {
    "task_id": "unique id in the dataset",
    "split": "`train` or `heldout`",
    "scene_id": "scene variant of the task; tasks of one variant share a bundle",
    "base_scene": "BEHAVIOR-1K inventory that the scene was built from",
    "rooms": "rooms of the goal's objects",
    "category": "`pick_and_place`, `appliance_use`, `kitchen_operation` or `compound`",
    "instruction": "request in natural language",
    "goal": "BDDL over the scene's objects",
    "signature": "kind of goal: its predicates over categories",
    "table": "objects that a plan may name, by row",
    "types": "JSON: object names by synset, the domain of the goal's quantifiers",
    "oracle": "JSON: plan that reaches the goal, verified in the simulator",
    "oracle_steps": "number of calls of the oracle plan",
    "difficulty": "`easy`, `medium` or `hard` by the scripts that solve it; empty if it was not measured",
    "profile": "skill profile of the task",
    "source": "origin of the task",
    "bundle": "digest of the bundle; bundles are not part of the export",
    "transcript": "Markdown: conversation behind the request, empty if there is none",
}
OWN_SOURCES: Final = frozenset(("writer", "society"))
"""Sources of tasks that the factory wrote; all others are imported."""
MIT_SOURCES: Final = OWN_SOURCES | {"behavior-1k", "embomatrix"}
"""Sources of tasks whose text is under the MIT licence."""
CARD_MARK: Final = "pretty_name: EmboMatrix tasks"
"""Line in the header of each card."""
SUFFIXES: Final = (".jsonl", ".parquet")


def export_rows(dataset: Dataset) -> list[dict[str, Any]]:
    """Return a row for each task with the fields of ``FIELDS`` in their order."""
    return [_row(dataset, record) for record in dataset.records]


def _row(dataset: Dataset, record: TaskRecord) -> dict[str, Any]:
    task = record.task
    transcript = dataset.folder / TRANSCRIPTS_FOLDER / f"{task.task_id}.md"
    return {
        "task_id": task.task_id,
        "split": record.split,
        "scene_id": task.scene_id,
        "base_scene": base_scene_of(task.scene_id),
        "rooms": list(record.rooms),
        "category": task.category.value,
        "instruction": task.instruction,
        "goal": task.goal_bddl,
        "signature": record.signature,
        "table": list(task.table),
        "types": json.dumps({name: list(members) for name, members in task.types.items()}),
        "oracle": json.dumps([dict(call) for call in record.oracle]),
        "oracle_steps": len(record.oracle),
        "difficulty": "" if record.difficulty is None else record.difficulty.level.value,
        "profile": task.profile.value,
        "source": task.source,
        "bundle": record.bundle_digest,
        "transcript": transcript.read_text(encoding="utf-8") if transcript.is_file() else "",
    }


def task_schema(arrow: Any) -> Any:
    """Return the schema of task rows for a module ``pyarrow``."""
    text, texts = arrow.string(), arrow.list_(arrow.string())
    kinds = {"rooms": texts, "table": texts, "oracle_steps": arrow.int32()}
    return arrow.schema([(name, kinds.get(name, text)) for name in FIELDS])


def encode_rows(
    rows: Sequence[Mapping[str, Any]], suffix: str, schema_of: Callable[[Any], Any] = task_schema
) -> bytes:
    """Encode the rows as a file. Raise DatasetError for an unknown suffix, or if pyarrow is missing.

    ``schema_of`` returns the schema of a Parquet file for a module ``pyarrow``.
    """
    if suffix == ".jsonl":
        return "".join(f"{json.dumps(row, ensure_ascii=False)}\n" for row in rows).encode("utf-8")
    if suffix != ".parquet":
        raise DatasetError(f"the file's suffix is {suffix!r}: expected {' or '.join(SUFFIXES)}")
    try:
        arrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError as error:
        raise DatasetError(
            "Parquet needs the package pyarrow: install it with `pip install 'embomatrix[export]'`, or export to .jsonl"
        ) from error
    out = io.BytesIO()
    parquet.write_table(arrow.Table.from_pylist(list(rows), schema=schema_of(arrow)), out, compression="zstd")
    return out.getvalue()


def dataset_card(dataset: Dataset, file_name: str, data: bytes) -> str:
    """Return the dataset card in Markdown, with the header that dataset hubs read."""
    records = dataset.records
    scenes = {base_scene_of(record.task.scene_id) for record in records}
    kinds = {record.signature for record in records}
    lines = [
        "---",
        "language: en",
        CARD_MARK,
        *_licence(records),
        "task_categories: [robotics]",
        *_configs(file_name),
        f"size_categories: {_size(len(records))}",
        "---",
        "# EmboMatrix tasks",
        "",
        f"{len(records):,} household tasks in {len(scenes)} base scenes, each with an oracle plan that reaches the "
        f"goal in the simulator. {len(kinds):,} kinds of goals.",
        "",
        f"{_file_line(file_name)}, SHA-256 `{hashlib.sha256(data).hexdigest()}`.",
        "",
        *_counts(records),
        "",
        "| field | content |",
        "| --- | --- |",
        *(f"| `{name}` | {words} |" for name, words in FIELDS.items()),
        "",
        "## Settings",
        "",
        _settings(dataset),
        "",
        "## Load it",
        "",
        *_example(file_name),
        "",
        "## Licences",
        "",
        _LICENCES,
        "",
        "## Sources and limits",
        "",
        _SOURCES,
        "",
    ]
    return "\n".join(lines)


def is_card_of(text: str, file_name: str) -> bool:
    """True if the text is the card that was written beside an export of this name."""
    return CARD_MARK in text.splitlines() and _file_line(file_name) in text


def _file_line(file_name: str) -> str:
    return f"File: `{file_name}`"


def _counts(records: Sequence[TaskRecord]) -> list[str]:
    """Return a table of the number of tasks by category and split."""
    categories = Counter((record.task.category.value, record.split) for record in records)
    splits = Counter(record.split for record in records)
    lines = ["| category | train | heldout |", "| --- | ---: | ---: |"]
    for category in sorted({category for category, _ in categories}):
        counts = " | ".join(f"{categories[category, split]:,}" for split in ("train", "heldout"))
        lines.append(f"| {category} | {counts} |")
    return [*lines, f"| all | {splits['train']:,} | {splits['heldout']:,} |"]


_LICENCES: Final = (
    "Names, categories, sizes and room inventories derive from the catalog of PyPI `bddl` 3.6.0: MIT licence, copyright "
    "Stanford Vision and Learning Lab; keep this notice with copies. Instructions, goals, plans and transcripts are under the "
    "MIT licence of the EmboMatrix project. Tasks whose source is neither `writer` nor `society` come from BDDL problems of "
    "others, and their text is under the licence of that source: MIT for `behavior-1k` and `embomatrix`; ask the author for "
    "`eai` and `file`."
)

_SOURCES: Final = (
    "Scenes, categories, sizes and masses come from the BEHAVIOR-1K knowledge base (PyPI `bddl` 3.6.0, MIT, Stanford Vision "
    "and Learning Lab). People, conversations and instructions are fictional, generated by a grammar unless the settings "
    "name a language model. Geometry is generated; no third-party meshes are included. Each oracle plan reaches its goal in "
    "kinematic execution, and in stepped physics if the settings say `physical`; a robot with noise, slip or perception may "
    "still fail."
)


def _settings(dataset: Dataset) -> str:
    """Describe the settings of the build if its log exists, else the origin as far as it is known."""
    try:
        settings = build_settings(dataset.folder)
    except DatasetError:
        return merge_in_words(dataset.folder) or _origin(dataset.records)
    listed = ", ".join(f"{name} `{value}`" for name, value in settings.items() if name != "scenes")
    return f"`embomatrix factory`, settings: {listed}, {len(settings.get('scenes', ()))} scenes."


def _origin(records: Sequence[TaskRecord]) -> str:
    """Return a sentence about tasks in a folder without settings. Only imported tasks are written without any."""
    if not any(record.task.source in OWN_SOURCES for record in records):
        return "The folder holds no build settings: these tasks were imported."
    return "The folder holds no build settings: they are unknown."


def merge_in_words(folder: Path) -> str:
    """Describe the sources of a merged dataset; empty for any other."""
    path = folder / MERGED_FILE
    if not path.is_file():
        return ""
    try:
        sources = [MergeSource(**value) for value in parse_json(path.read_bytes())]
    except (ValueError, TypeError) as error:
        raise DatasetError(
            f"{path} does not list the sources of a merge ({error}): merge the datasets again"
        ) from error
    listed = "; ".join(f"`{each.name}`, {each.tasks:,} tasks, `{each.digest}`" for each in sources)
    return f"`embomatrix factory merge` of {listed}."


def _licence(records: Sequence[TaskRecord]) -> list[str]:
    """Return the header lines about the licence. Problems of other authors have licences of their own."""
    if {record.task.source for record in records} <= MIT_SOURCES:
        return ["license: mit"]
    return ["license: other", "license_name: licences-of-the-tasks-sources"]


def _configs(file_name: str) -> list[str]:
    """Return the header lines by which dataset hubs find the file."""
    return [
        "configs:",
        "  - config_name: default",
        "    data_files:",
        f"      - {{split: tasks, path: {file_name}}}",
    ]


def _example(file_name: str) -> list[str]:
    """Return code that reads the file with two libraries."""
    kind = "parquet" if file_name.endswith(".parquet") else "json"
    reader = (
        [f'table = pyarrow.parquet.read_table("{file_name}")  # import pyarrow.parquet']
        if kind == "parquet"
        else []
    )
    return [
        "```python",
        f'rows = datasets.load_dataset("{kind}", data_files="{file_name}", split="train")  # import datasets',
        *reader,
        "```",
        "",
        "The library calls the whole file `train`; the field `split` separates training tasks from held-out ones.",
    ]


def _size(count: int) -> str:
    """Return the size bracket of dataset hubs."""
    brackets = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
    return next((name for limit, name in brackets if count < limit), "1M<n<10M")
