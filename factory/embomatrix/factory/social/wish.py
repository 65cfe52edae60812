"""Wish of a person: objects with their start, conditions that must hold afterwards, and the BDDL problem of both.

A wish comes before its scene. Objects that the scene lacks are laid out for it. Labels name groups of alike objects, so
that a condition can demand something of each of them, of any, of an exact number or of none.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from typing import Annotated, Final

from pydantic import Field, WithJsonSchema, model_validator
from pydantic.json_schema import SkipJsonSchema

from embomatrix.factory.social.values import StrictModel
from embomatrix.world.bddl import BddlProblem, InitLiteral
from embomatrix.world.catalog import Catalog
from embomatrix.world.goal import And, Atom, Formula, Imply, Not, Or, Quantified, Quantifier
from embomatrix.world.state import Relation, State

MAX_OBJECTS: Final = 24
"""Maximum number of groups of objects in a wish."""
MAX_CONDITIONS: Final = 12
MAX_COUNT: Final = 8
"""Maximum number of objects in a group."""
FLOOR: Final = "floor"
"""Kind of the floor of a room."""
_FLOOR_SYNSET: Final = "floor.n.01"


class WishPredicate(StrEnum):
    """Predicates that a wish may use. The robot's skills can achieve all of them."""

    ONTOP = "ontop"
    INSIDE = "inside"
    UNDER = "under"
    NEXTTO = "nextto"
    OPEN = "open"
    TOGGLED_ON = "toggled_on"
    COOKED = "cooked"
    HOT = "hot"
    FROZEN = "frozen"
    DUSTY = "dusty"
    STAINED = "stained"
    SOAKED = "soaked"
    SLICED = "sliced"


PLACED: Final = frozenset(
    {WishPredicate.ONTOP, WishPredicate.INSIDE, WishPredicate.UNDER, WishPredicate.NEXTTO}
)
"""Predicates about a thing and its place."""
THERMAL: Final = frozenset({WishPredicate.COOKED, WishPredicate.HOT, WishPredicate.FROZEN})
"""Predicates whose place, if there is one, is the appliance that brings the state about."""


class Quantity(StrEnum):
    """Number of a group's objects that a condition is about."""

    ALL = "all"
    ANY = "any"
    EXACTLY = "exactly"
    NONE = "none"
    PAIRED = "paired"  # one object for each place: a cup on each saucer
    SOME_PAIRED = "some_paired"  # an exact number of objects, each at a place of its own


COUNTED: Final = (Quantity.EXACTLY, Quantity.SOME_PAIRED)
"""Quantities with a number."""
PAIRS: Final = frozenset({Quantity.PAIRED, Quantity.SOME_PAIRED})
"""Quantities of one-to-one pairs of objects and places."""


class WishedObjects(StrictModel):
    """Group of alike objects. ``kind`` is a category of the catalog.

    They start in ``room``: in ``relation`` to the group ``host``, or anywhere suitable if there is no host. Furniture and
    appliances (``furniture``) are taken from the scene, and added to it only if it has none.
    """

    label: str = Field(pattern=r"^[a-z][a-z0-9_]{0,39}$")
    kind: str = Field(min_length=1, max_length=60)
    count: int = Field(default=1, ge=1, le=MAX_COUNT)
    room: str = Field(default="", max_length=64)
    relation: Annotated[Relation | None, WithJsonSchema({"type": "string", "enum": sorted(PLACED)})] = None
    host: str = ""
    furniture: bool = False
    states: tuple[State, ...] = ()
    """States at the start, such as ``open`` or ``dusty``."""
    decoy: SkipJsonSchema[bool] = False
    """True for objects that no condition is about: they make the description necessary."""


class Condition(StrictModel):
    """Condition on a group of objects. ``place`` is the group of its hosts, or of thermal sources if the wish names one.

    ``count`` belongs to the quantities EXACTLY and SOME_PAIRED. ``otherwise`` is an alternative condition. ``provided`` is
    the premise of the condition. ``holds`` is false for the contrary, such as closed or switched off.
    """

    predicate: WishPredicate
    things: str
    place: str = ""
    quantity: Quantity = Quantity.ALL
    count: int = Field(default=0, ge=0, le=MAX_COUNT)
    holds: bool = True
    otherwise: Condition | None = None
    provided: Condition | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Condition:
        placed = self.predicate in PLACED
        if placed and not self.place:
            raise ValueError(f"{self.predicate.value} takes a place: name the label of a group")
        if self.place and not placed and self.predicate not in THERMAL:
            raise ValueError(f"{self.predicate.value} takes no place, found {self.place!r}")
        if (self.quantity in COUNTED) != bool(self.count):
            takers = " and ".join(repr(each.value) for each in COUNTED)
            raise ValueError(
                f"count is {self.count} with the quantity {self.quantity.value}: expected one with {takers} only"
            )
        return self

    def parts(self) -> Iterator[Condition]:
        """Yield this condition, its alternatives and its premises."""
        yield self
        for other in (self.otherwise, self.provided):
            if other is not None:
                yield from other.parts()

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of all groups that the condition is about."""
        names = (name for part in self.parts() for name in (part.things, part.place))
        return tuple(dict.fromkeys(filter(None, names)))


class Wish(StrictModel):
    """Objects and conditions. Each condition is about declared objects, and hosts come before what they hold."""

    objects: tuple[WishedObjects, ...] = Field(min_length=1, max_length=MAX_OBJECTS)
    conditions: tuple[Condition, ...] = Field(min_length=1, max_length=MAX_CONDITIONS)

    @model_validator(mode="after")
    def _declared(self) -> Wish:
        known: set[str] = set()
        for group in self.objects:
            if group.label in known:
                raise ValueError(f"two groups have the label {group.label!r}: every label must be unique")
            if group.host and group.host not in known:
                raise ValueError(f"{group.label!r} starts at {group.host!r}, which no earlier group declares")
            if (group.relation is None) != (not group.host):
                raise ValueError(f"{group.label!r} takes both a relation and a host, or neither")
            known.add(group.label)
        for condition in self.conditions:
            for label in condition.labels:
                if label not in known:
                    raise ValueError(
                        f"a condition is about {label!r}: expected one of {', '.join(sorted(known))}"
                    )
        return self

    @property
    def groups(self) -> Mapping[str, WishedObjects]:
        """Groups by label."""
        return {group.label: group for group in self.objects}

    def room_of(self, label: str) -> str:
        """Return the room of a group, which is that of the furniture that it starts on or in."""
        group = self.groups[label]
        while group.host:
            group = self.groups[group.host]
        return group.room

    @property
    def wanted(self) -> tuple[str, ...]:
        """Labels of the groups that the conditions are about."""
        return tuple(dict.fromkeys(label for condition in self.conditions for label in condition.labels))


def goal_of(
    conditions: Sequence[Condition], members: Mapping[str, Sequence[str]], types: Mapping[str, str]
) -> Formula:
    """Return the conjunction of the conditions. ``members`` are the objects of each group.

    ``types`` gives groups a type to quantify over; groups without one are written out object by object.
    """
    parts = [_formula(condition, members, types) for condition in conditions]
    flat = tuple(
        itertools.chain.from_iterable(part.parts if isinstance(part, And) else (part,) for part in parts)
    )
    return flat[0] if len(flat) == 1 else And(flat)


def _formula(condition: Condition, members: Mapping[str, Sequence[str]], types: Mapping[str, str]) -> Formula:
    formula = _quantified(condition, members, types)
    if condition.otherwise is not None:
        formula = Or((formula, _formula(condition.otherwise, members, types)))
    if condition.provided is not None:
        formula = Imply(_formula(condition.provided, members, types), formula)
    return formula


def _quantified(
    condition: Condition, members: Mapping[str, Sequence[str]], types: Mapping[str, str]
) -> Formula:
    things, places = members[condition.things], members.get(condition.place, ())
    type_name, place_type = types.get(condition.things, ""), types.get(condition.place, "")
    negated = condition.holds is (condition.quantity is Quantity.NONE)
    if condition.quantity in PAIRS:
        binders = ((f"?{type_name}", type_name), (f"?{place_type}", place_type))
        atom = Atom(condition.predicate.value, tuple(name for name, _ in binders))
        if condition.quantity is Quantity.PAIRED:
            return Quantified(Quantifier.FORPAIRS, binders, atom)
        return Quantified(Quantifier.FORNPAIRS, binders, atom, condition.count)

    def about(thing: str) -> Formula:
        found = _at_some_place(condition.predicate.value, thing, places, place_type)
        return Not(found) if negated else found

    if len(things) == 1:
        return about(things[0])
    match condition.quantity:
        case Quantity.ALL | Quantity.NONE if not type_name:
            return And(tuple(map(about, things)))
        case Quantity.ANY if not type_name:
            return Or(tuple(map(about, things)))
        case Quantity.EXACTLY:
            count: int | None = condition.count
            quantifier = Quantifier.FORN
        case Quantity.ANY:
            count, quantifier = None, Quantifier.EXISTS
        case _:
            count, quantifier = None, Quantifier.FORALL
    return Quantified(quantifier, ((f"?{type_name}", type_name),), about(f"?{type_name}"), count)


def _at_some_place(predicate: str, thing: str, places: Sequence[str], place_type: str) -> Formula:
    """Return the atom about the thing, at any of the places if there are several."""
    if len(places) < 2:
        return Atom(predicate, (thing, *places))
    if place_type:
        variable = f"?{place_type}"
        return Quantified(Quantifier.EXISTS, ((variable, place_type),), Atom(predicate, (thing, variable)))
    return Or(tuple(Atom(predicate, (thing, place)) for place in places))


def problem_of(
    name: str, wishes: Sequence[Wish]
) -> tuple[BddlProblem, tuple[Mapping[str, tuple[str, ...]], ...]]:
    """Return one problem with the objects of all wishes, and the names of each wish's objects by label.

    Furniture of one kind in one room is shared between the wishes. The goal is the conjunction of all conditions, written
    out object by object, so that the layout provides space for all of them.
    """
    writer = _ProblemWriter()
    members = tuple(writer.declare(wish) for wish in wishes)
    parts = [
        goal_of(_without_quantities(wish.conditions), names, {})
        for wish, names in zip(wishes, members, strict=True)
    ]
    goal = parts[0] if len(parts) == 1 else And(tuple(parts))
    return BddlProblem(name, writer.objects, tuple(writer.init), goal), members


def _without_quantities(conditions: Sequence[Condition]) -> list[Condition]:
    """Return conditions on all objects: the largest demand on the space of each place."""
    plain = {"quantity": Quantity.ALL, "count": 0, "otherwise": None, "provided": None}
    return [
        each.model_copy(
            update=plain if each.quantity is not Quantity.NONE else {**plain, "holds": not each.holds}
        )
        for each in conditions
    ]


class _ProblemWriter:
    def __init__(self) -> None:
        self.objects: dict[str, str] = {}
        self.init: list[InitLiteral] = []
        self._shared: dict[tuple[str, str, int], str] = {}
        self._counts: dict[str, int] = {}

    def declare(self, wish: Wish) -> dict[str, tuple[str, ...]]:
        names: dict[str, tuple[str, ...]] = {}
        for group in wish.objects:
            names[group.label] = tuple(self._object(group, number, names) for number in range(group.count))
        return names

    def _object(self, group: WishedObjects, number: int, names: Mapping[str, tuple[str, ...]]) -> str:
        synset = _FLOOR_SYNSET if group.kind == FLOOR else Catalog.load().synset_of(group.kind)
        key = (group.kind, group.room, number)
        if group.furniture and key in self._shared:
            return self._shared[key]
        self._counts[synset] = self._counts.get(synset, 0) + 1
        name = f"{synset}_{self._counts[synset]}"
        self.objects[name] = synset
        if group.furniture:
            self._shared[key] = name
            self.init.append(InitLiteral(Atom(Relation.INROOM.value, (name, group.room))))
        elif group.relation is not None:
            hosts = names[group.host]
            self.init.append(InitLiteral(Atom(group.relation.value, (name, hosts[number % len(hosts)]))))
        else:
            self.init.append(InitLiteral(Atom(Relation.INROOM.value, (name, group.room))))
        self.init += (InitLiteral(Atom(state.value, (name,))) for state in group.states)
        return name
