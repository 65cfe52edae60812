"""One plan before two judges: our simulator and EAI's graph. Plans are translated into EAI's vocabulary."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace

from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import PlaceRelation, Skill, SkillCall

GOING = frozenset({Skill.MOVE, Skill.TURN, Skill.MOVE_FORWARD, Skill.GO_TO_ROOM})
"""Skills without a counterpart in the graph, which has no locations."""
PLACES = {
    PlaceRelation.INSIDE: "RIGHT_PLACE_INSIDE",
    PlaceRelation.ONTOP: "RIGHT_PLACE_ONTOP",
    PlaceRelation.UNDER: "RIGHT_PLACE_UNDER",
    PlaceRelation.NEXTTO: "RIGHT_PLACE_NEXTTO",
}
DEEDS = {
    Skill.PICK_UP: "RIGHT_GRASP",
    Skill.OPEN: "OPEN",
    Skill.CLOSE: "CLOSE",
    Skill.TOGGLE_ON: "TOGGLE_ON",
    Skill.TOGGLE_OFF: "TOGGLE_OFF",
    Skill.HEAT: "COOK",
    Skill.COOK: "COOK",
    Skill.FREEZE: "FREEZE",
    Skill.SLICE: "SLICE",
    Skill.CLEAN: "CLEAN",
}


class ForeignObjectError(Exception):
    """A plan uses an object that EAI's task does not have."""


def deeds_of(plan):
    """Return the calls that change the state, without moves."""
    return tuple(call for call in plan if call.skill not in GOING)


def with_ways(deeds):
    """Return the calls as a plan, with a move before each call on an object that the hand does not hold."""
    plan = []
    for call in deeds:
        goal = call.source_index if call.skill is Skill.SOAK else call.object_index
        plan += [SkillCall(Skill.MOVE, object_index=goal), call]
    return tuple(plan)


def in_eai(deeds, table, names):
    """Translate the calls into EAI's steps, as JSON.

    ``names``: EAI's simulator names by ours. Raises ForeignObjectError. An object that is put on something unknown to
    EAI's task is released.
    """
    steps, held = [], None

    def say(action, index):
        if table[index] not in names:
            raise ForeignObjectError(table[index])
        steps.append({"action": action, "object": names[table[index]]})

    for call in deeds:
        match call.skill:
            case Skill.PLACE if held is not None and table[call.object_index] not in names:
                say("RIGHT_RELEASE", held)
            case Skill.PLACE:
                say(PLACES[call.relation], call.object_index)
            case Skill.SOAK:
                # Our skill dips the held object; the graph soaks an object that is in a running sink.
                say("RIGHT_PLACE_INSIDE", call.source_index)
                say("SOAK", call.object_index)
                say("RIGHT_GRASP", call.object_index)
            case skill:
                say(DEEDS[skill], call.object_index)
        if call.skill in (Skill.PICK_UP, Skill.PLACE):
            held = call.object_index if call.skill is Skill.PICK_UP else None
    return json.dumps(steps)


def names_of(imported, native):
    """Return EAI's simulator names by our scene's names: the prompt lists each type's instances in their order."""
    listed = {}
    block = native.prompt[native.prompt.index("Your task:") :].split("interactable objects:")[1]
    for name, category in re.findall(r"\{'name': '([^']+)', 'category': '([^']+)'\}", block):
        listed.setdefault(category.lower(), []).append(name)
    found = {}
    for instance, ours in zip(imported.instances, imported.about, strict=True):
        category, _, number = instance.lower().rpartition("_")
        theirs = listed.get(category, ())
        if number.isdigit() and int(number) <= len(theirs):
            found[ours] = theirs[int(number) - 1]
    return found


@dataclass(frozen=True)
class Mutant:
    """Calls of a plan with one error."""

    kind: str
    deeds: tuple


def mutants(deeds, rows, rng):
    """Return one mutant of each kind: a missing call, two swapped neighbours, another object of ``rows``."""
    at = int(rng.integers(len(deeds)))
    yield Mutant("drop", (*deeds[:at], *deeds[at + 1 :]))
    if len(deeds) > 1:
        at = int(rng.integers(len(deeds) - 1))
        yield Mutant("swap", (*deeds[:at], deeds[at + 1], deeds[at], *deeds[at + 2 :]))
    at = int(rng.integers(len(deeds)))
    others = [row for row in rows if row != deeds[at].object_index]
    wrong = replace(deeds[at], object_index=int(rng.choice(others)))
    yield Mutant("object", (*deeds[:at], wrong, *deeds[at + 1 :]))


GEOMETRY = "the graph has no shapes: it puts things where ours have no room, no cavity, or no way"
WEIGHT = "the graph lifts whatever is smaller than 1.5 m3"
LOAD = "the graph lifts a thing from under what rests on it"
AGAIN = "the graph lets a step pass that asks for what is so already"
HANDS = "the graph has two hands"
PIECES = "the graph continues with parts of the sliced object, ours with pieces of other names"
TOOLS = "our sink soaks what lies in it when it is switched on; the graph asks for the step that soaks the cleaner"
LIDS = "the graph's cartons stand open from the start"
RUNNING = "ours cleans with a machine only while it runs; the graph takes any"
START = "the graph's start differs: unmentioned objects are shut, and positions follow the problem"
CAUSES = {
    FailureReason.NO_FREE_POSE: GEOMETRY,
    FailureReason.PLACES_OUT_OF_REACH: GEOMETRY,
    FailureReason.PLACES_BEHIND_DOOR: GEOMETRY,
    FailureReason.NO_CAVITY: GEOMETRY,
    FailureReason.NO_SURFACE: GEOMETRY,
    FailureReason.OUT_OF_REACH: GEOMETRY,
    FailureReason.NO_PATH: GEOMETRY,
    FailureReason.NO_STANDING_POSE: GEOMETRY,
    FailureReason.NO_LINE_OF_APPROACH: GEOMETRY,
    FailureReason.BLOCKED: GEOMETRY,
    FailureReason.TOO_HIGH: GEOMETRY,
    FailureReason.TOO_LARGE: GEOMETRY,
    FailureReason.NOT_PORTABLE: WEIGHT,
    FailureReason.TOO_HEAVY: WEIGHT,
    FailureReason.SUPPORTS_OTHERS: LOAD,
    FailureReason.ALREADY_OPEN: AGAIN,
    FailureReason.ALREADY_CLOSED: AGAIN,
    FailureReason.ALREADY_ON: AGAIN,
    FailureReason.ALREADY_OFF: AGAIN,
    FailureReason.HAND_FULL: HANDS,
    FailureReason.SOURCE_OFF: RUNNING,
    FailureReason.CONTAINER_CLOSED: LIDS,
}
WORDS = {"sliced": PIECES, "CLEAN": TOOLS, "not open": START, "open": START}


def cause(trace, verdict):
    """Return the cause of a disagreement: our step's reason or their message. Empty if the cause is unknown."""
    if trace.failure is not None and verdict.executed:
        return CAUSES.get(trace.failure, "")
    said = " ".join(verdict.errors.values())
    return next((why for words, why in WORDS.items() if words in said), "")
