"""Causes of failure: rules that assign one cause to a failed plan from the plan and its trace alone.

The first failure decides; in an episode, which goes on after a failure, the last call does. `docs/evaluation.md` explains the
rules; a test proves the tables complete.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from embomatrix.skills.failure import FailureReason
from embomatrix.skills.parse import PlanReason
from embomatrix.skills.syntax import Plan, Skill, SkillCall
from embomatrix.skills.trace import Step


class Cause(StrEnum):
    """Causes of failure, in table order."""

    UNPARSABLE = "unparsable"
    HALLUCINATED_SKILL = "hallucinated_skill"
    WRONG_ARGUMENT = "wrong_argument"
    HALLUCINATED_OBJECT = "hallucinated_object"
    AFFORDANCE = "affordance"
    MISSING_STEP = "missing_step"
    WRONG_ORDER = "wrong_order"
    ADDITIONAL_STEP = "additional_step"
    UNREACHABLE = "unreachable"
    NO_ROOM = "no_room"
    MISHAP = "mishap"
    GOAL_NOT_MET = "goal_not_met"


MEANINGS: Final[Mapping[Cause, str]] = {
    Cause.UNPARSABLE: "the text contains no plan, or a plan that is too long",
    Cause.HALLUCINATED_SKILL: "the plan calls a skill that the task does not offer",
    Cause.WRONG_ARGUMENT: "an argument of a call is missing or of the wrong kind",
    Cause.HALLUCINATED_OBJECT: "a step names an object or a room that does not exist",
    Cause.AFFORDANCE: "a step asks an object for something that it can never do",
    Cause.MISSING_STEP: "a step needs another one before it, which the plan does not contain",
    Cause.WRONG_ORDER: "a step needs another one before it, which the plan contains only after it",
    Cause.ADDITIONAL_STEP: "a step asks for a state that already holds",
    Cause.UNREACHABLE: "the robot or its arm can't reach the target",
    Cause.NO_ROOM: "there is no free place for the object",
    Cause.MISHAP: "physical mode: the robot collided, or the object slipped or fell",
    Cause.GOAL_NOT_MET: "no failed step ended it, but the goal does not hold",
}
"""Explanation of each cause."""


@dataclass(frozen=True, slots=True)
class Remedy:
    """Skill call that would have made a precondition true. ``any_object``: it need not be about the step's blocker."""

    skill: Skill
    any_object: bool = False


PLAN_CAUSES: Final[Mapping[PlanReason, Cause]] = {
    PlanReason.TOO_LONG: Cause.UNPARSABLE,
    PlanReason.NO_PLAN: Cause.UNPARSABLE,
    PlanReason.TOO_MANY_STEPS: Cause.UNPARSABLE,
    PlanReason.UNKNOWN_SKILL: Cause.HALLUCINATED_SKILL,
    PlanReason.MISSING_ARGUMENT: Cause.WRONG_ARGUMENT,
    PlanReason.WRONG_ARGUMENT: Cause.WRONG_ARGUMENT,
}
"""Causes for a text without a valid plan."""

REMEDIES: Final[Mapping[FailureReason, Remedy]] = {
    FailureReason.NOT_THERE: Remedy(Skill.SLICE, any_object=True),
    FailureReason.OUT_OF_REACH: Remedy(Skill.MOVE),
    FailureReason.NO_LINE_OF_APPROACH: Remedy(Skill.MOVE),
    FailureReason.HAND_FULL: Remedy(Skill.PLACE, any_object=True),
    FailureReason.HAND_EMPTY: Remedy(Skill.PICK_UP, any_object=True),
    FailureReason.SUPPORTS_OTHERS: Remedy(Skill.PICK_UP),
    FailureReason.CONTAINER_CLOSED: Remedy(Skill.OPEN),
    FailureReason.OPENED_WHILE_ON: Remedy(Skill.TOGGLE_OFF),
    FailureReason.MUST_BE_CLOSED: Remedy(Skill.CLOSE),
    FailureReason.SOURCE_OFF: Remedy(Skill.TOGGLE_ON),
    FailureReason.SOURCE_OPEN: Remedy(Skill.CLOSE),
    FailureReason.NOT_AT_SOURCE: Remedy(Skill.PLACE),
    FailureReason.TOOL_NOT_HELD: Remedy(Skill.PICK_UP),
    FailureReason.NEEDS_SOAKING: Remedy(Skill.SOAK),
}
"""Preconditions that another call can satisfy.

If the plan contains the call later, the cause is wrong order, else missing step.
"""

STEP_CAUSES: Final[Mapping[FailureReason, Cause]] = {
    FailureReason.UNKNOWN_INDEX: Cause.HALLUCINATED_OBJECT,
    FailureReason.UNKNOWN_ROOM: Cause.HALLUCINATED_OBJECT,
    FailureReason.NO_PATH: Cause.UNREACHABLE,
    FailureReason.NO_STANDING_POSE: Cause.UNREACHABLE,
    FailureReason.BLOCKED: Cause.UNREACHABLE,
    FailureReason.STEP_TOO_LONG: Cause.UNREACHABLE,
    FailureReason.TOO_HIGH: Cause.UNREACHABLE,
    FailureReason.ARM_BLOCKED: Cause.UNREACHABLE,
    FailureReason.DOOR_BLOCKED: Cause.UNREACHABLE,
    FailureReason.NO_FREE_POSE: Cause.NO_ROOM,
    FailureReason.PLACES_OUT_OF_REACH: Cause.UNREACHABLE,
    FailureReason.PLACES_BEHIND_DOOR: Cause.UNREACHABLE,
    FailureReason.ALREADY_OPEN: Cause.ADDITIONAL_STEP,
    FailureReason.ALREADY_CLOSED: Cause.ADDITIONAL_STEP,
    FailureReason.ALREADY_ON: Cause.ADDITIONAL_STEP,
    FailureReason.ALREADY_OFF: Cause.ADDITIONAL_STEP,
    FailureReason.ALREADY_SLICED: Cause.ADDITIONAL_STEP,
    FailureReason.COLLIDED: Cause.MISHAP,
    FailureReason.SLIPPED: Cause.MISHAP,
    FailureReason.FELL: Cause.MISHAP,
    **dict.fromkeys(
        (
            FailureReason.NOT_PORTABLE,
            FailureReason.TOO_HEAVY,
            FailureReason.TOO_LARGE,
            FailureReason.NOT_OPENABLE,
            FailureReason.NOT_TOGGLEABLE,
            FailureReason.NO_SURFACE,
            FailureReason.NO_CAVITY,
            FailureReason.PLACE_ON_ITSELF,
            FailureReason.NOT_A_HEAT_SOURCE,
            FailureReason.NOT_A_COLD_SOURCE,
            FailureReason.NOT_HEATABLE,
            FailureReason.NOT_COOKABLE,
            FailureReason.NOT_FREEZABLE,
            FailureReason.NOT_HOT_ENOUGH,
            FailureReason.NOT_COLD_ENOUGH,
            FailureReason.NOT_A_SLICER,
            FailureReason.NOT_SLICEABLE,
            FailureReason.NOT_A_CLEANER,
            FailureReason.STAYS_ON,
            FailureReason.GIVES_NO_LIQUID,
            FailureReason.NOT_SOAKABLE,
        ),
        Cause.AFFORDANCE,
    ),
}
"""Causes that follow from the failure reason alone."""


def cause_of_trace(plan: Plan, steps: Sequence[Step], table: Sequence[str]) -> Cause:
    """Cause for an executed plan that missed its goal.

    ``table`` is the task's object table; ``steps`` end with the failed step.
    """
    last = steps[-1] if steps else None
    if last is None or last.failure is None:
        return Cause.GOAL_NOT_MET
    remedy = REMEDIES.get(last.failure)
    if remedy is None:
        return STEP_CAUSES[last.failure]
    later = plan[len(steps) :]
    if any(call.skill is remedy.skill and _is_about(call, remedy, last, table) for call in later):
        return Cause.WRONG_ORDER
    return Cause.MISSING_STEP


def _is_about(call: SkillCall, remedy: Remedy, failed: Step, table: Sequence[str]) -> bool:
    """Return True if the call is about the object that made the failed step fail."""
    index = call.object_index
    if remedy.any_object:
        return True
    return index is not None and 0 <= index < len(table) and table[index] == failed.blocker
