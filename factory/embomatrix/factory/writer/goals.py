"""Goal conjuncts: each kind of request with its words."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from embomatrix.factory.furnish.small_objects import FOR_DRINKS, suits
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.writer.variant import Variant
from embomatrix.factory.writer.words import PHRASES, Voice, room_words, spoken
from embomatrix.world.asset import JointKind
from embomatrix.world.goal import And, Atom, Formula, Not, Quantified, Quantifier
from embomatrix.world.intent import IntentClause
from embomatrix.world.state import Relation
from embomatrix.world.substances import flows_from

TAP_MANNER: Final = "tap"
DRAWER_MANNER: Final = "drawers"
MAX_ALIKE: Final = 4
"""Maximum number of equal furniture conjuncts in a room for a goal that accepts any of them."""
MAX_PICKS: Final = 4
"""Number of objects tried before a request is abandoned."""


@dataclass(frozen=True, slots=True)
class GoalConjunct:
    """Conjunct of a goal. ``objects`` lists all objects involved, ``signs`` its part of the goal's signature.

    ``intent`` is what the words demand. ``clause`` is the request, and ``thing`` names the object in words. ``kind`` is
    "place", "switch" or "thermal".
    ``manner`` is set for objects that are switched by a tap or opened by drawers.
    """

    goal: Formula
    clause: str
    objects: tuple[str, ...]
    signs: tuple[str, ...]
    kind: str
    thing: str
    types: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    manner: str = ""
    intent: tuple[IntentClause, ...] = ()


@dataclass(frozen=True)
class GoalContext:
    """Scene, vocabulary and random generator for goals. ``used`` lists objects of earlier conjuncts of the same goal.

    ``phrases`` maps a predicate, or a predicate with a manner, to its phrases. ``where`` and ``whence`` name the room
    of an object, and of an object that is taken away. ``room_called`` and ``nouns`` name rooms and categories.
    ``voice`` chooses phrases; by default all are equally likely.
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

    def phrase(self, kind: str, manner: str = "") -> str:
        """Return one imperative clause, with the placeholders ``{thing}`` and, in some clauses, ``{place}``."""
        return self._voice.choose(self.phrases.get(f"{kind} {manner}", self.phrases[kind]))

    def refer(self, name: str, *, taken: bool = False) -> str:
        """Return a noun phrase for an object, or for any object of its category in its room.

        The room is named if the category alone is ambiguous, and sometimes otherwise. ``taken`` objects leave it.
        """
        view, noun = self.view, self.noun(name)
        article = "the" if len(view.alike(name)) == 1 else "an" if noun[0] in "aeiou" else "a"
        words = f"{article} {noun}"
        ambiguous = len(view.rooms_with(view.category(name))) > 1
        if ambiguous or self.rng.random() < 0.35:
            where = self._voice.choose(self.whence if taken else self.where)
            words += " " + where.format(room=self.room_called(view, view.room(name)))
        return words

    def noun(self, name: str) -> str:
        """Return the noun for an object."""
        category = self.view.category(name)
        return self.nouns.get(category, spoken(category))

    @property
    def _voice(self) -> Voice:
        return self.voice or Voice(self.rng)

    def pick(self, names: Sequence[str], works: Callable[[str], bool] = lambda _: True) -> str | None:
        """Return an unused object that passes ``works``; None if the first few don't."""
        fresh = [name for name in names if name not in self.used]
        order = self.rng.permutation(len(fresh))[:MAX_PICKS]
        return next((fresh[index] for index in order if works(fresh[index])), None)

    def fixtures(self, wanted: Callable[[str], bool]) -> list[str]:
        """Return suitable objects of the variant's rooms that can open and that words can identify."""
        return [
            name
            for room in self.variant.rooms
            for name in self.view.in_room[room]
            if wanted(name) and len(self.view.alike(name)) <= MAX_ALIKE and self.view.opens(name)
        ]

    def things(self) -> list[str]:
        """Return small portable objects that support nothing."""
        hosts = {item.host for item in self.view.scene.objects}
        return [name for name in self.variant.added if self.view.is_portable(name) and name not in hosts]


def placement_goal(context: GoalContext) -> GoalConjunct | None:
    """Put an object on or in furniture, an appliance or a basket."""
    thing = context.pick(
        [name for name in context.things() if not context.view.is_basket(name)],
        context.view.robot.can_pick_up,
    )
    if thing is None:
        return None
    return _place_goal(context, thing, context.refer(thing, taken=True))


def _place_goal(context: GoalContext, thing: str, called: str) -> GoalConjunct | None:
    """Put the object on or in a sufficiently large host other than its current one. ``called`` names it in the request."""
    view, rng = context.view, context.rng
    inside = rng.random() < 0.5
    baskets = [name for name in context.variant.added if view.is_basket(name) and name != thing]
    targets = (
        [*context.fixtures(view.is_container), *baskets, *baskets]
        if inside
        else context.fixtures(view.is_surface)
    )
    here = {view.category(host) for host in view.hosts(thing)}
    category = view.category(thing)
    relation = Relation.INSIDE if inside else Relation.ONTOP
    target = context.pick(
        [
            name
            for name in targets
            if view.category(name) not in here
            and suits(category, view.category(name))
            and view.takes(name, thing, inside=inside)
        ],
        lambda host: view.robot.can_place(thing, relation, host),
    )
    if target is None:
        return None
    predicate = relation.value
    goal, types, objects, place = _any_alike(context, target, lambda host: Atom(predicate, (thing, host)))
    return GoalConjunct(
        goal=goal,
        clause=context.phrase(predicate).format(thing=called, place=place),
        objects=(thing, *objects),
        signs=(f"{predicate}({view.category(thing)},{view.category(target)})",),
        kind="place",
        thing=called,
        types=types,
        intent=(IntentClause(predicate, (thing,), objects),),
    )


def placed_elsewhere(context: GoalContext, conjunct: GoalConjunct) -> GoalConjunct | None:
    """Return the object of a placement goal in another place; None for other goals."""
    if conjunct.kind != "place":
        return None
    other = dataclasses.replace(context, used=context.used | frozenset(conjunct.objects[1:]))
    return _place_goal(other, conjunct.objects[0], conjunct.thing)


def _any_alike(
    context: GoalContext, target: str, atom: Callable[[str], Formula]
) -> tuple[Formula, Mapping[str, tuple[str, ...]], tuple[str, ...], str]:
    """Return the atom about the target, or about any object that the same words describe, with its types, objects and words."""
    view = context.view
    alike = view.alike(target)
    if len(alike) == 1:
        return atom(target), {}, (target,), context.refer(target)
    synset = view.asset(target).synset
    variable = f"?{synset}"
    goal = Quantified(Quantifier.EXISTS, ((variable, synset),), atom(variable))
    return goal, {synset: alike}, alike, context.refer(target)


def switch_goal(context: GoalContext) -> GoalConjunct | None:
    """Open or close a door, or switch an appliance or a light."""
    view, rng = context.view, context.rng
    name = context.pick(context.fixtures(view.is_switchable))
    if name is None:
        return None
    options = [("open", view.is_open(name))] * view.is_openable(name)
    options += [("toggled_on", view.is_on(name))] * view.is_toggleable(name)
    predicate, holds = options[int(rng.integers(len(options)))]
    if len(view.alike(name)) > 1 and any(
        _holds(view, predicate, other) != holds for other in view.alike(name)
    ):
        return None  # "open a cabinet" is trivial if one is already open
    if not (
        view.robot.can_swing(name, shut=holds)
        if predicate == "open"
        else view.robot.can_switch(name, on=not holds)
    ):
        return None
    kind = f"not {predicate}" if holds else predicate

    def atom(target: str) -> Formula:
        return Not(Atom(predicate, (target,))) if holds else Atom(predicate, (target,))

    goal, types, objects, words = _any_alike(context, name, atom)
    manner = _manner(view, name, predicate)
    return GoalConjunct(
        goal=goal,
        clause=context.phrase(kind, manner).format(thing=words),
        objects=objects,
        signs=(f"{kind}({view.category(name)})",),
        kind="switch",
        thing=words,
        types=types,
        manner=manner,
        intent=(IntentClause(predicate, objects, holds=not holds),),
    )


def _manner(view: SceneView, name: str, predicate: str) -> str:
    """Return the manner of an object that is switched by a tap or opened by drawers."""
    asset = view.asset(name)
    if predicate == "toggled_on":
        return TAP_MANNER if flows_from(asset.synset) else ""
    return DRAWER_MANNER if all(joint.kind is JointKind.PRISMATIC for _, joint in asset.joints) else ""


def _holds(view: SceneView, predicate: str, name: str) -> bool:
    return view.is_open(name) if predicate == "open" else view.is_on(name)


def thermal_goal(context: GoalContext) -> GoalConjunct | None:
    """Heat, cook or freeze food with a source of the variant's rooms, sometimes leaving it there."""
    view, rng = context.view, context.rng
    foods = [name for name in context.things() if view.asset(name).can("cookable")]
    food = context.pick(foods, view.robot.can_pick_up)
    source = context.pick(
        context.fixtures(lambda name: view.is_source(name) and view.category(name) not in FOR_DRINKS)
    )
    if food is None or source is None or source in view.hosts(food):
        return None
    effects = [
        state for state in view.thermal_effects(food, source) if view.robot.can_treat(food, source, state)
    ]
    if not effects:
        return None
    return _thermal(context, food, source, effects[int(rng.integers(len(effects)))].value)


def _thermal(context: GoalContext, food: str, source: str, predicate: str) -> GoalConjunct:
    """Return the goal of the state. It names the source as its second argument if the request names it."""
    view, rng = context.view, context.rng
    sources, types, objects, place = _any_alike(context, source, lambda name: Atom(predicate, (food, name)))
    called = context.refer(food, taken=True)
    phrase = context.phrase(predicate)
    is_named = "{place}" in phrase
    clause = phrase.format(thing=called, place=place)
    goal: Formula = sources if is_named else Atom(predicate, (food,))
    kinds = [view.category(food), *([view.category(source)] if is_named else [])]
    signs: tuple[str, ...] = (f"{predicate}({','.join(kinds)})",)
    intent: tuple[IntentClause, ...] = (IntentClause(predicate, (food,), objects if is_named else ()),)
    if view.is_container(source) and len(objects) == 1 and rng.random() < 0.35:
        goal = And((goal, Atom("inside", (food, source))))
        signs = (*signs, f"inside({view.category(food)},{view.category(source)})")
        intent = (*intent, IntentClause("inside", (food,), (source,)))
        clause += f" and leave it in the {context.noun(source)}"
    named_types = types if is_named else {}
    return GoalConjunct(goal, clause, (food, *objects), signs, "thermal", called, named_types, intent=intent)


def serving_goal(context: GoalContext) -> GoalConjunct | None:
    """Heat, cook or freeze food, then put it somewhere else."""
    first = thermal_goal(context)
    if first is None or isinstance(first.goal, And):
        return None
    food = first.objects[0]
    second = _place_goal(context, food, "it")
    if (
        second is None
        or set(second.objects[1:]) & set(first.objects[1:])
        or first.types.keys() & second.types
    ):
        return None
    return GoalConjunct(
        goal=And((first.goal, second.goal)),
        clause=f"{first.clause}, then {second.clause}",
        objects=tuple(dict.fromkeys((*first.objects, *second.objects))),
        signs=(*first.signs, *second.signs),
        kind=first.kind,
        thing=first.thing,
        types={**first.types, **second.types},
        intent=(*first.intent, *second.intent),
    )
