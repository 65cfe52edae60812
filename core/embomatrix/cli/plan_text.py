"""Plans that a person types: names of objects may stand for their rows."""

import difflib
import math
import re
from collections.abc import Iterable, Sequence

from embomatrix.skills.parse import PlanError, PlanReason, parse_plan
from embomatrix.skills.syntax import PlaceRelation, Plan, Skill, SkillCall
from embomatrix.world.task import Task


def rows_for_names(text: str, table: Sequence[str]) -> str:
    """Return the text with rows of the object table for the names of its objects."""
    rows = {name: str(row) for row, name in enumerate(table)}
    return "".join(rows.get(word, word) for word in re.split(r"([\s;]+)", text))


def plan_with_names(text: str, task: Task) -> Plan:
    """Return the plan in a text. Raises PlanError, for an unknown name with the names most like it."""
    try:
        return parse_plan(rows_for_names(text, task.table), task.profile)
    except PlanError as error:
        if error.reason is not PlanReason.WRONG_ARGUMENT:
            raise
        words = (
            word for word in re.split(r"[\s;]+", text) if word not in {*Skill, *PlaceRelation, *task.table}
        )
        close = [name for word in words for name in difflib.get_close_matches(word, task.table, n=2)]
        hint = f"did you mean {', '.join(close[:2])}?" if close else f"for example {task.table[0]}"
        raise PlanError(error.reason, f"{error}; names of the table count as rows: {hint}") from error


def doubtful_angles(calls: Iterable[SkillCall]) -> list[str]:
    """Return a sentence about each angle of more than a full turn: a person may have meant degrees."""
    return [
        f"{call.skill.value} by {call.yaw:g} radians, which is more than a full turn; {call.yaw:g} degrees are "
        f"{math.radians(call.yaw):.2f}"
        for call in calls
        if call.yaw is not None and abs(call.yaw) > math.tau
    ]
