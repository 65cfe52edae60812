"""``embomatrix factory evaluate``: measure tasks and scenes, write the figures, render the benchmark page."""

import asyncio
import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.language_model import MODEL_ERRORS, Key, Llm, Model, Tape, chat_model
from embomatrix.factory.commands.options import ScriptsLearnFrom, Seed
from embomatrix.factory.commands.terminal import counter, report_evaluation, say, user_errors
from embomatrix.factory.evaluate.admissions import admitted_share, evaluate_admissions
from embomatrix.factory.evaluate.aesthetics_fit import evaluate_aesthetics
from embomatrix.factory.evaluate.judges import evaluate_looks, with_judge
from embomatrix.factory.evaluate.lies import evaluate_lies
from embomatrix.factory.evaluate.page import with_factory
from embomatrix.factory.evaluate.readings import evaluate_readings, read_answers, shipped_answers
from embomatrix.factory.evaluate.rooms import evaluate_rooms
from embomatrix.factory.evaluate.scenes import (
    LayoutMethod,
    PoseSource,
    evaluate_scenes,
    fixed_tasks,
    outcome_log,
    task_list_settings,
)
from embomatrix.factory.evaluate.scripts import evaluate_scripts
from embomatrix.factory.evaluate.search import evaluate_search
from embomatrix.factory.evaluate.skills import evaluate_skills, needed_in_dataset
from embomatrix.factory.evaluate.tasks import DraftFeatures, asked_of, evaluate_tasks, panel, people_of
from embomatrix.factory.metrics.figures import (
    FIGURES_MARK,
    EvaluationError,
    EvaluationFigures,
    read_evaluation,
)
from embomatrix.factory.pipeline.corpus import training_scenes
from embomatrix.factory.pipeline.store import TRANSCRIPTS_FOLDER
from embomatrix.factory.task_import.sources import SourceText
from embomatrix.host.code_version import commit_here
from embomatrix.host.own_files import Force, keep_foreign, prepare_output
from embomatrix.llm.values import ChatModel
from embomatrix.starter.shipped import unpack
from embomatrix.world.catalog import Catalog
from embomatrix.world.dataset import Dataset
from embomatrix.world.whole_file import write_whole

METHODS = list(LayoutMethod)
Judge = AbstractAsyncContextManager[ChatModel]


def evaluate(
    parts: Annotated[
        list[str],
        typer.Argument(
            help="Parts: tasks, scripts, search, skills, readings, rooms, scenes, looks, admission, lies, aesthetics; "
            "or a .json file."
        ),
    ],
    dataset: Annotated[
        Path | None,
        typer.Option(
            help="Dataset for tasks, scripts, search, skills, readings and admission. Default for tasks: drafts of both "
            "writers; for scripts, search, skills and readings: the shipped dataset."
        ),
    ] = None,
    training: ScriptsLearnFrom = None,
    each: Annotated[int, typer.Option(min=2, help="Tasks per scene (10 in the paper).")] = 10,
    sample: Annotated[
        Path | None,
        typer.Option(help="JSON lines file with the paper's sample of tasks, for scenes and looks."),
    ] = None,
    only: Annotated[
        int,
        typer.Option(
            min=1,
            help="Use only every n-th of the 140 tasks, of a dataset's for skills, or of the base scenes for rooms.",
        ),
    ] = 1,
    outcomes: Annotated[
        Path | None,
        typer.Option(help="JSON lines file for the outcomes of scenes; an interrupted run resumes from it."),
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Number of processes for scenes, scripts and skills.")] = 1,
    answers: Annotated[
        Path | None,
        typer.Option(
            help="JSON lines file with the answers of a reader of prompts, for readings. Default: the shipped ones."
        ),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="File with recorded answers of the language model that writes poses, for scenes and looks. Missing answers "
            "are requested with --llm and appended. Default: SmolLM2-135M's answers for the fixed tasks."
        ),
    ] = None,
    rooms: Annotated[
        Path | None, typer.Option(help="Gzipped JSON file with hand-made rooms, for aesthetics.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="File for the aesthetic weights fitted to all rooms.")
    ] = None,
    seed: Seed = 0,
    llm: Llm = "",
    model: Model = "",
    key: Key = "",
    cassette: Tape = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the figures, PART.json.")] = None,
    page: Annotated[
        Path | None, typer.Option(help="Page with the factory's section to update, docs/benchmarks.md.")
    ] = None,
    force: Force = False,
) -> None:
    """Measure parts of the factory: tasks, scripts, searches, skills, answers of readers, rooms, layouts, admission and more.

    A language model judges looks, and also tasks if one is given.
    """
    kept = tempfile.TemporaryDirectory()
    scratch = Path(kept.name)
    judge = partial(chat_model, llm, model, key, cassette)
    writer = PoseSource(poses, llm, model, key) if poses is not None else PoseSource()
    measures: Mapping[str, Callable[[], EvaluationFigures]] = {
        "tasks": lambda: _tasks(dataset, each, seed, judge() if llm or cassette else None),
        "scripts": lambda: evaluate_scripts(
            dataset or _shipped(scratch), training, jobs=jobs, counter=counter
        ),
        "search": lambda: evaluate_search(dataset or _shipped(scratch), training, jobs=jobs, counter=counter),
        "rooms": lambda: _rooms(only, seed),
        "scenes": lambda: _scenes(_fixed(sample)[::only], only, seed, jobs, outcomes, writer),
        "looks": lambda: asyncio.run(_looks(judge(), _fixed(sample)[::only], seed, writer)),
        "admission": lambda: evaluate_admissions(_given(dataset, "--dataset FOLDER")),
        "lies": evaluate_lies,
        "readings": lambda: _readings(dataset or _shipped(scratch), answers),
        "skills": lambda: _skills(dataset or _shipped(scratch), only, jobs),
        "aesthetics": lambda: _aesthetics(_given(rooms, "--rooms FILE"), seed, calibration),
    }
    prepare_output("factory evaluate", page, calibration, outcomes)
    with user_errors(more=MODEL_ERRORS), kept:
        if llm and not model:
            raise EvaluationError("--llm needs the name of a model there: give --model")
        for part in parts:
            if part not in measures and not part.endswith(".json"):
                raise EvaluationError(
                    f"unknown part {part!r}: expected a .json file or {', '.join(measures)}"
                )
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            figures = [out / f"{part}.json" for part in parts if part in measures]
            keep_foreign("", figures, FIGURES_MARK, force=force)
        evaluations = []
        for part in parts:
            measured = part in measures
            evaluations.append(_with_commit(measures[part]()) if measured else read_evaluation(Path(part)))
            report_evaluation(evaluations[-1], out / f"{part}.json" if out and measured else None)
    if page is not None:
        with user_errors(page):
            before = page.read_text(encoding="utf-8") if page.exists() else ""
            write_whole(page, with_factory(before, evaluations).encode("utf-8"))
        say(f"page: {page}")


def _with_commit(found: EvaluationFigures) -> EvaluationFigures:
    """Return the figures with the commit of this code among their conditions."""
    return replace(found, conditions={**found.conditions, "commit": commit_here()})


def _given(path: Path | None, option: str) -> Path:
    if path is None:
        raise EvaluationError(f"an input of this part is missing: give {option}")
    return path


def _shipped(scratch: Path) -> Path:
    """Return the folder of the shipped dataset, which is unpacked there first."""
    folder = scratch / "shipped"
    if not folder.exists():
        unpack(folder)
    return folder


def _readings(dataset: Path, answers: Path | None) -> EvaluationFigures:
    """Judge the answers of a reader, by default the shipped ones, and print those that failed."""
    readings = shipped_answers() if answers is None else read_answers(answers)
    evaluation, verdicts = evaluate_readings(Dataset.load(dataset), readings)
    for verdict in verdicts:
        if verdict.success is False or verdict.agrees is False:
            say(f"{verdict.task}: {verdict.detail}")
    return evaluation


def _fixed(sample: Path | None) -> list[SourceText]:
    return fixed_tasks(_given(sample, "--sample FILE"))


def _tasks(dataset: Path | None, each: int, seed: int, judge: Judge | None) -> EvaluationFigures:
    """Measure the diversity of instructions and goals, with and without social simulation."""
    if dataset is not None:
        groups, evaluation = _of_dataset(dataset, each)
    else:
        chosen = training_scenes()
        with counter("scenes", len(chosen)) as count:
            groups, evaluation = evaluate_tasks(chosen, each, seed, count)
    if judge is None:
        return evaluation
    return asyncio.run(_judged(judge, groups, seed, evaluation))


def _of_dataset(folder: Path, each: int) -> tuple[Mapping[str, Sequence[DraftFeatures]], EvaluationFigures]:
    groups = asked_of(Dataset.load(folder).records, each)
    if not groups:
        raise EvaluationError(f"no base scene of {folder} has {each} tasks: ask for fewer with --each")
    figures = (*panel(groups, people_of(folder / TRANSCRIPTS_FOLDER)), *admitted_share(folder))
    conditions = {"dataset": folder.name, "scenes": len(groups), "tasks a scene": each}
    return groups, EvaluationFigures("tasks", conditions, figures)


async def _judged(
    judge: Judge,
    groups: Mapping[str, Sequence[DraftFeatures]],
    seed: int,
    evaluation: EvaluationFigures,
) -> EvaluationFigures:
    """Return the evaluation with the mean scores of a language model over the scenes."""
    async with judge as model:
        told = ([asked.instruction for asked in group] for group in groups.values())
        return await with_judge(evaluation, model, told, seed)


def _scenes(
    tasks: Sequence[SourceText],
    only: int,
    seed: int,
    jobs: int,
    outcomes: Path | None,
    poses: PoseSource,
) -> EvaluationFigures:
    """Measure generation rate, verification pass rate and time by three methods."""
    kept = "; outcomes so far are saved: run the same command to resume" if outcomes is not None else ""
    with user_errors(outcomes, kept):
        log = outcome_log(outcomes, seed, {**task_list_settings(tasks), **poses.settings()})
        with counter("trials", len(tasks) * len(METHODS)) as count:
            evaluation, _ = evaluate_scenes(tasks, METHODS, seed, jobs, count, log, poses)
    taken = {"taken": f"one in {only} of the fixed tasks"} if only > 1 else {}
    return replace(evaluation, conditions={**taken, **evaluation.conditions})


def _rooms(only: int, seed: int) -> EvaluationFigures:
    """Measure the furnishing and density of base scenes."""
    chosen = Catalog.load().scene_ids[::only]
    with counter("scenes", len(chosen)) as count:
        return evaluate_rooms(chosen, seed, count)


async def _looks(
    judge: Judge, tasks: Sequence[SourceText], seed: int, poses: PoseSource
) -> EvaluationFigures:
    """Score layouts with the paper's judge: a vision-language model sees each room's plan and its layout tree."""
    async with judge as model:
        with counter("trials", len(tasks) * len(METHODS)) as count:
            return await evaluate_looks(model, tasks, METHODS, seed, count, poses)


def _skills(folder: Path, only: int, jobs: int) -> EvaluationFigures:
    """Measure the share of a dataset's tasks that need each skill."""
    records = Dataset.load(folder).records[::only]
    with counter("tasks", len(records)) as count:
        return evaluate_skills(folder, needed_in_dataset(folder, records, jobs, count))


def _aesthetics(rooms: Path, seed: int, calibration: Path | None) -> EvaluationFigures:
    """Measure how well the score separates hand-made rooms outside the fit from corrupted copies of them."""
    evaluation, fitted = evaluate_aesthetics(rooms, seed)
    if calibration is not None:
        write_whole(calibration, (json.dumps(asdict(fitted)) + "\n").encode("ascii"))
    return evaluation
