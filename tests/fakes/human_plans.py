"""Conversion of EAI's human plans, which assume two hands and a graph without positions, to our one-armed skills."""

from __future__ import annotations

import json

from embomatrix.skills.syntax import PlaceRelation, Skill, SkillCall

RELATIONS = {
    "PLACE_INSIDE": PlaceRelation.INSIDE,
    "PLACE_ONTOP": PlaceRelation.ONTOP,
    "PLACE_UNDER": PlaceRelation.UNDER,
}
FLOOR = "room_floor"
STATES = {"OPEN": Skill.OPEN, "TOGGLE_ON": Skill.TOGGLE_ON, "TOGGLE_OFF": Skill.TOGGLE_OFF}


class InexpressibleError(Exception):
    """A step has no equivalent among our skills. The message names the step."""


class OneArm:
    """Converter that reads a plan step by step.

    Objects that two hands take are picked up one after the other, when they are put down or used. Doors are closed once
    no object behind them is still to be picked up.
    """

    def __init__(self, table, ours, homes):
        self._row = {name: at for at, name in enumerate(table)}
        self._ours = ours
        self._hands = {"LEFT": "", "RIGHT": ""}
        self._arm = ""
        self._home = dict(homes)
        self._shut = []
        self.deeds = []

    def read(self, action, arguments):
        hand, _, deed = action.partition("_")
        if hand not in self._hands:
            hand, deed = "", action
        if arguments.startswith(FLOOR) and arguments not in self._ours:
            deed = "RELEASE"  # a floor outside the goals is not in our table: the object is only released
        names = [] if deed == "RELEASE" else [self._name(name) for name in arguments.split(", ")]
        match deed:
            case "GRASP":
                self._hands[hand] = names[0]
            case "RELEASE":
                self._lay_down()
                self._hands[hand] = ""
            case "PLACE_NEXTTO_ONTOP":
                self._place(hand, names[1], PlaceRelation.ONTOP)
            case _ if deed in RELATIONS:
                self._place(hand, names[0], RELATIONS[deed])
            case "CLOSE":
                self._shut.append(names[0])
            case _ if deed in STATES:
                self._lay_down()
                self._append_call(STATES[deed], names[0])
            case "SLICE" | "CLEAN":
                self._use(Skill.SLICE if deed == "SLICE" else Skill.CLEAN, names[0])
            case "SOAK":
                self._soak(names[0])
            case "UNFREEZE":
                pass  # none of our skills thaws, and no goal of these tasks asks for it
            case _:
                raise InexpressibleError(action)
        self._close_what_is_done()

    def end(self):
        self._hands = dict.fromkeys(self._hands, "")
        self._close_what_is_done()
        return tuple(self.deeds)

    def _name(self, theirs):
        if theirs not in self._ours:
            raise InexpressibleError(theirs)
        return self._ours[theirs]

    def _append_call(self, skill, name, source="", relation=None):
        at = self._row[source] if source else None
        self.deeds.append(SkillCall(skill, object_index=self._row[name], source_index=at, relation=relation))

    def _take(self, name):
        if self._arm != name:
            self._lay_down()
            self._append_call(Skill.PICK_UP, name)
            self._arm = name

    def _lay_down(self):
        """Return the held object to its last position; on the first step, to its initial position."""
        if self._arm:
            host, relation = self._home.get(self._arm, ("", None))
            if not host:
                raise InexpressibleError("nowhere to lay a tool down")
            self._append_call(Skill.PLACE, host, relation=relation)
            self._arm = ""

    def _place(self, hand, target, relation):
        name = self._hands[hand]
        if not name:
            raise InexpressibleError("an empty hand")
        self._take(name)
        self._append_call(Skill.PLACE, target, relation=relation)
        self._home[name] = (target, relation)
        self._hands[hand] = self._arm = ""

    def _use(self, skill, name):
        tool = next((held for held in self._hands.values() if held not in ("", name)), "")
        if not tool:
            raise InexpressibleError("a tool that lies in a sink")
        self._take(tool)
        self._append_call(skill, name, source=tool)

    def _soak(self, name):
        source = self._home.get(name, ("", None))[0]
        if not source:
            raise InexpressibleError("SOAK outside of a sink")
        self._take(name)
        self._append_call(Skill.SOAK, name, source=source)

    def _close_what_is_done(self):
        if not any(self._hands.values()):
            for name in self._shut:
                self._lay_down()
                self._append_call(Skill.CLOSE, name)
            self._shut = []


def from_eai(text, table, names, homes):
    """Convert a human plan's steps to our skills.

    ``names``: EAI's names by ours; ``homes``: initial support or container of each object. Raises InexpressibleError for a
    step without an equivalent skill, mostly "put next to".
    """
    arm = OneArm(table, {theirs: ours for ours, theirs in names.items()}, homes)
    for step in json.loads(text):
        arm.read(step["action"], step["object"])
    return arm.end()
