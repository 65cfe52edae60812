"""Why a task does not enter a data set: a closed set of reasons, each refusal with a sentence about the case."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class RefusalReason(StrEnum):
    """In the order in which they are looked for: the first two stop a draft, then ten a binding, the others an admission."""

    NO_ANSWER = "no_answer"
    UNUSABLE_ANSWER = "unusable_answer"
    UNKNOWN_TYPE = "unknown_type"
    SUBSTANCE = "substance"
    INEXPRESSIBLE = "inexpressible"
    ROOM_MISSING = "room_missing"
    ROOM_AS_OBJECT = "room_as_object"
    AGENT_IN_GOAL = "agent_in_goal"
    NO_SCENE_OBJECT = "no_scene_object"
    DOES_NOT_FIT = "does_not_fit"
    NO_PLACE_GIVEN = "no_place_given"
    TABLE_TOO_LONG = "table_too_long"
    INIT_NOT_MET = "init_not_met"
    GOAL_HOLDS = "goal_holds"
    MOSTLY_DONE = "mostly_done"
    NO_PLAN = "no_plan"
    ORACLE_FAILED = "oracle_failed"
    PHYSICS_FAILED = "physics_failed"


@dataclass(frozen=True, slots=True)
class TaskRefusal:
    """A task that is left out, and why."""

    reason: RefusalReason
    sentence: str


class RefusedError(Exception):
    """Raised inside a binding; callers get the refusal as a value."""

    def __init__(self, reason: RefusalReason, sentence: str) -> None:
        super().__init__(sentence)
        self.refusal = TaskRefusal(reason, sentence)
