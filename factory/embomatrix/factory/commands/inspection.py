"""``embomatrix factory inspect`` and ``pictures``: HTML page of a task, pictures of a dataset's scenes."""

from pathlib import Path
from typing import Annotated, Any

import typer

from embomatrix.factory.commands.terminal import progress, say, user_errors
from embomatrix.factory.inspection.page import scene_jpeg, scene_picture, task_page
from embomatrix.factory.inspection.playing import play_oracle
from embomatrix.factory.pipeline.store import TRANSCRIPTS_FOLDER, TREES_FOLDER
from embomatrix.host.own_files import PAGE_MARK, Force, keep_foreign, prepare_output
from embomatrix.starter.options import DEFAULT_DATASET, DatasetFolder, DatasetOrShipped
from embomatrix.starter.shipped import open_dataset
from embomatrix.world.dataset import Dataset, bundle_file
from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import write_whole

PICTURES_FOLDER = "pictures"
CARD_PX = (720, 540)


def inspect(
    task: Annotated[str, typer.Argument(help="Id of the task, as `factory list` shows it.")],
    dataset: DatasetOrShipped = None,
    out: Annotated[
        Path | None, typer.Option(help="File for the page. Default: TASK.html in the current folder.")
    ] = None,
    picture: Annotated[bool, typer.Option(help="Include a rendered picture of the scene.")] = True,
    force: Force = False,
) -> None:
    """Write a task as one HTML file: instruction, transcript, layout, objects, and the oracle's plan step by step."""
    file = out or Path(f"{task}.html")
    with user_errors(file):
        loaded = open_dataset(dataset)
        record = loaded.find(task)
        if out is None:
            keep_foreign("", [file], PAGE_MARK, force=force)
        prepare_output("factory inspect", file)
        bundle = loaded.bundle(record.bundle_digest)
        transcript = _text(loaded.folder / TRANSCRIPTS_FOLDER / f"{task}.md")
        tree = _text(loaded.folder / TREES_FOLDER / f"{task}.json")
        page = task_page(
            record,
            bundle.scene,
            play_oracle(record, bundle),
            transcript,
            _tree_in(tree),
            scene_picture(bundle.scene) if picture else "",
        )
        write_whole(file, page.encode("utf-8"))
    say(f"page: {file}")


def pictures(dataset: DatasetFolder = DEFAULT_DATASET) -> None:
    """Render the scene of each bundle for the dashboard's gallery. Existing pictures are kept."""
    folder = dataset / PICTURES_FOLDER
    with user_errors(folder, kept=": finished pictures are kept"):
        loaded = Dataset.load(dataset)
        missing = {
            digest: file
            for digest in dict.fromkeys(record.bundle_digest for record in loaded.records)
            if not (file := (folder / bundle_file(digest)).with_suffix(".jpg")).exists()
        }
        folder.mkdir(exist_ok=True)
        with progress() as bars:
            for digest, file in bars.track(missing.items(), description="pictures"):
                write_whole(file, scene_jpeg(loaded.read_bundle(digest).scene, CARD_PX))
    say(f"{len(missing)} pictures: {folder}")


def _tree_in(text: str) -> Any:
    """Return a layout tree; None for text that is none."""
    try:
        return parse_json(text) if text else None
    except ValueError:
        return None


def _text(path: Path) -> str:
    """Return the text of an optional file, or an empty string."""
    return path.read_text(encoding="utf-8") if path.is_file() else ""
