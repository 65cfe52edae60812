"""Pieces of goals: each kind of thing that a task can ask for, with the words that ask for it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from embomatrix.factory.furnish.small_objects import FOR_DRINKS, suits
from embomatrix.factory.writer.words import PHRASES, Voice, phrase, refer, room_words, spoken
from embomatrix.world.asset import JointKind
from embomatrix.world.goal import And, Atom, Exists, Formula, Not
from embomatrix.world.state import Relation
from embomatrix.world.substances import flows_from

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import numpy as np

    from embomatrix.factory.scenes.view import SceneView
    from embomatrix.factory.writer.variant import Variant

TAP: Final = "tap"
DRAWERS: Final = "drawers"
MAX_ALIKE: Final = 4
"""Furniture of one category in one room, of which a goal may mean any."""
MAX_PICKS: Final = 4
"""Objects that the robot tries before a wish is given up."""


@dataclass(frozen=True, slots=True)
class GoalConjunct:
    """One conjunct of a goal. ``objects`` are all that it is about, ``signs`` its part of the goal's signature.

    ``clause`` asks for it; ``thing`` is what it is about, in words; ``kind`` is "place", "switch" or "thermal"; ``manner``
    tells how a thing is switched that people have other words for: by its tap, or its drawers.
    """

    goal: Formula
    clause: str
    objects: tuple[str, ...]
    signs: tuple[str, ...]
    kind: str
    thing: str
    types: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    manner: str = ""


@dataclass(frozen=True)
class GoalContext:
    """What the makers of pieces draw from. ``used`` are objects that earlier pieces of the same goal are about.

    ``phrases`` are the ways to ask for an atom, by predicate, or by predicate and manner where they know some; ``where`` those
    to say in which room a thing is, ``whence`` the same of what is to be taken away, ``room_called`` what a room is called,
    ``nouns`` what categories are, where not by their names; ``voice`` chooses among them, equally where none is given.
    """

    view: SceneView
    variant: Variant
    rng: np.random.Generator
    used: frozenset[str] = frozenset()
    phrases: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: PHRASES)
    where: tuple[str, ...] = ("in {room}",)
    whence: tuple[str, ...] = ("in {room}",)
    nouns: Mapping[str, str] = field(default_factory=dict)
    room_called: Callable[[SceneView, str], str] = room_words
    voice: Voice | None = None

    def phrase(self, kind: str, *, thing: str, place: str = "", manner: str = "") -> str:
        """One imperative clause."""
        options = self.phrases.get(f"{kind} {manner}", self.phrases[kind])
        return phrase(options, self._voice, thing=thing, place=place)

    def refer(self, name: str) -> str:
        """A noun phrase for an object."""
        return self._referred(name, self.where)

    def refer_taken(self, name: str) -> str:
        """A noun phrase for an object that is to be taken away."""
        return self._referred(name, self.whence)

    def _referred(self, name: str, where: Sequence[str]) -> str:
        return refer(self.view, name, self._voice, where, self.noun(name), self.room_called)

    def noun(self, name: str) -> str:
        """What an object is called."""
        category = self.view.category(name)
        return self.nouns.get(category, spoken(category))

    @property
    def _voice(self) -> Voice:
        return self.voice or Voice(self.rng)

    def pick(self, names: Sequence[str], works: Callable[[str], bool] = lambda _: True) -> str | None:
        """One of some objects, none that is used already, with which it works; None where the first few do not."""
        fresh = [name for name in names if name not in self.used]
        order = self.rng.permutation(len(fresh))[:MAX_PICKS]
        return next((fresh[index] for index in order if works(fresh[index])), None)

    def fixtures(self, wanted: Callable[[str], bool]) -> list[str]:
        """Objects of the variant's rooms that are wanted, that open, and that words can name, alone or as one of a few."""
        return [
            name
            for room in self.variant.rooms
            for name in self.view.in_room[room]
            if wanted(name) and len(self.view.alike(name)) <= MAX_ALIKE and self.view.opens(name)
        ]

    def things(self) -> list[str]:
        """Small things that can be carried and that bear nothing themselves."""
        hosts = {item.host for item in self.view.scene.objects}
        return [name for name in self.variant.added if self.view.is_portable(name) and name not in hosts]


def placement_goal(shop: GoalContext) -> GoalConjunct | None:
    """Put a thing on or in another: furniture, an appliance or a basket."""
    thing = shop.pick(
        [name for name in shop.things() if not shop.view.is_basket(name)], shop.view.robot.fetches
    )
    if thing is None:
        return None
    return _place_goal(shop, thing, shop.refer_taken(thing))


def _place_goal(shop: GoalContext, thing: str, called: str) -> GoalConjunct | None:
    """Put the thing, called so in the request, on or in something that it is not at already and that is large enough."""
    view, rng = shop.view, shop.rng
    inside = rng.random() < 0.5
    baskets = [name for name in shop.variant.added if view.is_basket(name) and name != thing]
    targets = (
        [*shop.fixtures(view.is_container), *baskets, *baskets] if inside else shop.fixtures(view.is_surface)
    )
    here = {view.category(host) for host in view.hosts(thing)}
    category = view.category(thing)
    relation = Relation.INSIDE if inside else Relation.ONTOP
    target = shop.pick(
        [
            name
            for name in targets
            if view.category(name) not in here
            and suits(category, view.category(name))
            and view.takes(name, thing, inside=inside)
        ],
        lambda host: view.robot.puts(thing, relation, host),
    )
    if target is None:
        return None
    predicate = relation.value
    goal, types, objects, place = _any_alike(shop, target, lambda host: Atom(predicate, (thing, host)))
    return GoalConjunct(
        goal=goal,
        clause=shop.phrase(predicate, thing=called, place=place),
        objects=(thing, *objects),
        signs=(f"{predicate}({view.category(thing)},{view.category(target)})",),
        kind="place",
        thing=called,
        types=types,
    )


def placed_elsewhere(shop: GoalContext, piece: GoalConjunct) -> GoalConjunct | None:
    """The thing of a piece put in another place than the piece says; None where it is about no thing to be placed."""
    if piece.kind != "place":
        return None
    other = dataclasses.replace(shop, used=shop.used | frozenset(piece.objects[1:]))
    return _place_goal(other, piece.objects[0], piece.thing)


def _any_alike(
    shop: GoalContext, target: str, atom: Callable[[str], Formula]
) -> tuple[Formula, Mapping[str, tuple[str, ...]], tuple[str, ...], str]:
    """The atom about the target, or about any of those that the same words mean; with the words."""
    view = shop.view
    alike = view.alike(target)
    if len(alike) == 1:
        return atom(target), {}, (target,), shop.refer(target)
    synset = view.asset(target).synset
    variable = f"?{synset}"
    return (
        Exists(variable, synset, atom(variable)),
        {synset: alike},
        alike,
        shop.refer(target),
    )


def switch_goal(shop: GoalContext) -> GoalConjunct | None:
    """Open or close a door, switch an appliance or a light on or off."""
    view, rng = shop.view, shop.rng
    name = shop.pick(shop.fixtures(view.is_switchable))
    if name is None:
        return None
    options = [("open", view.is_open(name))] * view.is_openable(name)
    options += [("toggled_on", view.is_on(name))] * view.is_toggleable(name)
    predicate, holds = options[int(rng.integers(len(options)))]
    if len(view.alike(name)) > 1 and any(
        _holds(view, predicate, other) != holds for other in view.alike(name)
    ):
        return None  # "open a cabinet" asks for nothing where one is open already
    if not (
        view.robot.swings(name, shut=holds)
        if predicate == "open"
        else view.robot.switches(name, on=not holds)
    ):
        return None
    kind = f"not {predicate}" if holds else predicate

    def atom(target: str) -> Formula:
        return Not(Atom(predicate, (target,))) if holds else Atom(predicate, (target,))

    goal, types, objects, words = _any_alike(shop, name, atom)
    manner = _manner(view, name, predicate)
    return GoalConjunct(
        goal=goal,
        clause=shop.phrase(kind, thing=words, manner=manner),
        objects=objects,
        signs=(f"{kind}({view.category(name)})",),
        kind="switch",
        thing=words,
        types=types,
        manner=manner,
    )


def _manner(view: SceneView, name: str, predicate: str) -> str:
    """What of a thing is switched or opened, where that is neither a button nor a door."""
    asset = view.asset(name)
    if predicate == "toggled_on":
        return TAP if flows_from(asset.synset) else ""
    return DRAWERS if all(joint.kind is JointKind.PRISMATIC for _, joint in asset.joints) else ""


def _holds(view: SceneView, predicate: str, name: str) -> bool:
    return view.is_open(name) if predicate == "open" else view.is_on(name)


def thermal_goal(shop: GoalContext) -> GoalConjunct | None:
    """Heat, cook or freeze food with a source of the variant's rooms, and now and then leave it there."""
    view, rng = shop.view, shop.rng
    foods = [name for name in shop.things() if view.asset(name).can("cookable")]
    food = shop.pick(foods, view.robot.fetches)
    source = shop.pick(
        shop.fixtures(lambda name: view.is_source(name) and view.category(name) not in FOR_DRINKS)
    )
    if food is None or source is None or source in view.hosts(food):
        return None
    effects = [
        state for state in view.thermal_effects(food, source) if view.robot.exposes(food, source, state)
    ]
    if not effects:
        return None
    return _thermal(shop, food, source, effects[int(rng.integers(len(effects)))].value)


def _thermal(shop: GoalContext, food: str, source: str, predicate: str) -> GoalConjunct:
    view, rng = shop.view, shop.rng
    place = shop.refer(source)
    goal: Formula = Atom(predicate, (food,))
    objects: tuple[str, ...] = (food,)
    signs: tuple[str, ...] = (f"{predicate}({view.category(food)})",)
    called = shop.refer_taken(food)
    clause = shop.phrase(predicate, thing=called, place=place)
    if view.is_container(source) and len(view.alike(source)) == 1 and rng.random() < 0.35:
        goal = And((goal, Atom("inside", (food, source))))
        objects = (food, source)
        signs = (*signs, f"inside({view.category(food)},{view.category(source)})")
        clause += f" and leave it in the {shop.noun(source)}"
    return GoalConjunct(goal, clause, (*objects, *(view.alike(source))), signs, "thermal", called)


def serving_goal(shop: GoalContext) -> GoalConjunct | None:
    """Heat, cook or freeze food, then put it somewhere else."""
    first = thermal_goal(shop)
    if first is None or isinstance(first.goal, And):
        return None
    food = first.objects[0]
    second = _place_goal(shop, food, "it")
    if second is None or set(second.objects[1:]) & set(first.objects[1:]):
        return None
    return GoalConjunct(
        goal=And((first.goal, second.goal)),
        clause=f"{first.clause}, then {second.clause}",
        objects=tuple(dict.fromkeys((*first.objects, *second.objects))),
        signs=(*first.signs, *second.signs),
        kind=first.kind,
        thing=first.thing,
        types=second.types,
    )
