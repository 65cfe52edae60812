"""Trial of one problem in one base scene, in seconds: bound, verified without the arm's reach, and explained check by check."""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

from embomatrix.factory.admission import RefusalReason, TaskRefusal
from embomatrix.factory.task_import.batch import Verified, has_host, imports, verify
from embomatrix.factory.task_import.task import ImportedTask, ImportOptions
from embomatrix.factory.task_import.task_file import TaskFile
from embomatrix.sim.physical.survey import ReachabilitySurvey
from embomatrix.sim.placing.pose_cache import PlacementLibrary
from embomatrix.world.scene import Scene

MAX_VERIFIED: Final = 3
"""Maximum number of layouts that are verified, for each of both sizes of the objects."""


class TrialStage(StrEnum):
    """Checks of a trial, in their order."""

    TEXT = "text"  # it parses, and every type and predicate exists
    OBJECTS = "objects"  # the scene has or gets each object
    START = "start"  # the facts of the start hold and the goal does not
    PLAN = "plan"  # the oracle's plan reaches the goal
    PHYSICS = "physics"  # a robot reaches it in stepped physics


STAGES: Final = {
    **dict.fromkeys(
        (
            RefusalReason.UNPARSABLE,
            RefusalReason.UNKNOWN_TYPE,
            RefusalReason.SUBSTANCE,
            RefusalReason.INEXPRESSIBLE,
            RefusalReason.ROOM_AS_OBJECT,
            RefusalReason.AGENT_IN_GOAL,
        ),
        TrialStage.TEXT,
    ),
    **dict.fromkeys(
        (
            RefusalReason.ROOM_MISSING,
            RefusalReason.NO_SCENE_OBJECT,
            RefusalReason.DOES_NOT_FIT,
            RefusalReason.NO_PLACE_GIVEN,
            RefusalReason.TABLE_TOO_LONG,
        ),
        TrialStage.OBJECTS,
    ),
    **dict.fromkeys(
        (RefusalReason.INIT_NOT_MET, RefusalReason.GOAL_HOLDS, RefusalReason.MOSTLY_DONE), TrialStage.START
    ),
    **dict.fromkeys((RefusalReason.NO_PLAN, RefusalReason.ORACLE_FAILED), TrialStage.PLAN),
    RefusalReason.PHYSICS_FAILED: TrialStage.PHYSICS,
}
"""Check that gives each refusal of an import."""
_WHATEVER_THE_LAYOUT: Final = frozenset((RefusalReason.GOAL_HOLDS, RefusalReason.MOSTLY_DONE))


@dataclass(frozen=True, slots=True)
class TaskTrial:
    """Result of a trial. ``bound`` is the task in its scene as last laid out; None if it was refused before."""

    bound: ImportedTask | None
    outcome: Verified | TaskRefusal


def try_task(
    file: TaskFile,
    base: Scene,
    library: PlacementLibrary,
    foresight: ReachabilitySurvey | None = None,
    *,
    seed: int = 0,
) -> TaskTrial:
    """Import the problem into the scene and verify it. A refusal is the one that came furthest.

    Unlike `verify_first`, which looks for a scene, this ends with the first goal that holds at the start.
    """
    options = ImportOptions(categories=file.categories, usable=True)
    order = list(RefusalReason)
    furthest: TaskTrial | None = None
    for compact in (False, True) if has_host(file.source) else (False,):
        verified = 0
        for found in imports(file.source, [base], seed=seed, options=replace(options, compact=compact)):
            if isinstance(found, TaskRefusal):
                trial = TaskTrial(None, found)
            else:
                trial = TaskTrial(found, verify(found, library, foresight, seed=seed))
                verified += 1
            if isinstance(trial.outcome, Verified) or trial.outcome.reason in _WHATEVER_THE_LAYOUT:
                return trial
            best = furthest.outcome if furthest is not None else None
            if not isinstance(best, TaskRefusal) or order.index(trial.outcome.reason) >= order.index(
                best.reason
            ):
                furthest = trial
            if verified == MAX_VERIFIED:
                break
    assert furthest is not None, "one base scene gives at least one import"
    return furthest
