"""``embomatrix factory inspect``: a task as a page to be looked at."""

from __future__ import annotations

import difflib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from embomatrix.factory.commands.terminal import mended, progress
from embomatrix.factory.inspection.page import scene_jpeg, scene_picture, task_page
from embomatrix.factory.inspection.playing import play_oracle
from embomatrix.factory.pipeline.store import TRANSCRIPTS_FOLDER, TREES_FOLDER
from embomatrix.world.dataset import Dataset, DatasetError, bundle_file
from embomatrix.world.whole_file import check_writable, write_whole

if TYPE_CHECKING:
    from embomatrix.world.dataset import TaskRecord

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
PICTURES_FOLDER = "pictures"
CARD_PX = (720, 540)


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


@app.command()
def pictures(
    dataset: Annotated[Path, typer.Argument(help="Folder of the dataset.")],
) -> None:
    """Draw the scene of each bundle into the dataset, for the dashboard's gallery; those that are there stay."""
    console = Console()
    folder = dataset / PICTURES_FOLDER
    with mended(folder, kept=": pictures that are drawn are kept"):
        loaded = Dataset.load(dataset)
        missing = {
            digest: file
            for digest in dict.fromkeys(record.bundle_digest for record in loaded.records)
            if not (file := (folder / bundle_file(digest)).with_suffix(".jpg")).exists()
        }
        folder.mkdir(exist_ok=True)
        with progress(console) as bars:
            for digest, file in bars.track(missing.items(), description="pictures"):
                write_whole(file, scene_jpeg(loaded.read_bundle(digest).scene, CARD_PX))
    console.print(f"{len(missing)} pictures: {folder}", highlight=False, markup=False)


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
