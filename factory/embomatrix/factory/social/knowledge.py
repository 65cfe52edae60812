"""Authored knowledge about people: jobs, hobbies, ties, and the events of a day with the needs that they cause.

The tables are ``people.toml`` and ``events.toml`` beside this module; the second explains its notation. A line that does
not follow it raises KnowledgeError.
"""

from __future__ import annotations

import dataclasses
import functools
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any, Final

from embomatrix.factory.social.wish import Quantity, WishPredicate
from embomatrix.world.state import Relation, State

_OBJECTS: Final = re.compile(
    r"(?P<label>\w+)(?:\*(?P<low>\d)(?:-(?P<high>\d))?)?: (?P<kinds>[\w|$]+)(?: \[(?P<states>[\w ]+)\])?"
    r"(?: @(?P<rooms>[\w|]+)| (?P<relation>on|in|under|by) (?P<host>\w+))"
)
_GOAL: Final = re.compile(
    r"(?:(?P<quantity>any|none|k of|k paired|paired) )?(?P<things>\w+) "
    r"(?:(?P<relation>on|in|under|by) (?P<place>\w+)|(?P<state>[\w!]+)(?: with (?P<source>\w+))?)"
)
_RELATIONS: Final = {
    "on": Relation.ONTOP,
    "in": Relation.INSIDE,
    "under": Relation.UNDER,
    "by": Relation.NEXTTO,
}
_STATES: Final[Mapping[str, tuple[WishPredicate, bool]]] = {
    "open": (WishPredicate.OPEN, True),
    "closed": (WishPredicate.OPEN, False),
    "on!": (WishPredicate.TOGGLED_ON, True),
    "off": (WishPredicate.TOGGLED_ON, False),
    "cooked": (WishPredicate.COOKED, True),
    "hot": (WishPredicate.HOT, True),
    "frozen": (WishPredicate.FROZEN, True),
    "dusted": (WishPredicate.DUSTY, False),
    "unstained": (WishPredicate.STAINED, False),
    "soaked": (WishPredicate.SOAKED, True),
    "sliced": (WishPredicate.SLICED, True),
}
_QUANTITIES: Final = {
    None: Quantity.ALL,
    "any": Quantity.ANY,
    "none": Quantity.NONE,
    "k of": Quantity.EXACTLY,
    "paired": Quantity.PAIRED,
    "k paired": Quantity.SOME_PAIRED,
}


class KnowledgeError(ValueError):
    """Entry of a table that does not follow the notation. The message quotes it and says what is expected."""


@dataclass(frozen=True, slots=True)
class ObjectRole:
    """Objects that a need declares. ``kinds`` are alternatives; ``rooms`` are those of furniture, empty for other objects."""

    label: str
    kinds: tuple[str, ...]
    count: tuple[int, int]
    states: tuple[State, ...]
    rooms: tuple[str, ...] = ()
    relation: Relation | None = None
    host: str = ""


@dataclass(frozen=True, slots=True)
class GoalPart:
    """Condition of a need, about labels of its objects."""

    predicate: WishPredicate
    things: str
    place: str = ""
    quantity: Quantity = Quantity.ALL
    holds: bool = True
    otherwise: GoalPart | None = None
    """Alternative about other things at the same place."""


@dataclass(frozen=True, slots=True)
class Need:
    """Objects and conditions, and sentences that imply the conditions. ``count`` fixes the number k; 0 leaves it open."""

    name: str
    roles: tuple[ObjectRole, ...]
    goal: tuple[GoalPart, ...]
    say: tuple[str, ...] = ()
    count: int = 0


@dataclass(frozen=True, slots=True)
class Event:
    """Event of a day. ``of`` lists jobs and hobbies that cause it; empty means anybody in the age range."""

    name: str
    needs: tuple[Need, ...]
    why: tuple[str, ...]
    hours: tuple[int, int]
    places: frozenset[str]
    of: frozenset[str] = frozenset()
    ages: tuple[int, int] = (6, 99)
    before: tuple[str, ...] = ()
    """Times by which the needs are to be met, as phrases."""


@functools.cache
def events() -> tuple[Event, ...]:
    """Return the table of events. Raise KnowledgeError."""
    table = _table("events.toml")
    return tuple(_event(entry, table["classes"]) for entry in table["event"])


@functools.cache
def people_table() -> Mapping[str, Any]:
    """Return the table of names, jobs, hobbies and ties."""
    return _table("people.toml")


def _table(file: str) -> Mapping[str, Any]:
    text = (resources.files("embomatrix.factory.social") / file).read_text(encoding="utf-8")
    return tomllib.loads(text)


def _event(entry: Mapping[str, Any], classes: Mapping[str, list[str]]) -> Event:
    name = entry["name"]
    low, high = entry["hours"]
    youngest, oldest = entry.get("ages", (6, 99))
    needs = tuple(
        _need(f"{name} {number}", need, classes) for number, need in enumerate(entry["need"], start=1)
    )
    places = frozenset(entry.get("places", ["home"]))
    return Event(
        name,
        needs,
        tuple(entry["why"]),
        (low, high),
        places,
        frozenset(entry.get("of", ())),
        (youngest, oldest),
        tuple(entry.get("before", ())),
    )


def _need(name: str, entry: Mapping[str, Any], classes: Mapping[str, list[str]]) -> Need:
    roles = [_role(line, classes) for line in entry["objects"]]
    goal = tuple(_goal_part(line) for line in entry["goal"])
    labels = {role.label for role in roles}
    parts = [each for part in goal for each in (part, part.otherwise) if each is not None]
    for label in (
        *(role.host for role in roles),
        *(word for part in parts for word in (part.things, part.place)),
    ):
        if label and label not in labels:
            raise KnowledgeError(
                f"the need {name!r} is about {label!r}: expected one of {', '.join(sorted(labels))}"
            )
    return Need(name, _hosts_first(name, roles), goal, tuple(entry.get("say", ())), entry.get("k", 0))


def _role(line: str, classes: Mapping[str, list[str]]) -> ObjectRole:
    found = _OBJECTS.fullmatch(line)
    if found is None:
        raise KnowledgeError(f"found {line!r}: expected `label: kind @room` or `label*2-3: kind on host`")
    kinds: list[str] = []
    for kind in found["kinds"].split("|"):
        kinds += classes[kind[1:]] if kind.startswith("$") else [kind]
    low = int(found["low"] or 1)
    return ObjectRole(
        found["label"],
        tuple(dict.fromkeys(kinds)),
        (low, int(found["high"] or low)),
        tuple(State(word) for word in (found["states"] or "").split()),
        tuple(found["rooms"].split("|")) if found["rooms"] else (),
        _RELATIONS[found["relation"]] if found["relation"] else None,
        found["host"] or "",
    )


def _goal_part(line: str) -> GoalPart:
    first, _, other = line.partition(" or ")
    part = _plain_part(first)
    return dataclasses.replace(part, otherwise=_plain_part(other)) if other else part


def _plain_part(line: str) -> GoalPart:
    found = _GOAL.fullmatch(line)
    if found is None or (found["state"] and found["state"] not in _STATES):
        raise KnowledgeError(
            f"found the goal {line!r}: expected `milk in fridge`, `k of cups on table` or `lamp off`"
        )
    quantity = _QUANTITIES[found["quantity"]]
    if found["relation"]:
        predicate = WishPredicate(_RELATIONS[found["relation"]].value)
        return GoalPart(predicate, found["things"], found["place"], quantity)
    predicate, holds = _STATES[found["state"]]
    return GoalPart(predicate, found["things"], found["source"] or "", quantity, holds)


def _hosts_first(name: str, roles: list[ObjectRole]) -> tuple[ObjectRole, ...]:
    """Return the roles in an order in which hosts come before what they hold."""
    ordered: list[ObjectRole] = []
    while len(ordered) < len(roles):
        ready = {"", *(role.label for role in ordered)}
        found = [role for role in roles if role not in ordered and role.host in ready]
        if not found:
            raise KnowledgeError(f"the objects of the need {name!r} lie on one another in a circle")
        ordered += found
    return tuple(ordered)
