"""``embomatrix factory inspect``: a task as a page to be looked at."""

from __future__ import annotations

import difflib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from embomatrix.factory.inspection.page import scene_picture, task_page
from embomatrix.factory.inspection.playing import play_oracle
from embomatrix.factory.pipeline.store import TRANSCRIPTS_FOLDER
from embomatrix.factory.terminal import mended
from embomatrix.world.dataset import Dataset, DatasetError
from embomatrix.world.whole_file import check_writable, write_whole

if TYPE_CHECKING:
    from embomatrix.world.dataset import TaskRecord

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
TREES_FOLDER = "trees"
"""Of a dataset whose scenes were laid out by tree: JSON by task."""


@app.command()
def inspect(
    task: Annotated[str, typer.Argument(help="Id of the task, as `factory list` shows it.")],
    dataset: Annotated[Path, typer.Option(help="Folder of the dataset.")] = Path("build/dataset"),
    out: Annotated[Path | None, typer.Option(help="File for the page. Default: TASK.html here.")] = None,
    picture: Annotated[bool, typer.Option(help="Draw the scene into the page as well.")] = True,
) -> None:
    """Write one task as one HTML file: what is asked and why, layout, objects, the oracle's plan step by step."""
    file = out or Path(f"{task}.html")
    with mended(file):
        loaded = Dataset.load(dataset)
        record = _record(loaded, task)
        check_writable(file)
        bundle = loaded.bundle(record.bundle_digest)
        transcript = _text(dataset / TRANSCRIPTS_FOLDER / f"{task}.md")
        tree = _text(dataset / TREES_FOLDER / f"{task}.json")
        page = task_page(
            record,
            bundle.scene,
            play_oracle(record, bundle),
            transcript,
            json.loads(tree) if tree else None,
            scene_picture(bundle.scene) if picture else "",
        )
        write_whole(file, page.encode("utf-8"))
    Console().print(f"page: {file}", highlight=False, markup=False)


def _record(dataset: Dataset, task_id: str) -> TaskRecord:
    found = {record.task.task_id: record for record in dataset.records}
    if task_id not in found:
        close = difflib.get_close_matches(task_id, found, n=3, cutoff=0.3)
        hint = f"did you mean {', '.join(close)}?" if close else "see `embomatrix factory list`"
        raise DatasetError(f"{dataset.folder} holds no task {task_id!r}: {hint}")
    return found[task_id]


def _text(path: Path) -> str:
    """Content of a file that a dataset may have; empty where it has none."""
    return path.read_text(encoding="utf-8") if path.is_file() else ""
