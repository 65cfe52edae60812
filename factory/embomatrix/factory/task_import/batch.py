"""Import of problems over many scenes: each problem is bound to the first suitable scene and verified in the simulator."""

import contextlib
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeVar

from embomatrix.factory.admission import MAX_HELD_SHARE, RefusalReason, TaskRefusal, admit
from embomatrix.factory.pipeline.task_poses import PoseNeeds, SceneSurvey, cache_poses
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.task_import.dialects import read_problem
from embomatrix.factory.task_import.neighbours import neighbours_of
from embomatrix.factory.task_import.scene_changes import SceneChange, lacking, stock_of
from embomatrix.factory.task_import.size_requirements import requirements_of
from embomatrix.factory.task_import.sources import BEHAVIOR, EAI, SourceText
from embomatrix.factory.task_import.task import ImportedTask, ImportOptions, import_problem
from embomatrix.sim.live_world import prepare
from embomatrix.sim.physical.survey import ReachabilitySurvey
from embomatrix.sim.placing.pose_cache import PlacementLibrary
from embomatrix.sim.planner.oracle import find_plan
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import plan_to_json
from embomatrix.world.bundle import Bundle, encode_bundle
from embomatrix.world.dataset import TaskRecord
from embomatrix.world.inflation import bundle_digest
from embomatrix.world.poses import PoseCache
from embomatrix.world.scene import Scene
from embomatrix.world.task import Task

SCENE_INDEPENDENT: Final = frozenset(
    {
        RefusalReason.UNKNOWN_TYPE,
        RefusalReason.SUBSTANCE,
        RefusalReason.INEXPRESSIBLE,
        RefusalReason.ROOM_AS_OBJECT,
        RefusalReason.AGENT_IN_GOAL,
    }
)
"""Reasons that do not depend on the scene."""
OWN_SCENE_DRAWS: Final = 3
"""Number of layouts drawn in the problem's own scene before other scenes are tried."""
MAX_UNSOLVED: Final = 6
"""Maximum number of scenes in which a problem is laid out but not solved. Then the problem itself is the cause.

The same number of scenes is tried again with a compact layout if objects are on or in others.
"""
MAX_SAME_REFUSAL: Final = 3
"""Maximum number of such scenes in a row with the same refusal."""
SEED_STRIDE: Final = 1_000_003
"""Distance between the seeds of two draws. No other import uses such a seed."""
MAX_MISFITS: Final = 12
"""Maximum number of scenes per round in which the objects find no place. Laying out forty objects takes seconds."""
MAX_CHANGED: Final = 4
"""Maximum number of imports with changes that are made in search of one without."""


@dataclass(frozen=True, slots=True)
class Verified:
    """Admitted task with its bundle."""

    record: TaskRecord
    bundle: bytes
    notes: tuple[str, ...] = ()
    """Notes of the import."""
    changes: tuple[SceneChange, ...] = ()
    """Changes that make the binding unfaithful."""


Imported = ImportedTask | Verified | TaskRefusal
"""Result of an import."""


def bind_first(
    source: SourceText, bases: Sequence[Scene], *, seed: int = 0, options: ImportOptions | None = None
) -> ImportedTask | TaskRefusal:
    """Bind the problem with as few changes as possible. Otherwise return the refusal that came furthest. Raise BddlError.

    `imports` gives the order of the scenes.
    """
    return _first(imports(source, bases, seed=seed, options=options or ImportOptions()))


def imports(
    source: SourceText, bases: Sequence[Scene], *, seed: int, options: ImportOptions, draws: int = 1
) -> Iterator[ImportedTask | TaskRefusal]:
    """Yield imports of the problem into one scene after another, those with few changes first.

    The problem's own scene is tried ``draws`` times before all others, also with missing furniture added if the
    options allow it. Then come unchanged imports into the others, imports that only change objects, and imports with
    added furniture, into the scenes that lack least first. Refusals that do not depend on the scene end the search.
    """
    own = [base for base in bases if base.base == source.scene]
    others = _by_lack(source, [base for base in bases if base.base != source.scene])
    bare = replace(options, furnishing=False)
    for draw, base in itertools.product(range(draws), own):
        drawn = seed + draw * SEED_STRIDE
        outcome = import_problem(source, base, seed=drawn, options=bare)
        yield outcome
        if isinstance(outcome, TaskRefusal) and outcome.reason in SCENE_INDEPENDENT:
            return
        if isinstance(outcome, TaskRefusal) and options.furnishing:
            yield import_problem(source, base, seed=drawn, options=options)
    changed: list[ImportedTask] = []
    renumbered = replace(bare, renumbering=True)
    for number, (tried, scenes) in enumerate(((bare, others), (renumbered, [*own, *others]))):
        for outcome in _round(source, scenes, seed + number * SEED_STRIDE, tried):
            if isinstance(outcome, ImportedTask) and outcome.changes:
                changed.append(outcome)
                if len(changed) >= MAX_CHANGED:
                    break
                continue
            yield outcome
            if isinstance(outcome, TaskRefusal) and outcome.reason in SCENE_INDEPENDENT:
                return
    yield from sorted(changed, key=lambda imported: len(imported.changes))
    if options.furnishing:
        # Another seed: the rounds before have laid out some of these scenes already.
        yield from _round(source, others, seed + 2 * SEED_STRIDE, options)
        again = replace(options, renumbering=True)
        yield from _round(source, [*own, *others], seed + 3 * SEED_STRIDE, again)


def _by_lack(source: SourceText, bases: Sequence[Scene]) -> list[Scene]:
    """Return the scenes that the problem names first, then those with its rooms, then those that lack least furniture."""
    problem, _ = read_problem(source)

    def order(base: Scene) -> tuple[bool, float]:
        lack = lacking(problem, stock_of(base))
        return base.base not in source.named_scenes, math.inf if lack is None else lack

    return sorted(bases, key=order)


def _round(
    source: SourceText, scenes: Sequence[Scene], seed: int, options: ImportOptions
) -> Iterator[ImportedTask | TaskRefusal]:
    """Yield the import into each scene, until the objects have found no place in several."""
    misfits = 0
    for base in scenes:
        outcome = import_problem(source, base, seed=seed, options=options)
        yield outcome
        misfits += isinstance(outcome, TaskRefusal) and outcome.reason is RefusalReason.DOES_NOT_FIT
        if misfits == MAX_MISFITS:
            return


def verify_first(
    source: SourceText,
    bases: Sequence[Scene],
    library: PlacementLibrary,
    foresight: ReachabilitySurvey | None,
    *,
    seed: int = 0,
) -> Verified | TaskRefusal:
    """Import the problem into the first scene in which it is admitted. Otherwise return the refusal that came furthest.

    The order of the scenes is that of `bind_first`. Raise BddlError.
    """

    def outcomes() -> Iterator[Verified | TaskRefusal]:
        for compact in (False, True) if has_host(source) else (False,):
            laid_out, misfits, sentences = 0, 0, list[str]()
            for imported in imports(
                source,
                bases,
                seed=seed,
                options=ImportOptions(compact=compact, usable=True),
                draws=OWN_SCENE_DRAWS,
            ):
                if isinstance(imported, TaskRefusal):
                    misfits += imported.reason is RefusalReason.DOES_NOT_FIT
                    yield imported
                    continue
                outcome = verify(imported, library, foresight, seed=seed)
                yield outcome
                laid_out += 1
                sentences.append(outcome.sentence if isinstance(outcome, TaskRefusal) else "")
                repeated = sentences[-MAX_SAME_REFUSAL:].count(sentences[-1])
                if laid_out == MAX_UNSOLVED or repeated == MAX_SAME_REFUSAL:
                    break
            if not laid_out and not misfits:
                return

    return _first(outcomes())


def has_host(source: SourceText) -> bool:
    """True if an object is on or in another one at the start or in the goal. Raise BddlError."""
    problem, _ = read_problem(source)
    return any(each.contents or each.burden for each in requirements_of(problem).values())


T = TypeVar("T", ImportedTask, Verified)


def _first(outcomes: Iterable[T | TaskRefusal]) -> T | TaskRefusal:
    refusals: list[TaskRefusal] = []
    for outcome in outcomes:
        if not isinstance(outcome, TaskRefusal):
            return outcome
        refusals.append(outcome)
    if not refusals:
        raise ValueError("found no base scene: expected at least one")
    order = list(RefusalReason)
    return max(refusals, key=lambda refusal: order.index(refusal.reason))


def verify(
    imported: ImportedTask, library: PlacementLibrary, foresight: ReachabilitySurvey | None, *, seed: int = 0
) -> Verified | TaskRefusal:
    """Verify an imported task by execution, and pack its bundle. Without ``foresight``, the arm is not analysed."""
    poses = poses_for(imported, SceneView(imported.scene), library, foresight, seed)
    with contextlib.closing(load_simulator(Bundle(imported.scene, {}, poses))) as simulator:
        verdict = admit(
            simulator, imported.task, find_plan, imported.init, most_held=max_held_share(imported.task)
        )
        if isinstance(verdict, TaskRefusal):
            return verdict
        bundle = Bundle(imported.scene, {imported.task.task_id: imported.task}, poses)
        data = encode_bundle(prepare(bundle, simulator.world))
    record = TaskRecord(
        task=imported.task,
        bundle_digest=bundle_digest(data),
        split="heldout" if imported.is_held_out else "train",
        oracle=tuple(plan_to_json(verdict)),
        rooms=imported.rooms,
        signature=imported.signature,
    )
    return Verified(record, data, imported.notes, imported.changes)


def poses_for(
    imported: ImportedTask,
    view: SceneView,
    library: PlacementLibrary,
    foresight: ReachabilitySurvey | None,
    seed: int,
) -> PoseCache:
    """Return the pose cache of an imported task's scene."""
    task = imported.task
    needs = PoseNeeds(imported.about, task.table, neighbours_of(task.goal, task.types, view.is_portable))
    with SceneSurvey(imported.scene, foresight) as survey:
        return cache_poses(view, [needs], library, survey, seed)


def max_held_share(task: Task) -> float:
    """Return the share of a task's atoms that may hold at the start. Tasks of published benchmarks have no limit."""
    return 1.0 if task.source in (BEHAVIOR, EAI) else MAX_HELD_SHARE
