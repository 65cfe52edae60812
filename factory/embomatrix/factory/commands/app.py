"""``embomatrix factory``: build datasets of verified tasks, import BDDL, list what a dataset holds."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Column, Table

from embomatrix.factory.commands.agents import agent
from embomatrix.factory.commands.asked_model import Key, Tape  # noqa: TC001  typer reads the annotations when a command runs
from embomatrix.factory.commands.assets import app as assets_app
from embomatrix.factory.commands.corpus import app as corpus_app
from embomatrix.factory.commands.evaluate import app as evaluate_app
from embomatrix.factory.commands.inspection import app as inspect_app
from embomatrix.factory.commands.layout import (
    Forms,
    Llm,
    Model,
    lay,
    modelled_agents,
    modelled_names,
)
from embomatrix.factory.commands.task_import import app as import_app
from embomatrix.factory.commands.terminal import fail, mended, progress
from embomatrix.factory.commands.verification import app as verify_app
from embomatrix.factory.pipeline.build import BuildSummary, VariantCheck, build_dataset
from embomatrix.factory.pipeline.cluster import ClusterCheck
from embomatrix.factory.pipeline.export import card, encoded, export_rows
from embomatrix.factory.pipeline.options import Jobs, Physical, is_proved, processes
from embomatrix.factory.pipeline.settings import SCENE_EXTRACTOR, BuildSettings, WriterKind, scene_ids
from embomatrix.factory.social.asking import ModelSource, asked_writer
from embomatrix.llm.ledger import Price
from embomatrix.llm.patience import FailureLimit
from embomatrix.world.dataset import Dataset
from embomatrix.world.task import TaskCategory
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from embomatrix.factory.layout.agent_interfaces import AgentName
    from embomatrix.factory.layout.request import LayoutAgents
    from embomatrix.factory.writer.tasks import TaskWriter
    from embomatrix.llm.ledger import Ledger

app = typer.Typer(
    help="Make verified tasks.", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False
)
app.add_typer(assets_app, name="assets")
app.add_typer(evaluate_app, name="evaluate")
app.command()(agent)
app.command()(lay)
app.add_typer(import_app)
app.add_typer(inspect_app)
app.add_typer(corpus_app)
app.add_typer(verify_app)

Out = Annotated[Path, typer.Option(help="Folder for the dataset.")]
Seed = Annotated[int, typer.Option(min=0, help="Equal seeds give equal datasets.")]
Scenes = Annotated[
    list[str] | None,
    typer.Option("--scenes", "--scene", help="Base scene, or 'all'; give it again for more."),
]
LookAhead = Annotated[
    bool,
    typer.Option(
        help="Find out what the robot's arm can do in each scene, so that rollouts promise no more: most of the time."
    ),
]

SocialLlm = Annotated[
    str,
    typer.Option(
        help="Base URL of an OpenAI-compatible endpoint, such as http://127.0.0.1:8000/v1: the social agents are its model."
    ),
]
PriceOfTokens = Annotated[
    tuple[float, float], typer.Option(help="Of a million tokens, in and out, for the account.")
]
ManagerAt = Annotated[
    str, typer.Option(help="HOST:PORT of a manager, on whose slots the oracle's plans are executed as well.")
]
Look = Annotated[
    bool,
    typer.Option("--look", help="Show the model a plan and views of each scene first: for models that see."),
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
    physical: Physical = None,
    forms: Forms = None,
    llm: Llm = "",
    model: Model = "",
    key: Key = "",
    cassette: Tape = None,
) -> None:
    """Write tasks over base scenes, keep those that the oracle solves, and save them with their scenes."""
    modelled = modelled_names(forms or [])
    if (llm or cassette) and not modelled:
        fail("--llm and --cassette are for layout agents here: say which, as --agent room-organizer=llm")
    settings = BuildSettings(
        train,
        heldout,
        seed,
        scene_ids(scenes),
        look_ahead=look_ahead,
        physical=is_proved(physical, look_ahead=look_ahead),
        modelled=tuple(sorted(modelled)),
    )
    with contextlib.ExitStack() as stack:
        stack.enter_context(mended(out))
        layout = _layout(stack, modelled, llm, model, key, cassette)
        _make(out, settings, jobs=jobs, layout=layout)


@app.command()
def generate(
    out: Out,
    tasks: Annotated[int, typer.Option(min=0, help="Tasks to train on.")] = 480,
    heldout: Annotated[int, typer.Option(min=0, help="Tasks to evaluate on, in other rooms.")] = 0,
    seed: Seed = 0,
    scenes: Scenes = None,
    jobs: Jobs = None,
    look_ahead: LookAhead = True,
    physical: Physical = None,
    forms: Forms = None,
    llm: SocialLlm = "",
    model: Model = "",
    key: Key = "",
    cassette: Tape = None,
    price: PriceOfTokens = (0.0, 0.0),
    manager: ManagerAt = "",
    look: Look = False,
    token: Annotated[str, typer.Option(envvar="EMBOMATRIX_TOKEN", help="Token for it.")] = "",
    ca: Annotated[Path | None, typer.Option(envvar="EMBOMATRIX_CA", help="Its ca.pem.")] = None,
) -> None:
    """Play the people of each scene, and make tasks of what they come to ask the robot for; keep what they said."""
    kind = WriterKind.MODEL if llm or cassette is not None else WriterKind.SOCIAL
    if llm and not model:
        fail("--llm needs the name of a model there: give --model")
    if look and kind is WriterKind.SOCIAL:
        fail("--look shows scenes to a language model: give --llm URL and --model NAME, or --cassette FILE")
    modelled = modelled_names(forms or [])
    told = sorted([*modelled, *[SCENE_EXTRACTOR] * look])
    proof = is_proved(physical, look_ahead=look_ahead)
    settings = BuildSettings(tasks, heldout, seed, scene_ids(scenes), kind, look_ahead, proof, tuple(told))
    with contextlib.ExitStack() as stack:
        stack.enter_context(mended(out))
        check = _second_judge(stack, manager, token, ca)
        layout = _layout(stack, modelled, llm, model, key, cassette)
        if kind is WriterKind.SOCIAL:
            _make(out, settings, jobs=jobs, check=check, layout=layout)
            return
        asked = ModelSource(llm, model, key, cassette, Price(*price), out / "ledger.jsonl", look)
        writer, ledger = stack.enter_context(asked_writer(asked))
        _make(out, settings, writer, check=check, layout=layout)
        _print_account(ledger)


def _second_judge(
    stack: contextlib.ExitStack, manager: str, token: str, ca: Path | None
) -> VariantCheck | None:
    """The cluster behind a manager, open as long as the stack is; None where there is none. Raises ClusterError, OSError."""
    if not manager:
        return None
    trusted = ca.read_bytes() if ca is not None else b""
    return stack.enter_context(ClusterCheck(manager, token, trusted)).check


def _layout(
    stack: contextlib.ExitStack,
    names: frozenset[AgentName],
    url: str,
    model: str,
    key: str,
    cassette: Path | None,
) -> LayoutAgents | None:
    """Layout agents of which these are a language model; None where all are rules."""
    if not names:
        return None
    return stack.enter_context(modelled_agents(url, model, key, cassette, FailureLimit())).agents(names)


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
    out: Path,
    settings: BuildSettings,
    writer: TaskWriter | None = None,
    jobs: int | None = None,
    check: VariantCheck | None = None,
    layout: LayoutAgents | None = None,
) -> None:
    """A data set in the folder, with progress and a summary."""
    console = Console()
    kept = f": what was built is kept in {out}, and the same command goes on from there"
    with mended(out, kept), progress(console) as bars:
        tasks = {
            "heldout": bars.add_task("held-out tasks", total=settings.heldout),
            "train": bars.add_task("training tasks", total=settings.train),
        }
        summary = build_dataset(
            out,
            settings,
            lambda split, admitted: bars.update(tasks[split], completed=admitted),
            writer,
            processes(jobs),
            check,
            layout,
        )
        for split, bar in tasks.items():
            bars.update(bar, completed=summary.total(split))
    _print_summary(console, summary)
    console.print(f"dataset: {out}", highlight=False)
    for split, wanted in (("train", settings.train), ("heldout", settings.heldout)):
        if summary.total(split) < wanted:
            fail(
                f"only {summary.total(split)} of {wanted} {split} tasks were admitted: see {out}/attempts.jsonl, "
                "or give more scenes"
            )


@app.command("list")
def list_(folder: Annotated[Path, typer.Argument(help="Folder of a dataset.")]) -> None:
    """Show the tasks of a dataset."""
    with mended():
        dataset = Dataset.load(folder)
    # a task's id is what other commands ask for: it is never cut short
    table = Table(Column("task", no_wrap=True), "split", "category", "rows", "steps", "instruction")
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


@app.command()
def export(
    folder: Annotated[Path, typer.Argument(help="Folder of a dataset.")],
    out: Annotated[Path, typer.Option(help="File to write, .jsonl or .parquet; the card goes beside it.")],
) -> None:
    """Write the tasks of a dataset for other tools, one row each, with a dataset card."""
    with mended(out):
        dataset = Dataset.load(folder)
        data = encoded(export_rows(dataset), out.suffix)
        write_whole(out, data)
        write_whole(out.with_name("README.md"), card(dataset, out.name, data).encode("utf-8"))
    Console().print(
        f"{len(dataset.records)} tasks: {out}, card: {out.with_name('README.md')}", highlight=False
    )


def _print_summary(console: Console, summary: BuildSummary) -> None:
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
