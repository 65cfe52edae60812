"""Observations in words: the effect of a step, and the final state of objects."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from embomatrix.skills.syntax import SIGNATURES, Arg, Skill, SkillCall
from embomatrix.skills.view import preposition
from embomatrix.world.state import Relation

MAX_FINAL_LINES: Final = 24
"""Largest number of objects in a final description: more do not fit a prompt."""

DONE: Final[Mapping[Skill, str]] = {
    Skill.MOVE: "stands at {target}",
    Skill.TURN: "turned by {yaw:.2f} rad",
    Skill.PICK_UP: "holds {target}{cargo}",
    Skill.PLACE: "put {held} {relation} {target}",
    Skill.MOVE_FORWARD: "drove {distance:.2f} m",
    Skill.OPEN: "opened {target}",
    Skill.CLOSE: "closed {target}",
    Skill.TOGGLE_ON: "switched {target} on",
    Skill.TOGGLE_OFF: "switched {target} off",
    Skill.HEAT: "{target} is hot",
    Skill.COOK: "{target} is cooked",
    Skill.FREEZE: "{target} is frozen",
    Skill.GO_TO_ROOM: "stands in {room}",
    Skill.SLICE: "sliced {target}",
    Skill.CLEAN: "cleaned {target}",
    Skill.SOAK: "held {target} under the running liquid",
}
"""Message of a successful call of each skill."""

WORDS: Final[Mapping[Relation, str]] = {
    Relation.ONTOP: "on",
    Relation.INSIDE: "inside",
    Relation.UNDER: "under",
    Relation.NEXTTO: "next to",
    Relation.TOUCHING: "touching",
    Relation.INROOM: "in",
}
"""Preposition of each relation."""
GONE: Final = "not there"
"""Place of an object that is not in the world."""
NO_ROOM: Final = "no room"
"""Place of an object between rooms."""


@dataclass(frozen=True, slots=True)
class ObjectDescription:
    """Facts about one object for its description: its place, and its ``states`` in words, in order.

    ``held`` is True for the held object and its contents, whose ``host`` is in the hand too.
    ``gone`` is True for an object that is not in the world: a future piece, or an object that was cut up.
    """

    name: str
    room: str
    host: str = ""
    relation: Relation | None = None
    held: bool = False
    gone: bool = False
    states: tuple[str, ...] = ()


def done(call: SkillCall, *, target: str = "", held: str = "", cargo: Sequence[str] = ()) -> str:
    """Return the message of a successful call. ``held`` was in the hand before it; ``cargo`` are the contents of the target."""
    return DONE[call.skill].format(
        target=target,
        held=held,
        cargo=f" with {listed(cargo)} in it" if cargo else "",
        relation=preposition(call.relation) if call.relation is not None else "",
        yaw=call.yaw or 0.0,
        distance=call.distance or 0.0,
        room=call.room_name,
    )


def gained(changes: Mapping[str, Sequence[str]]) -> str:
    """Return a message about objects and the states that heat, cold or water gave them; "" for no change."""
    return "; ".join(f"{name} is now {listed(states)}" for name, states in changes.items())


def line(item: ObjectDescription) -> str:
    """Describe one object on one line: ``apple_1: on table_1 in kitchen_0, hot``."""
    if item.gone:
        return f"{item.name}: {GONE}"
    place = _IN_HAND if item.held else f"in {item.room or NO_ROOM}"
    if item.host and item.relation is not None:
        place = f"{WORDS[item.relation]} {item.host} {place}"
    return f"{item.name}: {', '.join([place, *item.states])}"


_PLACES: Final = {word: relation for relation, word in WORDS.items()}
_IN_HAND: Final = "in the robot's hand"
_LINE: Final = re.compile(
    rf"(?P<name>[^:]+): (?:(?P<relation>{'|'.join(sorted(_PLACES, key=len, reverse=True))}) (?P<host>\S+) )?"
    rf"(?:(?P<hand>{_IN_HAND})|in (?P<room>no room|[^\s,]+))(?P<states>(?:, [^,]+)*)"
)


def read_line(text: str) -> ObjectDescription:
    """Read what ``line`` writes. Raises ValueError for another text."""
    name, _, rest = text.partition(": ")
    if rest == GONE:
        return ObjectDescription(name, "", gone=True)
    found = _LINE.fullmatch(text)
    if found is None:
        raise ValueError(f"{text[:80]!r} does not describe an object: expected `name: in room, states`")
    room = found["room"] or ""
    return ObjectDescription(
        name=found["name"],
        room="" if room == NO_ROOM else room,
        host=found["host"] or "",
        relation=_PLACES[found["relation"]] if found["host"] else None,
        held=found["hand"] is not None,
        states=tuple(found["states"].split(", ")[1:]),
    )


def lines_of(described: Iterable[ObjectDescription]) -> tuple[str, ...]:
    """Describe objects, one a line."""
    return tuple(map(line, described))


def final_lines(described: Sequence[ObjectDescription]) -> tuple[str, ...]:
    """Describe the first objects, one a line, and add the number of those left out."""
    lines = tuple(line(item) for item in described[:MAX_FINAL_LINES])
    left = len(described) - len(lines)
    return (*lines, f"and {left} more objects") if left > 0 else lines


def call_in_words(call: SkillCall, table: Sequence[str]) -> str:
    """Format a call with object names in place of indices. Indices outside the table stay numbers."""
    return words_of(call, lambda index: table[index] if 0 <= index < len(table) else str(index))


def words_of(call: SkillCall, name_of: Callable[[int], str]) -> str:
    """Format a call as its skill and its arguments, objects by the names that ``name_of`` gives to their indices."""
    words = [call.skill.value]
    for arg in SIGNATURES[call.skill]:
        value = getattr(call, arg.value)
        if arg in (Arg.OBJECT, Arg.SOURCE) and value is not None:
            words.append(name_of(value))
        else:
            words.append(f"{value:g}" if isinstance(value, float) else str(value))
    return " ".join(words)


def listed(words: Sequence[str]) -> str:
    """Join words as a list in a sentence: ``a, b and c``."""
    return " and ".join(filter(None, [", ".join(words[:-1]), words[-1]])) if words else "nothing"
