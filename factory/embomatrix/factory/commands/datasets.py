"""``embomatrix factory list``, ``prompts`` and ``export``: read a dataset and show it or write it for others."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from embomatrix.factory.commands.terminal import fail, say, user_errors
from embomatrix.factory.evaluate.readings import prompts_of
from embomatrix.factory.pipeline.export import dataset_card, encode_rows, export_rows, is_card_of
from embomatrix.factory.scenes.build import base_scene_of
from embomatrix.host.own_files import Force, prepare_output
from embomatrix.host.printable import printable
from embomatrix.starter.options import DEFAULT_DATASET, DatasetOrName, DatasetOrShipped
from embomatrix.starter.shipped import open_dataset
from embomatrix.world.dataset import SPLITS, TaskRecord
from embomatrix.world.task import TaskCategory
from embomatrix.world.whole_file import write_whole


def list_(
    dataset: DatasetOrShipped = None,
    split: Annotated[str, typer.Option(help="Only tasks of this split: train or heldout.")] = "",
    scene: Annotated[
        str, typer.Option(help="Only tasks of this base scene, such as Rs_int, or of one of its variants.")
    ] = "",
    category: Annotated[TaskCategory | None, typer.Option(help="Only tasks of this category.")] = None,
    search: Annotated[str, typer.Option(help="Only tasks with this text in instruction, goal or id.")] = "",
    page: Annotated[int, typer.Option(min=1, help="Page to show.")] = 1,
    limit: Annotated[int, typer.Option(min=1, help="Tasks of a page.")] = 20,
    as_json: Annotated[bool, typer.Option("--json", help="Print all selected tasks as JSON.")] = False,
) -> None:
    """List the tasks of a dataset, page by page."""
    with user_errors():
        if split not in ("", *SPLITS):
            fail(f"--split {split!r}: expected {' or '.join(SPLITS)}")
        records = open_dataset(dataset).records
    found = list(_selected(records, split, scene, category, search))
    if as_json:
        typer.echo(json.dumps([_in_json(record) for record in found], indent=1))
        return
    shown = found[(page - 1) * limit : page * limit]
    for record in shown:
        _show(record)
    _show_position(len(found), len(records), page, limit, len(shown))


def _selected(
    records: Sequence[TaskRecord], split: str, scene: str, category: TaskCategory | None, search: str
) -> Iterator[TaskRecord]:
    for record in records:
        task = record.task
        text = f"{task.task_id} {task.instruction} {task.goal_bddl}".lower()
        if (
            split in ("", record.split)
            and scene in ("", task.scene_id, base_scene_of(task.scene_id))
            and category in (None, task.category)
            and search.lower() in text
        ):
            yield record


def _in_json(record: TaskRecord) -> dict[str, Any]:
    task = record.task
    return {
        "task": task.task_id,
        "split": record.split,
        "scene": task.scene_id,
        "category": task.category.value,
        "rows": len(task.table),
        "steps": len(record.oracle),
        "difficulty": None if record.difficulty is None else record.difficulty.level.value,
        "instruction": task.instruction,
        "goal": task.goal_bddl,
    }


def _show(record: TaskRecord) -> None:
    """Print a task on two or more lines, however narrow the terminal is; its id is never cut."""
    task, level = record.task, "" if record.difficulty is None else f" · {record.difficulty.level}"
    about = f"{record.split} · {task.category} · {len(task.table)} rows · {len(record.oracle)} steps{level}"
    console = Console()
    console.print(Text(printable(task.task_id), style="bold"), soft_wrap=True)
    for text, style in ((about, "dim"), (printable(task.instruction), "")):
        console.print(Padding(Text(text, style=style), (0, 0, 0, 2)))


def _show_position(found: int, all_: int, page: int, limit: int, shown: int) -> None:
    if not found:
        say(f"no task of {all_:,} fits: leave out --split, --scene, --category or --search")
        return
    if not shown:
        say(f"{found:,} tasks have {-(-found // limit)} pages: found --page {page}")
        return
    first = (page - 1) * limit + 1
    more = f"; --page {page + 1} shows more" if first + shown - 1 < found else ""
    say(f"tasks {first:,} to {first + shown - 1:,} of {found:,}{more}")


def prompts(
    out: Annotated[Path, typer.Option(help="Text file to write.")],
    dataset: DatasetOrName = DEFAULT_DATASET,
    tasks: Annotated[int, typer.Option(min=1, help="Number of held-out tasks.")] = 40,
) -> None:
    """Write the prompts of held-out tasks, without their goals, for a person or a model to answer."""
    prepare_output("factory prompts", out)
    with user_errors(out):
        write_whole(out, prompts_of(open_dataset(dataset), tasks).encode("utf-8"))
    say(f"prompts: {out}; `factory evaluate readings` judges the answers")


def export(
    out: Annotated[
        Path,
        typer.Option(help="File to write, .jsonl or .parquet. The card, README.md, is written beside it."),
    ],
    dataset: DatasetOrName = DEFAULT_DATASET,
    force: Force = False,
) -> None:
    """Export a dataset for other tools, one row per task, with a dataset card."""
    card = out.with_name("README.md")
    with user_errors(out):
        found = open_dataset(dataset)
        data = encode_rows(export_rows(found), out.suffix)
        exported = card.exists() and is_card_of(card.read_text(encoding="utf-8", errors="replace"), out.name)
        foreign = [path for path in (card, out) if path.exists() and not exported]
        if foreign and not force:
            fail(
                f"{foreign[0]} was not written by an export to {out.name}: name a file in another folder, or pass --force to "
                "replace it"
            )
        prepare_output("factory export", out, card)
        write_whole(out, data)
        write_whole(card, dataset_card(found, out.name, data).encode("utf-8"))
    count = len(found.records)
    say(f"{count} task{'s' * (count != 1)}: {out}, card: {card}")
