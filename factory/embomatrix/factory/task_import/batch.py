"""Imports of many problems: each is bound to the first scene that has what it needs, then judged in the simulator."""

from __future__ import annotations

import contextlib
import itertools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, TypeVar

from embomatrix.factory.admission import MOST_HELD, Admitted, RefusalReason, TaskRefusal, admit
from embomatrix.factory.pipeline.task_poses import Needs, SceneSurvey, cache_poses
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.task_import.dialects import read_problem
from embomatrix.factory.task_import.neighbours import neighbours_of
from embomatrix.factory.task_import.size_requirements import demands_of
from embomatrix.factory.task_import.sources import BEHAVIOR, EAI
from embomatrix.factory.task_import.task import ImportedTask, Manner, import_problem
from embomatrix.sim.live_world import prepare
from embomatrix.sim.planner.oracle import find_plan
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import plan_to_json
from embomatrix.world.bundle import Bundle, encode_bundle
from embomatrix.world.dataset import TaskRecord
from embomatrix.world.inflation import bundle_digest

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from embomatrix.factory.task_import.sources import SourceText
    from embomatrix.sim.physical.survey import ReachabilitySurvey
    from embomatrix.sim.placing.pose_cache import PlacementLibrary
    from embomatrix.world.poses import PoseCache
    from embomatrix.world.scene import Scene
    from embomatrix.world.task import Task


OF_THE_PROBLEM: Final = frozenset(
    {
        RefusalReason.UNKNOWN_TYPE,
        RefusalReason.SUBSTANCE,
        RefusalReason.INEXPRESSIBLE,
        RefusalReason.ROOM_AS_OBJECT,
        RefusalReason.AGENT_IN_GOAL,
    }
)
"""Reasons that are the same in every scene."""
DRAWS: Final = 3
"""Ways to lay a problem out in its first scene, from seeds of their own, before another scene is looked at."""
MOST_UNSOLVED: Final = 6
"""Scenes in which a problem is laid out and not solved before it is given up: what stops it is then no scene's fault.

So many more are looked at with a snug layout, where things are to share a cavity or a surface.
"""
MOST_ALIKE: Final = 3
"""Such scenes in a row of which the same is told."""
STRIDE: Final = 1_000_003
"""Between the seeds of two draws: no other problem is imported with such a one."""
MOST_MISFITS: Final = 12
"""Scenes with all rooms and furniture in which a problem's things find no place, before the next way is tried: laying out forty
things takes seconds.
"""


@dataclass(frozen=True, slots=True)
class Verified:
    """An imported task that was admitted, with its bundle."""

    record: TaskRecord
    bundle: bytes
    notes: tuple[str, ...] = ()
    """As those of the import."""


def bind_first(
    source: SourceText, bases: Sequence[Scene], *, seed: int = 0, manner: Manner | None = None
) -> ImportedTask | TaskRefusal:
    """The problem in the first scene that it can be bound to, else the refusal that came furthest. Raises BddlError.

    The scene that it was written for comes first, then those that have all furniture, then those that lack some.
    """
    return _first(imports(source, bases, seed=seed, manner=manner or Manner()))


def imports(
    source: SourceText, bases: Sequence[Scene], *, seed: int, manner: Manner, draws: int = 1
) -> Iterator[ImportedTask | TaskRefusal]:
    """The problem in each scene as it is, then, where the manner says so, in each with the furniture that it lacks.

    Last come the same scenes with their rooms counted otherwise. The scene that it was written for comes before all that,
    in both ways, ``draws`` times; once no scene would do, none is looked at further.
    """
    own = [base for base in bases if base.base == source.scene]
    others = [base for base in bases if base.base != source.scene]
    as_it_is = replace(manner, furnishing=False)
    for draw, base in itertools.product(range(draws), own):
        drawn = seed + draw * STRIDE
        outcome = import_problem(source, base, seed=drawn, manner=as_it_is)
        yield outcome
        if isinstance(outcome, TaskRefusal) and outcome.reason in OF_THE_PROBLEM:
            return
        if isinstance(outcome, TaskRefusal) and manner.furnishing:
            yield import_problem(source, base, seed=drawn, manner=manner)
    rounds = [(as_it_is, others)]
    if manner.furnishing:
        rounds += [(manner, others), (replace(manner, renumbering=True), [*own, *others])]
    for tried, scenes in rounds:
        misfits = 0
        for base in scenes:
            outcome = import_problem(source, base, seed=seed, manner=tried)
            yield outcome
            if not isinstance(outcome, TaskRefusal):
                continue
            if outcome.reason in OF_THE_PROBLEM:
                return
            misfits += outcome.reason is RefusalReason.DOES_NOT_FIT
            if misfits == MOST_MISFITS:
                break


def verify_first(
    source: SourceText,
    bases: Sequence[Scene],
    library: PlacementLibrary,
    foresight: ReachabilitySurvey | None,
    *,
    seed: int = 0,
    manner: Manner | None = None,
) -> Verified | TaskRefusal:
    """The problem in the first scene in which it is admitted, else the refusal that came furthest. Raises BddlError.

    The scene that it was written for comes first, then those that have all furniture, then those that lack some.
    """

    def judged() -> Iterator[Verified | TaskRefusal]:
        given = manner or Manner()
        for tried in (given, replace(given, snug=True)) if shares_room(source) else (given,):
            laid_out, misfits, told = 0, 0, list[str]()
            for imported in imports(source, bases, seed=seed, manner=tried, draws=DRAWS):
                if isinstance(imported, TaskRefusal):
                    misfits += imported.reason is RefusalReason.DOES_NOT_FIT
                    yield imported
                    continue
                judged = verify(imported, library, foresight, seed=seed)
                yield judged
                laid_out += 1
                told.append(judged.sentence if isinstance(judged, TaskRefusal) else "")
                alike = told[-MOST_ALIKE:].count(told[-1])
                if laid_out == MOST_UNSOLVED or alike == MOST_ALIKE:
                    break
            if not laid_out and not misfits:
                return

    return _first(judged())


def shares_room(source: SourceText) -> bool:
    """Whether a problem has more than one thing in or on another, at the start or in the end. Raises BddlError."""
    problem, _ = read_problem(source)
    return any(max(len(each.contents), len(each.burden)) > 1 for each in demands_of(problem).values())


T = TypeVar("T", ImportedTask, Verified)


def _first(outcomes: Iterable[T | TaskRefusal]) -> T | TaskRefusal:
    refusals: list[TaskRefusal] = []
    for outcome in outcomes:
        if not isinstance(outcome, TaskRefusal):
            return outcome
        refusals.append(outcome)
    if not refusals:
        raise ValueError("no scene to bind to: expected at least one")
    order = list(RefusalReason)
    return max(refusals, key=lambda refusal: order.index(refusal.reason))


def verify(
    imported: ImportedTask, library: PlacementLibrary, foresight: ReachabilitySurvey | None, *, seed: int = 0
) -> Verified | TaskRefusal:
    """Judge an imported task by execution, and pack it when it is admitted. Without ``foresight`` the arm is not asked."""
    poses = poses_for(imported, SceneView(imported.scene), library, foresight, seed)
    with contextlib.closing(load_simulator(Bundle(imported.scene, {}, poses))) as stage:
        verdict = admit(stage, imported.task, find_plan, imported.init, most_held=most_held_in(imported.task))
        if not isinstance(verdict, Admitted):
            return verdict
        bundle = Bundle(imported.scene, {imported.task.task_id: imported.task}, poses)
        data = encode_bundle(prepare(bundle, stage.world))
    record = TaskRecord(
        task=imported.task,
        bundle_digest=bundle_digest(data),
        split="heldout" if imported.examines else "train",
        oracle=tuple(plan_to_json(verdict.plan)),
        rooms=imported.rooms,
        signature=imported.signature,
    )
    return Verified(record, data, imported.notes)


def poses_for(
    imported: ImportedTask,
    view: SceneView,
    library: PlacementLibrary,
    foresight: ReachabilitySurvey | None,
    seed: int,
) -> PoseCache:
    """The pose cache of an imported task's scene."""
    task = imported.task
    needs = Needs(imported.about, task.table, neighbours_of(task.goal, task.types, view.is_portable))
    with SceneSurvey(imported.scene, foresight) as survey:
        return cache_poses(view, [needs], library, survey, seed)


def most_held_in(task: Task) -> float:
    """Share of a task's atoms that may hold at the start: the questions of published benchmarks are as they are."""
    return 1.0 if task.source in (BEHAVIOR, EAI) else MOST_HELD
