"""``embomatrix factory evaluate``: measure tasks and scenes, write figures, put them on the page of benchmarks."""

from __future__ import annotations

import asyncio
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import numpy as np
import typer
from rich.console import Console

from embomatrix.factory.commands.language_model import Key, Tape, chat_model
from embomatrix.factory.commands.terminal import progress, report_evaluation, user_errors
from embomatrix.factory.evaluate.admissions import admitted_share, evaluate_admissions
from embomatrix.factory.evaluate.drafts import asked_of
from embomatrix.factory.evaluate.judge import judged
from embomatrix.factory.evaluate.looks import evaluate_looks
from embomatrix.factory.evaluate.measure import evaluate_aesthetics, evaluate_tasks, written_for
from embomatrix.factory.evaluate.page import with_factory
from embomatrix.factory.evaluate.scene_runs import OutcomeLog, evaluate_scenes
from embomatrix.factory.evaluate.scenes import LayoutMethod, fixed_tasks
from embomatrix.factory.evaluate.side_by_side import draw_side_by_side, named
from embomatrix.factory.evaluate.tasks import panel, people_of
from embomatrix.factory.metrics.figures import (
    EvaluationError,
    EvaluationFigures,
    read_evaluation,
)
from embomatrix.factory.pipeline.corpus import training_scenes
from embomatrix.factory.pipeline.store import TRANSCRIPTS_FOLDER
from embomatrix.pages.figures import Better, Figure
from embomatrix.world.dataset import Dataset
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence

    from embomatrix.factory.evaluate.drafts import DraftFeatures
    from embomatrix.llm.values import ChatModel

app = typer.Typer(
    help="Measure tasks and scenes; figures go to JSON and to the page of benchmarks.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
PAGE = Path("docs/benchmarks.md")
JsonFile = Annotated[Path | None, typer.Option("--json", help="File for the figures.")]
Seed = Annotated[int, typer.Option(min=0, help="Equal seeds give equal figures.")]
Methods = Annotated[
    list[LayoutMethod] | None,
    typer.Option("--method", help="One of them; give it again for more. Default: all."),
]
Only = Annotated[int, typer.Option(min=1, help="Every so manieth task of the 140, for a quick look.")]
T = TypeVar("T")


@app.command()
def tasks(
    dataset: Annotated[
        Path | None,
        typer.Option(help="Measure the tasks of this dataset; without it both writers draft some."),
    ] = None,
    scenes: Annotated[
        list[str] | None,
        typer.Option(help="Base scene; give it again for more. Default: the 45 to train on."),
    ] = None,
    each: Annotated[int, typer.Option(min=2, help="Tasks of a scene; the paper takes 10.")] = 10,
    seed: Seed = 0,
    json_file: JsonFile = None,
    llm: Annotated[str, typer.Option(help="Endpoint whose model scores each scene's tasks as well.")] = "",
    model: Annotated[str, typer.Option(help="Name of the model there.")] = "",
    key: Key = "",
    cassette: Tape = None,
) -> None:
    """Diversity of instructions and goals, with and without social simulation."""
    with user_errors():
        if llm and not model:
            raise EvaluationError("--llm needs the name of a model there: give --model")
        if dataset is not None:
            groups, evaluation = _of_dataset(dataset, each)
        else:
            chosen = tuple(dict.fromkeys(scenes or training_scenes()))
            with progress(Console(stderr=True)) as bars:
                bar = bars.add_task("scenes", total=len(chosen))
                written = written_for(chosen, each, seed, lambda done: bars.update(bar, completed=done))
            groups, evaluation = written.social, evaluate_tasks(written, each, seed)
        if llm or cassette is not None:
            verdicts = asyncio.run(
                _asked(lambda judge: _judged(judge, groups, seed), llm, model, key, cassette)
            )
            evaluation = replace(evaluation, figures=(*evaluation.figures, *verdicts))
        report_evaluation(evaluation, json_file)


@app.command()
def scenes(
    sample: Annotated[
        Path,
        typer.Option(help="The sample of the paper's tasks, JSON lines: half of the fixed tasks are in it."),
    ],
    methods: Methods = None,
    only: Only = 1,
    seed: Seed = 0,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    json_file: JsonFile = None,
    outcomes: Annotated[
        Path | None,
        typer.Option(
            help="File for what came of each task, JSON lines, written as it comes: with it a run that was stopped goes on."
        ),
    ] = None,
) -> None:
    """Generation rate, verification pass rate and time of 140 fixed tasks, by layout tree and by two simpler ways."""
    kept = "; what was found is kept, and the same command goes on from there" if outcomes is not None else ""
    with user_errors(outcomes, kept):
        chosen = fixed_tasks(sample)[::only]
        told = methods or list(LayoutMethod)
        log = OutcomeLog.open(outcomes, seed) if outcomes is not None else None
        with progress(Console(stderr=True)) as bars:
            bar = bars.add_task("trials", total=len(chosen) * len(told))
            evaluation, _ = evaluate_scenes(
                chosen, told, seed, jobs, lambda done: bars.update(bar, completed=done), log
            )
        if only > 1:
            taken = {"taken": f"one in {only} of the fixed tasks", **evaluation.conditions}
            evaluation = replace(evaluation, conditions=taken)
        report_evaluation(evaluation, json_file)


@app.command()
def picture(
    task: Annotated[str, typer.Argument(help="Name of one of the 140 fixed tasks.")],
    sample: Annotated[Path, typer.Option(help="The paper's sample of tasks, JSON lines.")],
    seed: Seed = 0,
    out: Annotated[Path, typer.Option(help="PNG file to write.")] = Path("side_by_side.png"),
) -> None:
    """Draw one fixed task as the three methods lay it out, side by side."""
    with user_errors(out):
        drawn = draw_side_by_side(named(fixed_tasks(sample), task), seed)
        drawn.save(out)
    Console().print(f"picture: {out}", highlight=False, markup=False)


@app.command()
def looks(
    sample: Annotated[Path, typer.Option(help="The paper's sample of tasks, JSON lines.")],
    methods: Methods = None,
    only: Only = 1,
    seed: Seed = 0,
    json_file: JsonFile = None,
    llm: Annotated[str, typer.Option(help="Endpoint with a model that sees.")] = "",
    model: Annotated[str, typer.Option(help="Name of the model there.")] = "",
    key: Key = "",
    cassette: Tape = None,
) -> None:
    """The paper's judge of aesthetics: a language model that is shown the plan of each laid out room, with its tree."""
    with user_errors():
        chosen, told = fixed_tasks(sample)[::only], methods or list(LayoutMethod)

        async def looked(judge: ChatModel) -> EvaluationFigures:
            with progress(Console(stderr=True)) as bars:
                bar = bars.add_task("trials", total=len(chosen) * len(told))
                return await evaluate_looks(
                    judge, chosen, told, seed, lambda done: bars.update(bar, completed=done)
                )

        evaluation = asyncio.run(_asked(looked, llm, model, key, cassette))
    report_evaluation(evaluation, json_file)


@app.command()
def admissions(
    folder: Annotated[Path, typer.Argument(help="Folder that `build`, `generate` or `corpus` wrote.")],
    json_file: JsonFile = None,
) -> None:
    """How many drafts of a build were admitted, how many in an hour of two cores, and why the rest was not."""
    with user_errors():
        evaluation = evaluate_admissions(folder)
    report_evaluation(evaluation, json_file)


@app.command()
def aesthetics(
    rooms: Annotated[Path, typer.Option(help="Table of hand-made rooms, gzipped JSON.")],
    seed: Seed = 0,
    json_file: JsonFile = None,
    calibration: Annotated[
        Path | None, typer.Option(help="File for weights that are fitted to all of the rooms.")
    ] = None,
) -> None:
    """How well the geometric score tells hand-made rooms from spoilt ones that its fit did not see."""
    with user_errors():
        evaluation, fitted = evaluate_aesthetics(rooms, seed)
        if calibration is not None:
            write_whole(calibration, (json.dumps(asdict(fitted), indent=1) + "\n").encode("ascii"))
        report_evaluation(evaluation, json_file)


@app.command()
def page(
    files: Annotated[list[Path], typer.Argument(help="Files that `evaluate PART --json` wrote.")],
    out: Annotated[Path, typer.Option(help="Page whose part on the factory is replaced.")] = PAGE,
) -> None:
    """Write the factory's part of the page of benchmarks."""
    with user_errors(out):
        evaluations = [read_evaluation(file) for file in files]
        before = out.read_text(encoding="utf-8") if out.exists() else ""
        write_whole(out, with_factory(before, evaluations).encode("utf-8"))
    Console().print(f"page: {out}", highlight=False)


def _of_dataset(folder: Path, each: int) -> tuple[Mapping[str, Sequence[DraftFeatures]], EvaluationFigures]:
    groups = asked_of(Dataset.load(folder).records, each)
    if not groups:
        raise EvaluationError(f"no base scene of {folder} has {each} tasks: ask for fewer with --each")
    figures = (*panel(groups, people_of(folder / TRANSCRIPTS_FOLDER)), *admitted_share(folder))
    conditions = {"dataset": folder.name, "scenes": len(groups), "tasks a scene": each}
    return groups, EvaluationFigures("tasks", conditions, figures)


async def _asked(
    question: Callable[[ChatModel], Awaitable[T]], url: str, model: str, key: str, cassette: Path | None
) -> T:
    """What comes of a question to an endpoint, to a recording, or to both."""
    async with chat_model(url, model, key, cassette) as judge:
        return await question(judge)


async def _judged(
    judge: ChatModel, groups: Mapping[str, Sequence[DraftFeatures]], seed: int
) -> tuple[Figure, ...]:
    """Mean scores of a language model over the scenes."""
    verdicts = [
        await judged(judge, [asked.instruction for asked in group], seed) for group in groups.values()
    ]
    return tuple(
        Figure(
            f"judge {name}",
            float(np.mean([getattr(each, name) for each in verdicts])),
            "of 10",
            Better.NEITHER,
            len(verdicts),
        )
        for name in ("variety", "characters", "overall")
    )
