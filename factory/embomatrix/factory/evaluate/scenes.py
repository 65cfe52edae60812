"""Scene quality: the same tasks laid out by three methods, each scene judged by code that no method uses.

A task is generated if every object has a place and its start state holds in the simulator. A generated task is verified, as
in the paper, if the robot can manipulate its objects in the simulator and the geometry of the added objects is valid. The
share of tasks that the oracle solves is a separate figure, because it also depends on the skills.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from embomatrix.factory.admission import RefusalReason, TaskRefusal, admit
from embomatrix.factory.evaluate.aesthetics import Calibration, score_room
from embomatrix.factory.evaluate.manipulation import out_of_hand
from embomatrix.factory.evaluate.room_plans import plan_of
from embomatrix.factory.evaluate.scene_geometry import flaws_of
from embomatrix.factory.layout.baselines import PoseWriter, lay_at_random
from embomatrix.factory.layout.generator import lay
from embomatrix.factory.layout.request import Layout, RequestedObject
from embomatrix.factory.metrics.figures import EvaluationError, EvaluationFigures
from embomatrix.factory.pipeline.store import ResumableLog
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.editor import LayoutReason, SceneEditor
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.task_import.batch import max_held_share, poses_for
from embomatrix.factory.task_import.sources import SourceText, read_activity, read_jsonl
from embomatrix.factory.task_import.task import ImportedTask, ImportOptions, Lay, import_problem
from embomatrix.llm.cassette import Cassette
from embomatrix.llm.endpoint import Endpoint
from embomatrix.pages.figures import Better, Figure
from embomatrix.sim.placing.pose_cache import PlacementLibrary
from embomatrix.sim.planner.oracle import find_plan
from embomatrix.sim.process_pool import shared_work
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import Bundle
from embomatrix.world.json_text import parse_json
from embomatrix.world.scene import Scene

LIST: Final = "scene_tasks.json"
POSES: Final = "smollm2_poses.jsonl"
RESAMPLES: Final = 1000
"""Resamples of the bootstrap for the intervals of the mean aesthetics score."""


class LayoutMethod(StrEnum):
    """Layout method of a task."""

    TREE = "tree"
    RANDOM = "random"
    POSES = "poses"


@dataclass(frozen=True, slots=True)
class PoseSource:
    """Language model that writes the poses of `LayoutMethod.POSES`: a recording, to which an endpoint adds what it lacks.

    The default is the packaged recording of SmolLM2-135M-Instruct for the fixed tasks; NOTICE.md describes it.
    """

    recording: Path | None = None
    url: str = ""
    model: str = ""
    key: str = field(default="", repr=False)

    def settings(self) -> dict[str, str]:
        """Return the names of model and recording, which decide the poses. Raises OSError.

        A recording is named by its digest; one that an endpoint extends changes with every answer, so its file names it.
        """
        if self.url:
            return {
                "pose model": self.model,
                "pose recording": self.recording.name if self.recording is not None else POSES,
            }
        with self._file() as path:
            data = path.read_bytes() if path.is_file() else b""
        return {"pose model": ", ".join(_models_in(data)), "pose recording": _digest(data)}

    def _file(self) -> contextlib.AbstractContextManager[Path]:
        """Return the file of the recording."""
        if self.recording is not None:
            return contextlib.nullcontext(self.recording)
        return resources.as_file(resources.files("embomatrix.factory.evaluate") / POSES)

    @contextlib.contextmanager
    def methods(self) -> Iterator[Mapping[LayoutMethod, Lay]]:
        """Yield all layout methods. Raises EndpointError or CassetteError."""
        endpoint = Endpoint(self.url, self.model, api_key=self.key) if self.url else None
        with self._file() as path, PoseWriter(Cassette(path, endpoint), endpoint) as writer:
            yield {
                LayoutMethod.TREE: lay,
                LayoutMethod.RANDOM: lay_at_random,
                LayoutMethod.POSES: writer.lay,
            }


PACKAGED_POSES: Final = PoseSource()


def _models_in(recording: bytes) -> list[str]:
    """Return the names of the models whose answers a recording holds. The recording is judged where it is played."""
    names = set()
    for line in recording.splitlines():
        try:
            names.add(str(parse_json(line)["model"]))
        except (ValueError, LookupError, TypeError):
            continue
    return sorted(names)


def _digest(data: bytes) -> str:
    return f"sha256:{hashlib.sha256(data).hexdigest()[:16]}"


def task_list_settings(tasks: Sequence[SourceText]) -> dict[str, str]:
    """Return the digest of a list of tasks with their scenes."""
    listed = json.dumps([[task.name, task.scene, task.text] for task in tasks])
    return {"task list": _digest(listed.encode("utf-8"))}


@dataclass(frozen=True, slots=True)
class LayoutOutcome:
    """Outcome of one task with one method; ``solved`` means that the oracle's plan reaches the goal.

    ``scene_s`` and ``planar_s`` are CPU seconds, the latter by room. ``unwritten`` counts objects for which a language model
    wrote no usable pose.
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
    unwritten: int = 0


def fixed_tasks(sample: Path) -> list[SourceText]:
    """Return 70 tasks of the paper's sample file and 70 tasks of BEHAVIOR-1K with their base scenes.

    Raise EvaluationError or ProblemSourceError."""
    text = (resources.files("embomatrix.factory.evaluate") / LIST).read_text(encoding="utf-8")
    names = json.loads(text)
    known = {source.name: source for source in read_jsonl(sample)}
    missing = [name for name, _ in names["sample"] if name not in known]
    if missing:
        raise EvaluationError(
            f"{sample} lacks {len(missing)} of the fixed tasks, {missing[0]!r} first: expected the sample of 400 tasks"
        )
    paper = [replace(known[name], scene=scene) for name, scene in names["sample"]]
    return paper + [replace(read_activity(name), scene=scene) for name, scene in names["behavior"]]


class RecordedMethod:
    """Layout method that records its planar solver's CPU seconds by room, the objects it added, and unwritten poses."""

    def __init__(self, method: Lay) -> None:
        self._method = method
        self.names: tuple[str, ...] = ()
        self.planar_s: tuple[float, ...] = ()
        self.unwritten = 0

    def __call__(self, editor: SceneEditor, items: Sequence[RequestedObject], seed: int) -> Layout:
        layout = self._method(editor, items, seed)
        self.names = tuple(layout.names.values())
        self.planar_s = tuple(layout.record.planar_s.values())
        self.unwritten = sum(failure.reason is LayoutReason.NO_POSE for failure in layout.failures)
        return layout


def judge(
    task: SourceText,
    method: LayoutMethod,
    base: Scene,
    library: PlacementLibrary,
    methods: Mapping[LayoutMethod, Lay],
    *,
    seed: int = 0,
) -> LayoutOutcome:
    """Lay a task out with a method, check the scene, and execute the oracle's plan in it."""
    timed = RecordedMethod(methods[method])
    began = time.process_time()
    imported = import_problem(task, base, seed=seed, options=ImportOptions(lay=timed))
    refused = LayoutOutcome(
        task=task.name,
        scene=task.scene,
        method=method,
        generated=False,
        verified=False,
        solved=False,
        reason="",
        scene_s=time.process_time() - began,
        planar_s=timed.planar_s,
        aesthetics=None,
        unwritten=timed.unwritten,
    )
    if isinstance(imported, TaskRefusal):
        return replace(refused, reason=imported.reason.value, detail=imported.sentence)
    refused = replace(refused, aesthetics=_beauty(imported, timed.names))
    refusal, lost = _executed(imported, library, seed)
    if refusal is not None and refusal.reason is RefusalReason.INIT_NOT_MET:
        return replace(refused, reason=refusal.reason.value, detail=refusal.sentence)
    generated = replace(refused, generated=True, solved=refusal is None)
    if flaws := flaws_of(imported.scene, timed.names):
        words = ", ".join(f"{name} {flaw}" for name, flaw in flaws)
        return replace(generated, reason="geometry", detail=words)
    if lost:
        return replace(generated, reason="out_of_hand", detail=", ".join(lost))
    verified = replace(generated, verified=True)
    if refusal is None:
        return verified
    return replace(verified, reason=refusal.reason.value, detail=refusal.sentence)


def _executed(
    imported: ImportedTask, library: PlacementLibrary, seed: int
) -> tuple[TaskRefusal | None, tuple[str, ...]]:
    """Execute the oracle's plan; return the refusal, None if the task is solved, and the objects out of reach."""
    view = SceneView(imported.scene)
    poses = poses_for(imported, view, library, None, seed)
    with contextlib.closing(load_simulator(Bundle(imported.scene, {}, poses))) as simulator:
        most_held = max_held_share(imported.task)
        verdict = admit(simulator, imported.task, find_plan, imported.init, most_held=most_held)
        lost = out_of_hand(simulator, imported.task, view, imported.about)
    return (verdict if isinstance(verdict, TaskRefusal) else None), lost


def _beauty(imported: ImportedTask, added: Sequence[str]) -> float | None:
    """Return the mean geometric score of the added objects in the task's rooms; None if nothing was added."""
    calibration = Calibration.load()
    rooms = dict.fromkeys(imported.scene.by_name[name].room for name in added)
    scores = [score_room(plan_of(imported.scene, room, added), calibration) for room in rooms]
    known = [score for score in scores if score is not None]
    return float(np.mean(known)) if known else None


def evaluation_of(
    outcomes: Sequence[LayoutOutcome],
    conditions: Mapping[str, Any],
) -> EvaluationFigures:
    """Return the figures of all measured methods, and the commonest reasons for rejection.

    Only the tree method has goals.
    """
    figures: list[Figure] = []
    notes: list[str] = []
    for method in LayoutMethod:
        mine = [outcome for outcome in outcomes if outcome.method is method]
        if mine:
            shared = _shared_scores(outcomes, method)
            figures += _figures(mine, method, shared)
            reasons = Counter(outcome.reason for outcome in mine if outcome.reason)
            counts = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common(5)) or "none"
            notes.append(f"Most common reasons for rejection, {method}: {counts}.")
            if shared:
                low, high = interval_of_mean(shared)
                notes.append(f"95 % interval of aesthetics_shared, {method}: [{low:.2f}, {high:.2f}].")
    return EvaluationFigures("scenes", conditions, tuple(figures), tuple(notes))


def _shared_scores(outcomes: Sequence[LayoutOutcome], method: LayoutMethod) -> list[float]:
    """Return the scores of tasks that every method laid out: tasks on which a method fails are hard to lay out well."""
    scores: defaultdict[tuple[str, str], dict[LayoutMethod, float]] = defaultdict(dict)
    for each in outcomes:
        if each.aesthetics is not None:
            scores[each.task, each.scene][each.method] = each.aesthetics
    measured = {each.method for each in outcomes}
    shared = [found[method] for found in scores.values() if measured <= found.keys()]
    return shared if len(measured) > 1 else []


def interval_of_mean(scores: Sequence[float]) -> tuple[float, float]:
    """Return the 95 % interval of the mean by a bootstrap over tasks with a fixed seed."""
    rng = np.random.default_rng(len(scores))
    means = rng.choice(np.asarray(scores), (RESAMPLES, len(scores))).mean(axis=1)  # (resamples,)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def _figures(
    outcomes: Sequence[LayoutOutcome], method: LayoutMethod, shared: Sequence[float]
) -> Iterable[Figure]:
    """Yield the figures of a method that have values. Only the tree method has goals."""
    is_tree = method is LayoutMethod.TREE
    generated = [outcome for outcome in outcomes if outcome.generated]
    planar_ms = [1000 * second for outcome in outcomes for second in outcome.planar_s]
    scores = [outcome.aesthetics for outcome in outcomes if outcome.aesthetics is not None]
    up, down = Better.HIGHER, Better.LOWER
    written = [100.0 * (not each.unwritten) for each in outcomes if method is LayoutMethod.POSES]
    rows = (
        ("poses_written", np.mean, written, "%", up, None),
        ("generation_rate", np.mean, [100.0 * each.generated for each in outcomes], "%", up, 95.0),
        ("verification_pass_rate", np.mean, [100.0 * each.verified for each in generated], "%", up, 99.0),
        ("oracle_solved_rate", np.mean, [100.0 * each.solved for each in generated], "%", up, None),
        ("scene_s_p50", np.median, [each.scene_s for each in outcomes], "s", down, 2.0),
        ("planar_ms_p50", np.median, planar_ms, "ms", down, 50.0),
        ("aesthetics", np.mean, scores, "of 10", up, None),
        ("aesthetics_shared", np.mean, shared, "of 10", up, None),
    )
    for name, average, values, unit, better, goal in rows:
        if values:
            label = name if is_tree or values is written else f"{name} {method}"
            value = float(average(values))
            yield Figure(label, value, unit, better, len(values), goal if is_tree else None)


Trial = tuple[SourceText, LayoutMethod]


def outcome_log(
    path: Path | None, seed: int, settings: Mapping[str, str] = MappingProxyType({})
) -> ResumableLog[LayoutOutcome]:
    """Start or resume the log of trials with one seed; a truncated last line is dropped. Raises DatasetError, OSError.

    ``settings`` name what else decides the outcomes: the source of poses and the list of tasks.
    """
    log = ResumableLog[LayoutOutcome](path)
    log.resume({"seed": seed, **settings}, _outcome)
    return log


def _outcome(value: dict[str, Any]) -> LayoutOutcome:
    fields = {**value, "method": LayoutMethod(value["method"]), "planar_s": tuple(value["planar_s"])}
    return LayoutOutcome(**fields)


def evaluate_scenes(
    tasks: Sequence[SourceText],
    methods: Sequence[LayoutMethod],
    seed: int,
    jobs: int,
    progress: Callable[[int], None] = lambda _done: None,
    log: ResumableLog[LayoutOutcome] | None = None,
    poses: PoseSource = PACKAGED_POSES,
) -> tuple[EvaluationFigures, list[LayoutOutcome]]:
    """Run every task with every method and call ``progress`` with the number of finished trials.

    Trials in the ``log`` are skipped, new ones are appended to it. Equal arguments give equal outcomes.
    """
    log = log or ResumableLog[LayoutOutcome]()
    trials = [(task, method) for task in tasks for method in methods]
    known = {(each.task, each.scene, each.method) for each in log.outcomes}
    by_scene: defaultdict[str, list[Trial]] = defaultdict(list)
    for task, method in trials:
        if (task.name, task.scene, method) not in known:
            by_scene[task.scene].append((task, method))
    progress(len(trials) - sum(map(len, by_scene.values())))
    died = EvaluationError(
        "a process that judges layouts died, possibly for lack of memory: run the same command with fewer --jobs"
    )
    with shared_work(jobs, PlacementLibrary, partial(_judged, seed, poses), died=died) as judge_all:
        for outcome in itertools.chain.from_iterable(judge_all(by_scene.values())):
            log.add(outcome)
            progress(len(log.outcomes))
    found = {(each.task, each.scene, each.method): each for each in log.outcomes}
    outcomes = [found[task.name, task.scene, method] for task, method in trials]
    conditions = {
        "tasks": len(tasks),
        "base scenes": len({task.scene for task in tasks}),
        "seed": seed,
        "methods": ", ".join(methods),
        **task_list_settings(tasks),
        **poses.settings(),
        "time": "CPU seconds of one task from BDDL text to scene, base scene built before, execution after",
    }
    return evaluation_of(outcomes, conditions), outcomes


def _judged(
    seed: int, poses: PoseSource, library: PlacementLibrary, trials: Sequence[Trial]
) -> list[LayoutOutcome]:
    """Return the outcomes of the trials in one base scene."""
    base = build_base_scene(trials[0][0].scene)
    with poses.methods() as methods:
        return [judge(task, method, base, library, methods, seed=seed) for task, method in trials]
