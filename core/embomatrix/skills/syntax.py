"""The plan language: the skills of each profile, their arguments, and the calls that make up a plan."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from embomatrix.world.task import Profile

if TYPE_CHECKING:
    from collections.abc import Mapping

MAX_STEPS: Final = 64
MAX_PLAN_BYTES: Final = 64 * 1024
"""A longer plan, or a longer text, can't be parsed: it is no plan."""
MAX_ROOM_NAME: Final = 64
"""Characters."""


class Skill(StrEnum):
    """The paper's skill library, by the paper's names, and three skills for goals that it can't reach."""

    MOVE = "move"
    TURN = "turn"
    PICK_UP = "pick_up"
    PLACE = "place"
    MOVE_FORWARD = "move_forward"
    OPEN = "open"
    CLOSE = "close"
    TOGGLE_ON = "toggle_on"
    TOGGLE_OFF = "toggle_off"
    HEAT = "heat_object_with_source"
    COOK = "cook_object_with_tool"
    FREEZE = "froze_object_with_source"
    GO_TO_ROOM = "go_to_room"
    SLICE = "slice_object_with_tool"
    CLEAN = "clean_object_with_tool"
    SOAK = "soak_object_in_source"


class Arg(StrEnum):
    """Argument names of a call, as they stand in JSON.

    A tool is called by ``source_index`` too, as in the paper's ``cook_object_with_tool``: it is the second object of a call.
    """

    OBJECT = "object_index"
    SOURCE = "source_index"
    RELATION = "relation"
    YAW = "yaw"
    DISTANCE = "distance"
    ROOM = "room_name"


class PlaceRelation(StrEnum):
    """What ``place`` can be asked for."""

    ONTOP = "ontop"
    INSIDE = "inside"
    UNDER = "under"


SIGNATURES: Final[Mapping[Skill, tuple[Arg, ...]]] = {
    Skill.MOVE: (Arg.OBJECT,),
    Skill.TURN: (Arg.YAW,),
    Skill.PICK_UP: (Arg.OBJECT,),
    Skill.PLACE: (Arg.OBJECT, Arg.RELATION),
    Skill.MOVE_FORWARD: (Arg.DISTANCE, Arg.YAW),
    Skill.OPEN: (Arg.OBJECT,),
    Skill.CLOSE: (Arg.OBJECT,),
    Skill.TOGGLE_ON: (Arg.OBJECT,),
    Skill.TOGGLE_OFF: (Arg.OBJECT,),
    Skill.HEAT: (Arg.OBJECT, Arg.SOURCE),
    Skill.COOK: (Arg.OBJECT, Arg.SOURCE),
    Skill.FREEZE: (Arg.OBJECT, Arg.SOURCE),
    Skill.GO_TO_ROOM: (Arg.ROOM,),
    Skill.SLICE: (Arg.OBJECT, Arg.SOURCE),
    Skill.CLEAN: (Arg.OBJECT, Arg.SOURCE),
    Skill.SOAK: (Arg.OBJECT, Arg.SOURCE),
}

_ADDED: Final = (Skill.SLICE, Skill.CLEAN, Skill.SOAK)
PROFILES: Final[Mapping[Profile, tuple[Skill, ...]]] = {
    Profile.PAPER: tuple(skill for skill in Skill if skill not in _ADDED),
    Profile.HOUSEHOLD: tuple(Skill),
}
"""The skills that plans of a profile may use, in the order in which a prompt tells them."""
ALIASES: Final[Mapping[str, Arg]] = {"tool_index": Arg.SOURCE}
"""Other names under which JSON may give an argument."""


@dataclass(frozen=True, slots=True)
class SkillCall:
    """One step of a plan. Arguments that the skill does not take stay None. Yaw is in radians, distance in metres."""

    skill: Skill
    object_index: int | None = None
    source_index: int | None = None
    relation: PlaceRelation | None = None
    yaw: float | None = None
    distance: float | None = None
    room_name: str | None = None


Plan = tuple[SkillCall, ...]
