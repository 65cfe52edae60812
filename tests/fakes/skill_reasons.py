"""Failure reasons that each skill can report, for comparison with the simulator."""

from embomatrix.skills.check import RULES
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.library import LIBRARY
from embomatrix.skills.syntax import Skill

_DRIVE = (FailureReason.COLLIDED, FailureReason.SLIPPED)
_WORK = (FailureReason.COLLIDED, FailureReason.ARM_BLOCKED)

MISHAPS = {
    **dict.fromkeys((Skill.MOVE, Skill.TURN, Skill.MOVE_FORWARD, Skill.GO_TO_ROOM), _DRIVE),
    **dict.fromkeys((Skill.OPEN, Skill.CLOSE, Skill.TOGGLE_ON, Skill.TOGGLE_OFF), _WORK),
    **dict.fromkeys((Skill.SLICE, Skill.CLEAN, Skill.SOAK), _WORK),
    **dict.fromkeys((Skill.HEAT, Skill.COOK, Skill.FREEZE), ()),
    Skill.PICK_UP: (*_WORK, FailureReason.SLIPPED),
    Skill.PLACE: (*_WORK, FailureReason.SLIPPED, FailureReason.FELL),
}
"""Reasons that appear only when a robot carries the skill out."""


def reasons_of(skill):
    """Return every failure reason that a call of the skill can report."""
    entry = LIBRARY[skill]
    refused = frozenset(reason for item in entry.preconditions for reason in RULES[item].reasons)
    return refused | frozenset(entry.outcomes) | frozenset(MISHAPS[skill])
