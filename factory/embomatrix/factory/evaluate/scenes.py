"""Scene quality: the same tasks laid out by three methods, each scene judged by code that no method calls.

A task counts as generated when every object has a place and its start holds in the simulator. A generated one counts as
verified, as in the paper, when the robot can manipulate what the task is about, executed in the simulator, and the geometry
of what was added is sound. Whether the oracle also finds a plan to the goal is a figure of its own: that depends on the
skills as well.
"""

from __future__ import annotations

import contextlib
import json
import math
import time
from collections import Counter, defaultdict
from dataclasses import dataclass
from enum import StrEnum
from importlib import resources
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from embomatrix.factory.admission import Admitted, RefusalReason, TaskRefusal, admit
from embomatrix.factory.evaluate.aesthetics import Calibration, score_room
from embomatrix.factory.evaluate.manipulation import out_of_hand
from embomatrix.factory.evaluate.rooms import plan_of
from embomatrix.factory.evaluate.scene_geometry import flaws_of
from embomatrix.factory.layout.baselines import lay_at_random, lay_by_poses
from embomatrix.factory.layout.generator import lay
from embomatrix.factory.metrics.figures import EvaluationError, EvaluationFigures
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.task_import.batch import poses_for
from embomatrix.factory.task_import.sources import SourceText, read_activity
from embomatrix.factory.task_import.task import ImportedTask, ImportOptions, import_problem
from embomatrix.pages.figures import Better, Figure
from embomatrix.sim.planner.oracle import find_plan
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import Bundle

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from embomatrix.factory.layout.request import Layout, RequestedObject
    from embomatrix.factory.scenes.editor import SceneEditor
    from embomatrix.factory.task_import.task import Lay
    from embomatrix.sim.placing.pose_cache import PlacementLibrary
    from embomatrix.world.scene import Scene

LIST: Final = "scene_tasks.json"


class LayoutMethod(StrEnum):
    """How a task is laid out."""

    TREE = "tree"
    RANDOM = "random"
    POSES = "poses"


METHODS: Final[Mapping[LayoutMethod, Lay]] = {
    LayoutMethod.TREE: lay,
    LayoutMethod.RANDOM: lay_at_random,
    LayoutMethod.POSES: lay_by_poses,
}


@dataclass(frozen=True, slots=True)
class SceneTask:
    """A task of the fixed list, and the base scene that it is laid out in."""

    source: SourceText
    scene: str


@dataclass(frozen=True, slots=True)
class LayoutOutcome:
    """What came of one task by one method; ``solved`` tells that the oracle's plan reaches the goal.

    ``scene_s`` and ``planar_s`` are CPU seconds, the latter by room.
    """

    task: str
    scene: str
    method: LayoutMethod
    generated: bool
    verified: bool
    solved: bool
    reason: str
    scene_s: float
    planar_s: tuple[float, ...]
    aesthetics: float | None
    detail: str = ""


def fixed_tasks(sample: Path) -> list[SceneTask]:
    """70 tasks of the paper's sample, whose file is given, and 70 of BEHAVIOR-1K. Raises EvaluationError, SourceError."""
    text = (resources.files("embomatrix.factory.evaluate") / LIST).read_text(encoding="utf-8")
    names = json.loads(text)
    known = _sample(sample)
    missing = [name for name, _ in names["sample"] if name not in known]
    if missing:
        raise EvaluationError(
            f"{sample} lacks {len(missing)} of the fixed tasks, {missing[0]!r} first: expected the sample of 400 tasks"
        )
    paper = [SceneTask(known[name], scene) for name, scene in names["sample"]]
    return paper + [SceneTask(read_activity(name), scene) for name, scene in names["behavior"]]


def _sample(path: Path) -> dict[str, SourceText]:
    try:
        records = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
        return {each["name"]: SourceText(each["name"], each["bddl"], "embomatrix") for each in records}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise EvaluationError(
            f"{path} can't be read as the paper's sample ({error}): expected JSON lines with 'name' and 'bddl'"
        ) from error


class _Timed:
    """A method with a watch: ``planar_s`` are the seconds of its planar solver, by room, ``names`` what it added."""

    def __init__(self, method: Lay) -> None:
        self._method = method
        self.names: tuple[str, ...] = ()
        self.planar_s: tuple[float, ...] = ()

    def __call__(self, editor: SceneEditor, items: Sequence[RequestedObject], seed: int) -> Layout:
        layout = self._method(editor, items, seed)
        self.names = tuple(layout.names.values())
        self.planar_s = tuple(layout.record.planar_s.values())
        return layout


def judge(
    task: SceneTask, method: LayoutMethod, base: Scene, library: PlacementLibrary, *, seed: int = 0
) -> LayoutOutcome:
    """Lay a task out by a method, look at the scene, and execute the oracle's plan in it."""
    timed = _Timed(METHODS[method])
    began = time.process_time()
    imported = import_problem(task.source, base, seed=seed, options=ImportOptions(timed))
    spent = time.process_time() - began

    def outcome(
        reason: str,
        detail: str,
        *,
        generated: bool = False,
        verified: bool = False,
        solved: bool = False,
        beauty: float | None = None,
    ) -> LayoutOutcome:
        facts = (task.source.name, task.scene, method, generated, verified, solved, reason)
        return LayoutOutcome(*facts, spent, timed.planar_s, beauty, detail)

    if isinstance(imported, TaskRefusal):
        return outcome(imported.reason, imported.sentence)
    beauty = _beauty(imported)
    refusal, lost = _executed(imported, library, seed)
    if refusal is not None and refusal.reason is RefusalReason.INIT_NOT_MET:
        return outcome(refusal.reason, refusal.sentence, beauty=beauty)
    solved = refusal is None
    flaws = flaws_of(imported.scene, timed.names)
    if flaws:
        words = ", ".join(f"{name} {flaw}" for name, flaw in flaws)
        return outcome("geometry", words, generated=True, solved=solved, beauty=beauty)
    if lost:
        return outcome("out_of_hand", ", ".join(lost), generated=True, solved=solved, beauty=beauty)
    reason, detail = ("", "") if refusal is None else (refusal.reason.value, refusal.sentence)
    return outcome(reason, detail, generated=True, verified=True, solved=solved, beauty=beauty)


def _executed(
    imported: ImportedTask, library: PlacementLibrary, seed: int
) -> tuple[TaskRefusal | None, tuple[str, ...]]:
    """What speaks against a task when its oracle's plan is executed, None: nothing; and what the robot can't get at."""
    view = SceneView(imported.scene)
    poses = poses_for(imported, view, library, None, seed)
    with contextlib.closing(load_simulator(Bundle(imported.scene, {}, poses))) as stage:
        verdict = admit(stage, imported.task, find_plan, imported.init)
        lost = out_of_hand(stage, imported.task, view, imported.about)
    return (None if isinstance(verdict, Admitted) else verdict), lost


def _beauty(imported: ImportedTask) -> float:
    """Mean geometric score of the rooms that the task is about."""
    calibration = Calibration.load()
    return float(np.mean([score_room(plan_of(imported.scene, r), calibration).total for r in imported.rooms]))


def evaluation_of(outcomes: Sequence[LayoutOutcome], conditions: Mapping[str, Any]) -> EvaluationFigures:
    """Figures of all methods that were measured, the tree's with its goals, and the commonest reasons."""
    figures: list[Figure] = []
    notes: list[str] = []
    for method in LayoutMethod:
        mine = [outcome for outcome in outcomes if outcome.method is method]
        if mine:
            figures += _figures(mine, method)
            figures += _shared_aesthetics(outcomes, method)
            reasons = Counter(outcome.reason for outcome in mine if outcome.reason)
            told = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common(5)) or "none"
            notes.append(f"Commonest reasons against a scene, {method}: {told}.")
    return EvaluationFigures("scenes", conditions, tuple(figures), tuple(notes))


def _shared_aesthetics(outcomes: Sequence[LayoutOutcome], method: LayoutMethod) -> Iterable[Figure]:
    """Over the tasks that every measured method laid out: what a method fails at is what is hard to lay out well."""
    scores: defaultdict[tuple[str, str], dict[LayoutMethod, float]] = defaultdict(dict)
    for each in outcomes:
        if each.aesthetics is not None:
            scores[each.task, each.scene][each.method] = each.aesthetics
    measured = {each.method for each in outcomes}
    shared = [found[method] for found in scores.values() if measured <= found.keys()]
    if len(measured) > 1 and shared:
        name = f"aesthetics_shared{_label(method)}"
        yield Figure(name, float(np.mean(shared)), "of 10", Better.HIGHER, len(shared))


def _label(method: LayoutMethod) -> str:
    return "" if method is LayoutMethod.TREE else f" {method}"


def _figures(outcomes: Sequence[LayoutOutcome], method: LayoutMethod) -> Iterable[Figure]:
    goals = method is LayoutMethod.TREE
    label = _label(method)
    generated = [outcome for outcome in outcomes if outcome.generated]
    planar = [second for outcome in outcomes for second in outcome.planar_s]
    verified = sum(outcome.verified for outcome in generated)
    n = len(outcomes)
    yield Figure(
        f"generation_rate{label}", 100 * len(generated) / n, "%", Better.HIGHER, n, 95.0 if goals else None
    )
    if generated:
        rate = 100 * verified / len(generated)
        yield Figure(
            f"verification_pass_rate{label}",
            rate,
            "%",
            Better.HIGHER,
            len(generated),
            99.0 if goals else None,
        )
        solved = 100 * sum(outcome.solved for outcome in generated) / len(generated)
        yield Figure(f"oracle_solved_rate{label}", solved, "%", Better.HIGHER, len(generated))
    middle = float(np.median([outcome.scene_s for outcome in outcomes]))
    yield Figure(f"scene_s_p50{label}", middle, "s", Better.LOWER, n, 2.0 if goals else None)
    if planar:
        solve = 1000 * float(np.median(planar))
        yield Figure(f"planar_ms_p50{label}", solve, "ms", Better.LOWER, len(planar), 50.0 if goals else None)
    scores = [outcome.aesthetics for outcome in outcomes if outcome.aesthetics is not None]
    if scores and math.isfinite(sum(scores)):
        yield Figure(f"aesthetics{label}", float(np.mean(scores)), "of 10", Better.HIGHER, len(scores))
