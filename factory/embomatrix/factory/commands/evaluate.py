"""``embomatrix factory evaluate``: measure tasks and scenes, write the figures, render the benchmark page."""

import asyncio
import json
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
import typer

from embomatrix.factory.commands.language_model import MODEL_ERRORS, Key, Tape, chat_model
from embomatrix.factory.commands.terminal import counter, report_evaluation, say, user_errors
from embomatrix.factory.evaluate.admissions import admitted_share, evaluate_admissions
from embomatrix.factory.evaluate.aesthetics import evaluate_aesthetics
from embomatrix.factory.evaluate.judges import evaluate_looks, judged
from embomatrix.factory.evaluate.page import with_factory
from embomatrix.factory.evaluate.scenes import LayoutMethod, evaluate_scenes, fixed_tasks, outcome_log
from embomatrix.factory.evaluate.side_by_side import draw_side_by_side, named
from embomatrix.factory.evaluate.tasks import DraftFeatures, asked_of, evaluate_tasks, panel, people_of
from embomatrix.factory.metrics.figures import (
    EvaluationError,
    EvaluationFigures,
    read_evaluation,
)
from embomatrix.factory.pipeline.corpus import training_scenes
from embomatrix.factory.pipeline.store import TRANSCRIPTS_FOLDER
from embomatrix.llm.values import ChatModel
from embomatrix.pages.figures import Better, Figure
from embomatrix.world.dataset import Dataset
from embomatrix.world.whole_file import write_whole

app = typer.Typer(
    help="Measure tasks and scenes; write the figures as JSON and to the benchmark page.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
PAGE = Path("docs/benchmarks.md")
JsonFile = Annotated[Path | None, typer.Option("--json", help="File for the figures.")]
Seed = Annotated[int, typer.Option(min=0, help="Random seed.")]
Methods = Annotated[
    list[LayoutMethod] | None,
    typer.Option("--method", help="Layout method; repeatable. Default: all."),
]
Only = Annotated[int, typer.Option(min=1, help="Use only every n-th of the 140 tasks.")]
T = TypeVar("T")


@app.command()
def tasks(
    dataset: Annotated[
        Path | None,
        typer.Option(help="Measure the tasks of this dataset. Default: draft tasks with both writers."),
    ] = None,
    scenes: Annotated[
        list[str] | None,
        typer.Option(help="Base scene; repeatable. Default: the 45 training scenes."),
    ] = None,
    each: Annotated[int, typer.Option(min=2, help="Tasks per scene (10 in the paper).")] = 10,
    seed: Seed = 0,
    json_file: JsonFile = None,
    llm: Annotated[str, typer.Option(help="URL of an endpoint; its model also scores the tasks.")] = "",
    model: Annotated[str, typer.Option(help="Name of the model at the endpoint.")] = "",
    key: Key = "",
    cassette: Tape = None,
) -> None:
    """Measure the diversity of instructions and goals, with and without social simulation."""
    with user_errors(more=MODEL_ERRORS):
        if llm and not model:
            raise EvaluationError("--llm needs the name of a model there: give --model")
        if dataset is not None:
            groups, evaluation = _of_dataset(dataset, each)
        else:
            chosen = tuple(dict.fromkeys(scenes or training_scenes()))
            with counter("scenes", len(chosen)) as count:
                groups, evaluation = evaluate_tasks(chosen, each, seed, count)
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
        typer.Option(help="JSON lines file with the paper's sample of tasks, half of the fixed tasks."),
    ],
    methods: Methods = None,
    only: Only = 1,
    seed: Seed = 0,
    jobs: Annotated[int, typer.Option(min=1, help="Number of processes.")] = 1,
    json_file: JsonFile = None,
    outcomes: Annotated[
        Path | None,
        typer.Option(
            help="JSON lines file for the outcome of each task; an interrupted run resumes from it."
        ),
    ] = None,
) -> None:
    """Measure generation rate, verification pass rate and time of 140 fixed tasks, by layout tree and two baselines."""
    kept = "; outcomes so far are saved: run the same command to resume" if outcomes is not None else ""
    with user_errors(outcomes, kept):
        chosen = fixed_tasks(sample)[::only]
        used_methods = methods or list(LayoutMethod)
        log = outcome_log(outcomes, seed)
        with counter("trials", len(chosen) * len(used_methods)) as count:
            evaluation, _ = evaluate_scenes(chosen, used_methods, seed, jobs, count, log)
        if only > 1:
            taken = {"taken": f"one in {only} of the fixed tasks", **evaluation.conditions}
            evaluation = replace(evaluation, conditions=taken)
        report_evaluation(evaluation, json_file)


@app.command()
def picture(
    task: Annotated[str, typer.Argument(help="Name of one of the 140 fixed tasks.")],
    sample: Annotated[Path, typer.Option(help="JSON lines file with the paper's sample of tasks.")],
    seed: Seed = 0,
    out: Annotated[Path, typer.Option(help="PNG file to write.")] = Path("side_by_side.png"),
) -> None:
    """Draw the layouts of one fixed task by the three methods, side by side."""
    with user_errors(out):
        drawn = draw_side_by_side(named(fixed_tasks(sample), task), seed)
        drawn.save(out)
    say(f"picture: {out}")


@app.command()
def looks(
    sample: Annotated[Path, typer.Option(help="JSON lines file with the paper's sample of tasks.")],
    methods: Methods = None,
    only: Only = 1,
    seed: Seed = 0,
    json_file: JsonFile = None,
    llm: Annotated[str, typer.Option(help="URL of an endpoint with a vision-language model.")] = "",
    model: Annotated[str, typer.Option(help="Name of the model at the endpoint.")] = "",
    key: Key = "",
    cassette: Tape = None,
) -> None:
    """Score layouts with the paper's judge: a vision-language model sees the plan of each room and its layout tree."""
    with user_errors(more=MODEL_ERRORS):
        chosen, used_methods = fixed_tasks(sample)[::only], methods or list(LayoutMethod)

        async def looked(judge: ChatModel) -> EvaluationFigures:
            with counter("trials", len(chosen) * len(used_methods)) as count:
                return await evaluate_looks(judge, chosen, used_methods, seed, count)

        evaluation = asyncio.run(_asked(looked, llm, model, key, cassette))
    report_evaluation(evaluation, json_file)


@app.command()
def admissions(
    folder: Annotated[Path, typer.Argument(help="Folder written by `build`, `generate` or `corpus`.")],
    json_file: JsonFile = None,
) -> None:
    """Count the admitted drafts of a build, in total and per hour on two cores, and the reasons against the others."""
    with user_errors():
        evaluation = evaluate_admissions(folder)
    report_evaluation(evaluation, json_file)


@app.command()
def aesthetics(
    rooms: Annotated[Path, typer.Option(help="Gzipped JSON file with hand-made rooms.")],
    seed: Seed = 0,
    json_file: JsonFile = None,
    calibration: Annotated[
        Path | None, typer.Option(help="File for the weights fitted to all rooms.")
    ] = None,
) -> None:
    """Measure how well the geometric score separates held-out hand-made rooms from corrupted ones."""
    with user_errors():
        evaluation, fitted = evaluate_aesthetics(rooms, seed)
        if calibration is not None:
            write_whole(calibration, (json.dumps(asdict(fitted), indent=1) + "\n").encode("ascii"))
        report_evaluation(evaluation, json_file)


@app.command()
def page(
    files: Annotated[list[Path], typer.Argument(help="Files written by `evaluate PART --json`.")],
    out: Annotated[Path, typer.Option(help="Page with the factory's section to replace.")] = PAGE,
) -> None:
    """Write the factory's section of the benchmark page."""
    with user_errors(out):
        evaluations = [read_evaluation(file) for file in files]
        before = out.read_text(encoding="utf-8") if out.exists() else ""
        write_whole(out, with_factory(before, evaluations).encode("utf-8"))
    say(f"page: {out}")


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
    """Run a question against an endpoint, a recording, or both."""
    async with chat_model(url, model, key, cassette) as judge:
        return await question(judge)


async def _judged(
    judge: ChatModel, groups: Mapping[str, Sequence[DraftFeatures]], seed: int
) -> tuple[Figure, ...]:
    """Return the mean scores of a language model over the scenes."""
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
