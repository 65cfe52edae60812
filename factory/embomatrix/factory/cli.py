"""``embomatrix factory``: build datasets of verified tasks, import BDDL, list what a dataset holds."""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from embomatrix.factory.assets_cli import app as assets_app
from embomatrix.factory.evaluate.cli import app as evaluate_app
from embomatrix.factory.pipeline.build import Summary, build_dataset
from embomatrix.factory.pipeline.settings import DEFAULT_SCENES, BuildSettings, WriterKind
from embomatrix.factory.refusal import Refusal
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.social.asking import Asked, asked_writer
from embomatrix.factory.task_import.batch import Verified, bind_first, verify_first
from embomatrix.factory.task_import.sources import (
    SourceError,
    SourceText,
    activity_names,
    read_activity,
    read_file,
    read_jsonl,
)
from embomatrix.llm.ledger import Price
from embomatrix.llm.values import LlmError
from embomatrix.sim.engine import EngineMissingError
from embomatrix.sim.physical.survey import Foresight
from embomatrix.sim.pose_cache import PlacementLibrary
from embomatrix.world.bddl import BddlError, parse_problem
from embomatrix.world.catalog import Catalog, CatalogError
from embomatrix.world.dataset import TASKS_FILE, Dataset, DatasetError, write_dataset
from embomatrix.world.task import TaskCategory

if TYPE_CHECKING:
    from collections.abc import Iterator

    from embomatrix.factory.task_import.task import Imported
    from embomatrix.factory.writer.tasks import TaskWriter
    from embomatrix.llm.ledger import Ledger
    from embomatrix.world.scene import Scene

app = typer.Typer(
    help="Make verified tasks.", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False
)
app.add_typer(assets_app, name="assets")
app.add_typer(evaluate_app, name="evaluate")
EVERY_ACTIVITY = "all"
MOST_JOBS = 8
"""Each holds some scenes: a few hundred MB."""
EVERY_SCENE = "all"

Out = Annotated[Path, typer.Option(help="Folder for the dataset.")]
Seed = Annotated[int, typer.Option(min=0, help="Equal seeds give equal datasets.")]
Scenes = Annotated[
    list[str] | None,
    typer.Option("--scenes", "--scene", help="Base scene, or 'all'; give it again for more."),
]
Jobs = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Processes; the dataset is the same for any number. Default: one for each core, at most 8.",
    ),
]
LookAhead = Annotated[
    bool,
    typer.Option(
        help="Find out what the robot's arm can do in each scene, so that rollouts promise no more: three quarters of the time."
    ),
]


@app.command()
def build(
    out: Out,
    train: Annotated[int, typer.Option(min=0, help="Tasks to train on.")] = 480,
    heldout: Annotated[int, typer.Option(min=0, help="Tasks to evaluate on, in other rooms.")] = 40,
    seed: Seed = 0,
    scenes: Scenes = None,
    jobs: Jobs = None,
    look_ahead: LookAhead = True,
) -> None:
    """Write tasks over base scenes, keep those that the oracle solves, and save them with their scenes."""
    settings = BuildSettings(train, heldout, seed, _scene_ids(scenes), look_ahead=look_ahead)
    _make(out, settings, jobs=jobs)


@app.command()
def generate(
    out: Out,
    tasks: Annotated[int, typer.Option(min=0, help="Tasks to train on.")] = 480,
    heldout: Annotated[int, typer.Option(min=0, help="Tasks to evaluate on, in other rooms.")] = 0,
    seed: Seed = 0,
    scenes: Scenes = None,
    jobs: Jobs = None,
    look_ahead: LookAhead = True,
    llm: Annotated[
        str, typer.Option(help="Base URL of an OpenAI-compatible endpoint, such as http://127.0.0.1:8000/v1.")
    ] = "",
    model: Annotated[str, typer.Option(help="Name of the model there.")] = "",
    key: Annotated[str, typer.Option("--llm-key", envvar="EMBOMATRIX_LLM_KEY", help="Its key.")] = "",
    cassette: Annotated[
        Path | None,
        typer.Option(help="File of recorded answers: read where it has them, added to where not."),
    ] = None,
    price: Annotated[
        tuple[float, float], typer.Option(help="Of a million tokens, in and out, for the account.")
    ] = (0.0, 0.0),
) -> None:
    """Play the people of each scene, and make tasks of what they come to ask the robot for; keep what they said."""
    names = _scene_ids(scenes)
    if not llm and cassette is None:
        _make(out, BuildSettings(tasks, heldout, seed, names, WriterKind.SOCIAL, look_ahead), jobs=jobs)
        return
    if llm and not model:
        _fail("--llm needs the name of a model there: give --model")
    asked = Asked(llm, model, key, cassette, Price(*price), out / "ledger.jsonl")
    with _mended(out), asked_writer(asked) as (writer, ledger):
        _make(out, BuildSettings(tasks, heldout, seed, names, WriterKind.MODEL, look_ahead), writer)
        _print_account(ledger)


def _print_account(ledger: Ledger) -> None:
    """What the model was asked, by agent."""
    table = Table("agent", "calls", "failed", "retries", "tokens in", "tokens out", "seconds", "cost")
    for purpose, account in (*ledger.accounts.items(), ("all", ledger.total())):
        counts = (
            account.calls,
            account.failed,
            account.retries,
            account.prompt_tokens,
            account.completion_tokens,
        )
        table.add_row(purpose, *map(str, counts), f"{account.seconds:.1f}", f"{account.cost:.4f}")
    Console().print(table)


def _make(
    out: Path, settings: BuildSettings, writer: TaskWriter | None = None, jobs: int | None = None
) -> None:
    """A data set in the folder, with progress and a summary."""
    console = Console()
    kept = f": what was built is kept in {out}, and the same command goes on from there"
    with _mended(out, kept), _progress(console) as bars:
        tasks = {
            "heldout": bars.add_task("held-out tasks", total=settings.heldout),
            "train": bars.add_task("training tasks", total=settings.train),
        }
        summary = build_dataset(
            out,
            settings,
            lambda split, admitted: bars.update(tasks[split], completed=admitted),
            writer,
            jobs or min(MOST_JOBS, len(os.sched_getaffinity(0))),
        )
        for split, bar in tasks.items():
            bars.update(bar, completed=summary.total(split))
    _print_summary(console, summary)
    console.print(f"dataset: {out}", highlight=False)
    for split, wanted in (("train", settings.train), ("heldout", settings.heldout)):
        if summary.total(split) < wanted:
            _fail(
                f"only {summary.total(split)} of {wanted} {split} tasks were admitted: see {out}/rejections.jsonl, "
                "or give more scenes"
            )


@app.command("import")
def import_(
    bddl: Annotated[Path | None, typer.Option(help="A BDDL problem file.")] = None,
    activity: Annotated[str, typer.Option(help="An activity of the bddl package, or 'all'.")] = "",
    jsonl: Annotated[Path | None, typer.Option(help="Records with 'name' and 'bddl'.")] = None,
    scenes: Scenes = None,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option(help="Folder for the admitted tasks.")] = None,
    bind_only: Annotated[bool, typer.Option("--bind-only", help="Leave out the verification.")] = False,
) -> None:
    """Bind BDDL problems to base scenes and verify them, or say why not."""
    console = Console()
    with _mended(out):
        if out is not None:
            _check_free(out, bind_only=bind_only)
        sources = [_parsed(source) for source in _sources(bddl, activity, jsonl)]
        bases = [build_base_scene(scene_id) for scene_id in _scene_ids(scenes)]
        outcomes = _judged(console, sources, bases, seed, bind_only=bind_only)
        verified = [item for item in outcomes if isinstance(item, Verified)]
        if out is not None and verified:
            write_dataset(
                out,
                [item.record for item in verified],
                {item.record.bundle_digest: item.bundle for item in verified},
            )
    if len(sources) == 1:
        _print_one(console, sources[0], outcomes[0])
        return
    _print_outcomes(console, outcomes)
    if out is not None and not verified:
        _fail(f"no problem was admitted, so {out} was not written: `--bind-only` shows which could be bound")


@app.command("list")
def list_(folder: Annotated[Path, typer.Argument(help="Folder of a dataset.")]) -> None:
    """Show the tasks of a dataset."""
    with _mended():
        dataset = Dataset.load(folder)
    table = Table("task", "split", "category", "rows", "steps", "instruction")
    for record in dataset.records:
        task = record.task
        table.add_row(
            task.task_id,
            record.split,
            task.category.value,
            str(len(task.table)),
            str(len(record.oracle)),
            task.instruction,
        )
    Console().print(table)


def _scene_ids(scenes: list[str] | None) -> tuple[str, ...]:
    """The scenes asked for, without repetition; "all" stands for every base scene of the catalog."""
    if scenes and EVERY_SCENE in scenes:
        return Catalog.load().scene_ids
    return tuple(dict.fromkeys(scenes or DEFAULT_SCENES))


def _check_free(out: Path, *, bind_only: bool) -> None:
    """Nothing that is already there is overwritten, and nothing that could not be written is begun."""
    if bind_only:
        raise SourceError("--bind-only admits no task that could be written: leave out --bind-only or --out")
    if (out / TASKS_FILE).exists():
        raise SourceError(f"{out} holds a dataset already: name another folder with --out")
    out.mkdir(parents=True, exist_ok=True)


def _parsed(source: SourceText) -> SourceText:
    """The source, whose text is BDDL: what is not shall be told before scenes are built."""
    try:
        parse_problem(source.text)
    except BddlError as error:
        raise SourceError(f"{source.name}: {error}") from error
    return source


def _sources(bddl: Path | None, activity: str, jsonl: Path | None) -> Iterator[SourceText]:
    if sum(map(bool, (bddl, activity, jsonl))) != 1:
        raise SourceError(
            f"found {sum(map(bool, (bddl, activity, jsonl)))} sources: expected exactly one of --bddl FILE, "
            "--activity NAME and --jsonl FILE"
        )
    if bddl is not None:
        yield read_file(bddl)
    elif jsonl is not None:
        yield from read_jsonl(jsonl)
    elif activity == EVERY_ACTIVITY:
        yield from map(read_activity, activity_names())
    else:
        yield read_activity(activity)


def _judged(
    console: Console, sources: list[SourceText], bases: list[Scene], seed: int, *, bind_only: bool
) -> list[Imported | Verified | Refusal]:
    outcomes: list[Imported | Verified | Refusal] = []
    with _progress(console) as bars, contextlib.closing(PlacementLibrary()) as library:
        bar = bars.add_task("problems", total=len(sources))
        foresight = Foresight()
        for source in sources:
            if bind_only:
                outcomes.append(bind_first(source, bases, seed=seed))
            else:
                outcomes.append(verify_first(source, bases, library, foresight, seed=seed))
            bars.advance(bar)
    return outcomes


def _print_one(console: Console, source: SourceText, outcome: Imported | Verified | Refusal) -> None:
    if isinstance(outcome, Refusal):
        _fail(f"{source.name} is refused ({outcome.reason}): {outcome.sentence}")
    task = outcome.record.task if isinstance(outcome, Verified) else outcome.task
    console.print(
        f"{task.task_id}: {task.instruction}\n  goal: {task.goal_bddl}", highlight=False, markup=False
    )
    if isinstance(outcome, Verified):
        for call in outcome.record.oracle:
            console.print("  " + " ".join(map(str, call.values())), highlight=False, markup=False)


def _print_outcomes(console: Console, outcomes: list[Imported | Verified | Refusal]) -> None:
    counts = Counter(
        f"refused: {item.reason}" if isinstance(item, Refusal) else type(item).__name__.lower()
        for item in outcomes
    )
    table = Table("outcome", "problems")
    for outcome, count in counts.most_common():
        table.add_row(outcome, str(count))
    console.print(table)


def _print_summary(console: Console, summary: Summary) -> None:
    table = Table("category", "train", "held out")
    for category in TaskCategory:
        table.add_row(
            category.value,
            *(str(summary.admitted.get((split, category.value), 0)) for split in ("train", "heldout")),
        )
    table.add_row("all", str(summary.total("train")), str(summary.total("heldout")))
    console.print(table)
    scenes = Table("scene", "train", "held out", "held-out rooms")
    for scene in summary.rooms["train"]:
        counts = (str(summary.scenes.get((split, scene), 0)) for split in ("train", "heldout"))
        scenes.add_row(scene, *counts, ", ".join(summary.rooms["heldout"][scene]))
    console.print(scenes)
    refused = ", ".join(f"{count} {reason}" for reason, count in sorted(summary.rejected.items())) or "none"
    console.print(
        f"{summary.variants} scene variants; drafts that were not admitted: {refused}", highlight=False
    )


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=console,
    )


@contextlib.contextmanager
def _mended(out: Path | None = None, kept: str = "") -> Iterator[None]:
    """What a person can mend is one sentence and exit status 2, an interrupt one and 130.

    ``out`` is the folder that is written, ``kept`` what an interrupt leaves in it.
    """
    try:
        yield
    except (CatalogError, DatasetError, EngineMissingError, LlmError, SourceError) as error:
        _fail(str(error))
    except OSError as error:
        if out is None:
            raise
        _fail(f"the folder {out} can't be written ({error.strerror}): make room, or name another with --out")
    except KeyboardInterrupt:
        _fail(f"interrupted{kept}", status=130)


def _fail(sentence: str, status: int = 2) -> NoReturn:
    Console(stderr=True).print(
        f"embomatrix factory: {sentence}", highlight=False, markup=False, soft_wrap=True
    )
    raise typer.Exit(status) from None
