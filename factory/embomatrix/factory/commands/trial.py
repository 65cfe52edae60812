"""``embomatrix factory try``: check and try a task of one's own in seconds, and save it to be played."""

import contextlib
import shlex
import time
from pathlib import Path
from typing import Annotated, Final

import typer

from embomatrix.factory.admission import TaskRefusal, oracle_plan, plan_failure
from embomatrix.factory.commands.options import Seed
from embomatrix.factory.commands.terminal import say, user_errors
from embomatrix.factory.inspection.page import scene_picture, task_page
from embomatrix.factory.inspection.playing import OraclePlayback, play_oracle
from embomatrix.factory.scenes.base_scenes import BaseScenes, base_scenes, drop_scenes, keep_scenes
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.task_import.batch import Verified
from embomatrix.factory.task_import.sources import ProblemSourceError
from embomatrix.factory.task_import.task import ImportedTask, slug_of
from embomatrix.factory.task_import.task_file import SOURCE, TaskFile, read_task_file
from embomatrix.factory.task_import.trial import STAGES, TaskTrial, TrialStage, try_task
from embomatrix.host.own_files import prepare_output
from embomatrix.sim.physical.actor import physical_simulator
from embomatrix.sim.physical.survey import ReachabilitySurvey
from embomatrix.sim.placing.pose_cache import PlacementLibrary
from embomatrix.sim.state.facts import FactError
from embomatrix.world.bundle import Bundle, decode_bundle
from embomatrix.world.dataset import (
    BUNDLES_FOLDER,
    TASKS_FILE,
    Dataset,
    DatasetError,
    bundle_file,
    write_dataset,
)
from embomatrix.world.evaluate import GoalError, scored_atoms
from embomatrix.world.scene import Scene
from embomatrix.world.whole_file import write_whole

DEFAULT_SCENE: Final = "Rs_int"
DEFAULT_FOLDER: Final = Path("build/try")

TaskPath = Annotated[
    Path, typer.Argument(metavar="FILE", help="Task in TOML (docs/tasks.md), or a BDDL problem.")
]
OneScene = Annotated[
    str,
    typer.Option(
        help=f"Base scene, or a .json file of `scene build`. Default: the scene that the file names, or {DEFAULT_SCENE}."
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(help=f"Folder for the task as a dataset. Default: {DEFAULT_FOLDER}/NAME of the file."),
]
Physical = Annotated[
    bool,
    typer.Option(
        "--physical",
        help="Also analyse the reach of the robot's arm, and carry the plan out with a robot in stepped physics, as "
        "`factory build` does. Takes some ten seconds more.",
    ),
]
Page = Annotated[Path | None, typer.Option(help="HTML file for the task with its plan, for a browser.")]


def try_(
    file: TaskPath,
    scene: OneScene = "",
    seed: Seed = 0,
    out: Out = None,
    page: Page = None,
    physical: Physical = False,
) -> None:
    """Check a task of one's own and try it: text, objects, start, the oracle's plan. Takes seconds.

    Exit status: 0 if the plan reaches the goal, 1 if the task is refused, 2 for other bad input.
    """
    began = time.monotonic()
    folder = out or DEFAULT_FOLDER / (slug_of(file.stem) or "task")
    with user_errors():
        task_file = read_task_file(file)
        named = scene or task_file.scene or DEFAULT_SCENE
        chosen = base_scenes([named])
        base = chosen.only(named)
    with user_errors(folder):
        _check_free(folder, task_file)
    prepare_output("factory try", page)
    with (
        user_errors(folder, more=(FactError, GoalError)),
        contextlib.closing(PlacementLibrary()) as library,
    ):
        trial = try_task(task_file, base, library, ReachabilitySurvey() if physical else None, seed=seed)
        _report(file, task_file, base, trial)
        if isinstance(trial.outcome, TaskRefusal):
            raise typer.Exit(1)
        bundle = decode_bundle(trial.outcome.bundle)
        playback = play_oracle(trial.outcome.record, bundle)
        _report_plan(playback)
        if physical:
            _prove(file, trial.outcome, bundle)
        _save(folder, trial.outcome, chosen)
    if page is not None:
        with user_errors(page):
            html = task_page(
                trial.outcome.record, bundle.scene, playback, "", None, scene_picture(bundle.scene)
            )
            write_whole(page, html.encode("utf-8"))
    say(f"{time.monotonic() - began:.1f} s. Play it, or look at it in a browser:")
    _say_commands(trial.outcome.record.task.task_id, folder, task_file.source.name, page)


def _say_commands(task_id: str, folder: Path, name: str, page: Path | None) -> None:
    """Print the commands that play the task, and its page or the command that writes one."""
    place = f"--dataset {shlex.quote(str(folder))}"
    say(f"  embomatrix play {task_id} {place} --interactive")
    say(f"  embomatrix play {task_id} {place} --oracle")
    out = shlex.quote(f"{name}.html")
    say(f"  embomatrix factory inspect {task_id} {place} --out {out}" if page is None else f"  {page}")


def _report(file: Path, task_file: TaskFile, base: Scene, trial: TaskTrial) -> None:
    """Print each check that the task passed, and the one that refuses it."""
    outcome = trial.outcome
    stage = STAGES[outcome.reason] if isinstance(outcome, TaskRefusal) else None
    stages = list(TrialStage)
    passed = stages[: stages.index(stage)] if stage is not None else stages
    problem = task_file.problem
    atoms = scored_atoms(problem.goal, problem.types)
    if TrialStage.TEXT in passed:
        say(f"✓ text: {_count(len(problem.objects), 'object')}, {_count(len(atoms), 'atom')} in the goal")
        if trial.bound is not None:
            say(f"    {trial.bound.task.instruction}")
    if TrialStage.OBJECTS in passed and trial.bound is not None:
        say(f"✓ objects: all are in {base.base}")
        _report_objects(base, trial.bound)
    if TrialStage.START in passed:
        say("✓ start: the goal does not hold")
    if isinstance(outcome, TaskRefusal):
        say(f"✗ {stage}: {file} is refused ({outcome.reason}): {outcome.sentence}")


def _report_objects(base: Scene, bound: ImportedTask) -> None:
    view = SceneView(bound.scene)
    for name, there in zip(bound.instances, bound.about, strict=True):
        origin = "of the scene" if there in base.by_name else "added"
        say(f"    {name}: {there}, {view.whereabouts(there)} in {view.room(there)}, {origin}")
    for note in bound.notes:
        say(f"    {note}")


def _report_plan(playback: OraclePlayback) -> None:
    for atom, holds in playback.moments[0].goal:
        say(f"    {atom} {'holds already' if holds else 'does not hold yet'}")
    calls = playback.moments[1:]
    say(f"✓ plan: the oracle reaches the goal in {_count(len(calls), 'call')}, reward {playback.reward:.1f}")
    for number, moment in enumerate(calls, start=1):
        say(f"    {number}. {moment.call}")


def _prove(file: Path, verified: Verified, bundle: Bundle) -> None:
    """Carry the plan out in stepped physics. Exit with status 1 if the robot fails."""
    with contextlib.closing(physical_simulator(bundle)) as simulator:
        failure = plan_failure(simulator, verified.record.task, oracle_plan(verified.record))
    if failure is not None:
        say(
            f"✗ {TrialStage.PHYSICS}: {file} is refused (physics_failed): the oracle's plan fails in stepped physics: "
            f"{failure}; name another scene or seed, or other places"
        )
        raise typer.Exit(1)
    say(f"✓ {TrialStage.PHYSICS}: a robot carries the plan out and reaches the goal")


def _check_free(folder: Path, task_file: TaskFile) -> None:
    """Raise ProblemSourceError if the folder holds a dataset other than an earlier trial of the same file."""
    if not (folder / TASKS_FILE).exists():
        return
    try:
        records = Dataset.load(folder).records
    except DatasetError as error:
        raise ProblemSourceError(
            f"{folder / TASKS_FILE} is not an earlier trial of this file: name another folder with --out"
        ) from error
    words = records[0].task.task_id.split("-") if len(records) == 1 else []
    is_trial = len(words) > 1 and words[1] == slug_of(task_file.source.name)
    if not is_trial or records[0].task.source != SOURCE:
        raise ProblemSourceError(
            f"{folder} holds a dataset of {_count(len(records), 'task')} that is not an earlier trial of this file: name "
            "another folder with --out"
        )


def _save(folder: Path, verified: Verified, chosen: BaseScenes) -> None:
    """Replace an earlier trial's dataset."""
    old = Dataset.load(folder).records if (folder / TASKS_FILE).exists() else ()
    if old:
        drop_scenes(folder, chosen.own.values())
    keep_scenes(folder, chosen.own.values())
    write_dataset(folder, [verified.record], {verified.record.bundle_digest: verified.bundle})
    for record in old:
        if record.bundle_digest != verified.record.bundle_digest:
            (folder / BUNDLES_FOLDER / bundle_file(record.bundle_digest)).unlink(missing_ok=True)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
