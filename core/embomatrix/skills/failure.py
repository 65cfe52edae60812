"""Failure reasons of steps: a closed set, with a message template that names the remedy for each."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping


class FailureReason(StrEnum):
    """Reason of a failed step. The values travel on the wire."""

    UNKNOWN_INDEX = "unknown_index"
    NOT_THERE = "not_there"
    UNKNOWN_ROOM = "unknown_room"
    NO_PATH = "no_path"
    NO_STANDING_POSE = "no_standing_pose"
    BLOCKED = "blocked"
    STEP_TOO_LONG = "step_too_long"
    OUT_OF_REACH = "out_of_reach"
    TOO_HIGH = "too_high"
    NO_LINE_OF_APPROACH = "no_line_of_approach"
    HAND_FULL = "hand_full"
    HAND_EMPTY = "hand_empty"
    NOT_PORTABLE = "not_portable"
    TOO_HEAVY = "too_heavy"
    TOO_LARGE = "too_large"
    SUPPORTS_OTHERS = "supports_others"
    CONTAINER_CLOSED = "container_closed"
    NOT_OPENABLE = "not_openable"
    ALREADY_OPEN = "already_open"
    ALREADY_CLOSED = "already_closed"
    DOOR_BLOCKED = "door_blocked"
    OPENED_WHILE_ON = "opened_while_on"
    NOT_TOGGLEABLE = "not_toggleable"
    ALREADY_ON = "already_on"
    ALREADY_OFF = "already_off"
    MUST_BE_CLOSED = "must_be_closed"
    NO_SURFACE = "no_surface"
    NO_CAVITY = "no_cavity"
    NO_FREE_POSE = "no_free_pose"
    PLACE_ON_ITSELF = "place_on_itself"
    NOT_A_HEAT_SOURCE = "not_a_heat_source"
    NOT_A_COLD_SOURCE = "not_a_cold_source"
    NOT_HEATABLE = "not_heatable"
    NOT_COOKABLE = "not_cookable"
    NOT_FREEZABLE = "not_freezable"
    SOURCE_OFF = "source_off"
    SOURCE_OPEN = "source_open"
    NOT_AT_SOURCE = "not_at_source"
    NOT_HOT_ENOUGH = "not_hot_enough"
    NOT_COLD_ENOUGH = "not_cold_enough"
    TOOL_NOT_HELD = "tool_not_held"
    NOT_A_SLICER = "not_a_slicer"
    NOT_SLICEABLE = "not_sliceable"
    ALREADY_SLICED = "already_sliced"
    NOT_A_CLEANER = "not_a_cleaner"
    NEEDS_SOAKING = "needs_soaking"
    STAYS_ON = "stays_on"
    GIVES_NO_LIQUID = "gives_no_liquid"
    NOT_SOAKABLE = "not_soakable"
    COLLIDED = "collided"
    ARM_BLOCKED = "arm_blocked"
    SLIPPED = "slipped"
    FELL = "fell"


SENTENCES: Final[Mapping[FailureReason, str]] = {
    FailureReason.UNKNOWN_INDEX: "there is no object with index {index}: the table has indices 0 to {last}",
    FailureReason.NOT_THERE: "{target} is not in the scene: it was cut up, or it appears only when another object is sliced",
    FailureReason.UNKNOWN_ROOM: "there is no room {room}: the rooms are {rooms}",
    FailureReason.NO_PATH: "the robot can't get to {target}: {other} blocks the way",
    FailureReason.NO_STANDING_POSE: "there is no free place to stand from which {target} can be reached: {other} is in the way",
    FailureReason.BLOCKED: "an obstacle is {distance} m ahead: turn, or drive a shorter distance",
    FailureReason.STEP_TOO_LONG: "{distance} m is too far for one step: expected at most {limit} m",
    FailureReason.OUT_OF_REACH: "{target} is {distance} m away and the arm reaches {limit} m: move to it first",
    FailureReason.TOO_HIGH: "{target} is {height} m above the floor and the arm reaches up to {limit} m",
    FailureReason.NO_LINE_OF_APPROACH: "a wall or furniture lies between the robot and {target}: move to it first",
    FailureReason.HAND_FULL: "the hand holds {held}: place it first",
    FailureReason.HAND_EMPTY: "the hand is empty: pick something up first",
    FailureReason.NOT_PORTABLE: "{target} is fixed and can't be picked up",
    FailureReason.TOO_HEAVY: "{target} weighs {mass} kg and the arm lifts {limit} kg",
    FailureReason.TOO_LARGE: "{target} measures {size} m and the gripper takes at most {limit} m",
    FailureReason.SUPPORTS_OTHERS: "{other} rests on {target}: take it off first",
    FailureReason.CONTAINER_CLOSED: "{container} is closed: open it first",
    FailureReason.NOT_OPENABLE: "{target} has no door, drawer or lid that opens",
    FailureReason.ALREADY_OPEN: "{target} is open already",
    FailureReason.ALREADY_CLOSED: "{target} is closed already",
    FailureReason.DOOR_BLOCKED: "{other} is in the way of the door of {target}",
    FailureReason.OPENED_WHILE_ON: "{target} is running: switch it off before you open it",
    FailureReason.NOT_TOGGLEABLE: "{target} has no switch",
    FailureReason.ALREADY_ON: "{target} is on already",
    FailureReason.ALREADY_OFF: "{target} is off already",
    FailureReason.MUST_BE_CLOSED: "{target} starts only when it is closed: close it first",
    FailureReason.NO_SURFACE: "nothing can be placed {relation} {target}: it has no such surface",
    FailureReason.NO_CAVITY: "nothing can be placed inside {target}: it has no cavity that fits {held}",
    FailureReason.NO_FREE_POSE: "there is no free place for {held} {relation} {target} within reach",
    FailureReason.PLACE_ON_ITSELF: "{held} can't be placed {relation} itself",
    FailureReason.NOT_A_HEAT_SOURCE: "{source} is not a heat source",
    FailureReason.NOT_A_COLD_SOURCE: "{source} is not a cold source",
    FailureReason.NOT_HEATABLE: "{target} can't be heated",
    FailureReason.NOT_COOKABLE: "{target} can't be cooked",
    FailureReason.NOT_FREEZABLE: "{target} can't be frozen",
    FailureReason.SOURCE_OFF: "{source} is off: switch it on first",
    FailureReason.SOURCE_OPEN: "{source} works only when closed: close it first",
    FailureReason.NOT_AT_SOURCE: "{target} is not {relation} {source}",
    FailureReason.NOT_HOT_ENOUGH: "{source} reaches {found} C and {target} needs {needed} C",
    FailureReason.NOT_COLD_ENOUGH: "{source} reaches {found} C and {target} needs {needed} C",
    FailureReason.TOOL_NOT_HELD: "{source} is not in the hand: pick it up first",
    FailureReason.NOT_A_SLICER: "{source} is no cutting tool: expected a knife or the like",
    FailureReason.NOT_SLICEABLE: "{target} can't be sliced",
    FailureReason.ALREADY_SLICED: "{target} is sliced already",
    FailureReason.NOT_A_CLEANER: "{source} is no cleaning tool: expected a cloth, a brush, a sink or the like",
    FailureReason.NEEDS_SOAKING: "{source} removes {substance} only when it is soaked with {needed}",
    FailureReason.STAYS_ON: "{source} does not remove {substance} from {target}",
    FailureReason.GIVES_NO_LIQUID: "{source} gives no liquid",
    FailureReason.NOT_SOAKABLE: "{target} does not absorb or hold a liquid",
    FailureReason.COLLIDED: "the robot ran into {other} and stopped",
    FailureReason.ARM_BLOCKED: "the arm finds no free path to {target}: {other} blocks it",
    FailureReason.SLIPPED: "{target} slipped out of the hand",
    FailureReason.FELL: "{held} did not stay {relation} {target}",
}
