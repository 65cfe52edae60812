"""Failure reasons of steps: a closed set, with a message template that names the remedy for each."""

from __future__ import annotations

from enum import StrEnum


class FailureReason(StrEnum):
    """Reason of a failed step, with the template of its message. The values travel on the wire."""

    sentence: str

    def __new__(cls, value: str, sentence: str = "") -> FailureReason:
        reason = str.__new__(cls, value)
        reason._value_ = value
        reason.sentence = sentence
        return reason

    UNKNOWN_INDEX = (
        "unknown_index",
        "there is no object with index {index}: the table has indices 0 to {last}",
    )
    NOT_THERE = (
        "not_there",
        "{target} is not in the scene now: use its pieces if it was cut up, or slice the whole object first",
    )
    UNKNOWN_ROOM = "unknown_room", "there is no room {room}: the rooms are {rooms}"
    NO_PATH = (
        "no_path",
        "the robot can't get to {target}: {other} blocks the way; clear the way or choose another object",
    )
    NO_STANDING_POSE = (
        "no_standing_pose",
        "there is no free place to stand within reach of {target}: {other} is in the way; clear the way or choose "
        "another object",
    )
    BLOCKED = "blocked", "an obstacle is {distance} m ahead: turn, or drive a shorter distance"
    STEP_TOO_LONG = "step_too_long", "{distance} m is too far for one step: expected at most {limit} m"
    OUT_OF_REACH = (
        "out_of_reach",
        "{target} is {distance} m away and the arm reaches {limit} m: move to it first",
    )
    TOO_HIGH = (
        "too_high",
        "{target} is {height} m above the floor and the arm reaches up to {limit} m: choose a lower object",
    )
    NO_LINE_OF_APPROACH = (
        "no_line_of_approach",
        "a wall or furniture lies between the robot and {target}: move to it first",
    )
    HAND_FULL = "hand_full", "the hand holds {held}: place it first"
    HAND_EMPTY = "hand_empty", "the hand is empty: pick something up first"
    NOT_PORTABLE = "not_portable", "{target} is fixed and can't be picked up: choose a movable object"
    TOO_HEAVY = "too_heavy", "{target} weighs {mass} kg and the arm lifts {limit} kg: choose a lighter object"
    TOO_LARGE = (
        "too_large",
        "{target} measures {size} m and the gripper takes at most {limit} m: choose a smaller object",
    )
    SUPPORTS_OTHERS = "supports_others", "{other} rests on {target}: take it off first"
    CONTAINER_CLOSED = "container_closed", "{container} is closed: open it first"
    NOT_OPENABLE = "not_openable", "{target} has no door, drawer or lid that opens: leave the call out"
    ALREADY_OPEN = "already_open", "{target} is already open: leave the call out"
    ALREADY_CLOSED = "already_closed", "{target} is already closed: leave the call out"
    DOOR_BLOCKED = "door_blocked", "{other} is in the way of the door of {target}: clear the way first"
    OPENED_WHILE_ON = "opened_while_on", "{target} is running: switch it off before you open it"
    NOT_TOGGLEABLE = "not_toggleable", "{target} has no switch: leave the call out"
    ALREADY_ON = "already_on", "{target} is already on: leave the call out"
    ALREADY_OFF = "already_off", "{target} is already off: leave the call out"
    MUST_BE_CLOSED = "must_be_closed", "{target} starts only when it is closed: close it first"
    NO_SURFACE = (
        "no_surface",
        "nothing can be placed {relation} {target}: it has no such surface; choose another object or relation",
    )
    NO_CAVITY = (
        "no_cavity",
        "nothing can be placed inside {target}: it has no cavity that fits {held}; choose a larger container",
    )
    NO_FREE_POSE = (
        "no_free_pose",
        "there is no free place for {held} {relation} {target}: {other} is in the way; make space or choose another object",
    )
    PLACES_OUT_OF_REACH = (
        "places_out_of_reach",
        "every place for {held} {relation} {target} is out of the arm's reach: choose another object",
    )
    PLACES_BEHIND_DOOR = (
        "places_behind_door",
        "the open door of {target} is between the arm and every place for {held}: choose another object",
    )
    PLACE_ON_ITSELF = "place_on_itself", "{held} can't be placed {relation} itself: choose another object"
    NOT_A_HEAT_SOURCE = (
        "not_a_heat_source",
        "{source} is not a heat source: choose an oven, a stove or the like",
    )
    NOT_A_COLD_SOURCE = (
        "not_a_cold_source",
        "{source} is not a cold source: choose a refrigerator, a freezer or the like",
    )
    NOT_HEATABLE = "not_heatable", "{target} can't be heated: choose another object"
    NOT_COOKABLE = "not_cookable", "{target} can't be cooked: choose another object"
    NOT_FREEZABLE = "not_freezable", "{target} can't be frozen: choose another object"
    SOURCE_OFF = "source_off", "{source} is off: switch it on first"
    SOURCE_OPEN = "source_open", "{source} works only when it is closed: close it first"
    NOT_AT_SOURCE = "not_at_source", "{target} is not {relation} {source}: place it there first"
    NOT_HOT_ENOUGH = (
        "not_hot_enough",
        "{source} reaches {found} C and {target} needs {needed} C: choose a hotter source",
    )
    NOT_COLD_ENOUGH = (
        "not_cold_enough",
        "{source} reaches {found} C and {target} needs {needed} C: choose a colder source",
    )
    TOOL_NOT_HELD = "tool_not_held", "{source} is not in the hand: pick it up first"
    NOT_A_SLICER = "not_a_slicer", "{source} is not a cutting tool: choose a knife or the like"
    NOT_SLICEABLE = "not_sliceable", "{target} can't be sliced: choose another object"
    ALREADY_SLICED = "already_sliced", "{target} is already sliced: leave the call out"
    NOT_A_CLEANER = (
        "not_a_cleaner",
        "{source} is not a cleaning tool: choose a cloth, a brush, a sink or the like",
    )
    NEEDS_SOAKING = (
        "needs_soaking",
        "{source} removes {substance} only when it is soaked with {needed}: soak it first",
    )
    STAYS_ON = "stays_on", "{source} does not remove {substance} from {target}: choose another cleaning tool"
    GIVES_NO_LIQUID = "gives_no_liquid", "{source} gives no liquid: choose a tap or a container of liquid"
    NOT_SOAKABLE = "not_soakable", "{target} does not absorb or hold a liquid: choose another object"
    COLLIDED = "collided", "the robot ran into {other} and stopped: clear the way or choose another route"
    ARM_BLOCKED = (
        "arm_blocked",
        "the arm finds no free path to {target}: {other} blocks it; clear the way first",
    )
    SLIPPED = "slipped", "{target} slipped out of the hand: pick it up again"
    FELL = "fell", "{held} did not stay {relation} {target}: choose another place"
