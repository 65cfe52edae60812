"""Demands that a reader finds in an instruction, compared with the goal of its wish."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from pydantic import Field, ValidationError

from embomatrix.factory.social.rules.nouns import fits, mentions_in, tokens_of
from embomatrix.factory.social.scene_kinds import SceneKinds
from embomatrix.factory.social.values import StrictModel
from embomatrix.factory.social.wish import (
    COUNTED,
    MAX_CONDITIONS,
    MAX_COUNT,
    Condition,
    Quantity,
    Wish,
    WishedObjects,
    WishPredicate,
    goal_of,
)
from embomatrix.world.evaluate import map_atoms, render
from embomatrix.world.goal import And, Atom, Formula, Imply, Not, Or, Quantified


class Demand(StrictModel):
    """Condition in nouns of the instruction. ``where`` tells alike things apart: their room or place at the start."""

    predicate: WishPredicate
    thing: str = Field(min_length=1, max_length=80)
    place: str = Field("", max_length=80)
    where: str = Field("", max_length=80)
    quantity: Quantity = Quantity.ALL
    count: int = Field(0, ge=0, le=MAX_COUNT)
    holds: bool = True
    otherwise: Demand | None = None
    provided: Demand | None = None


class Demands(StrictModel):
    """Everything that one instruction demands."""

    conditions: tuple[Demand, ...] = Field(max_length=MAX_CONDITIONS)


def differences(demands: Demands, wish: Wish, scene: SceneKinds) -> tuple[str, ...]:
    """Return a sentence for each difference between the demands and the goal of the wish; empty if they are equal."""
    conditions, problems = [], []
    for demand in demands.conditions:
        found = _condition_of(demand, wish, scene)
        if isinstance(found, str):
            problems.append(f"the words demand {found}, and no condition does")
        else:
            conditions.append(found)
    read, wanted = _parts(conditions, wish), _parts(wish.conditions, wish)
    problems += [f"the words demand {part}, and no condition does" for part in sorted(read - wanted)]
    problems += [f"a condition demands {part}, and the words do not" for part in sorted(wanted - read)]
    return tuple(problems)


def _condition_of(demand: Demand, wish: Wish, scene: SceneKinds) -> Condition | str:
    """Return the demand about groups of the wish, or its words if no group fits its nouns."""
    parts: dict[str, Condition] = {}
    for name in ("otherwise", "provided"):
        other = getattr(demand, name)
        if other is not None:
            found = _condition_of(other, wish, scene)
            if isinstance(found, str):
                return found
            parts[name] = found
    things = _label_of(demand.thing, demand.where, wish, scene)
    place = _label_of(demand.place, "", wish, scene) if demand.place else ""
    sentence = f"{demand.predicate.value} of {demand.thing}{f' at {demand.place}' if demand.place else ''}"
    if not things or (demand.place and not place):
        return sentence
    try:
        return Condition(
            predicate=demand.predicate,
            things=things,
            place=place,
            quantity=demand.quantity,
            count=demand.count if demand.quantity in COUNTED else 0,
            holds=demand.holds,
            otherwise=parts.get("otherwise"),
            provided=parts.get("provided"),
        )
    except ValidationError:
        return sentence


def _label_of(noun: str, where: str, wish: Wish, scene: SceneKinds) -> str:
    """Return the group that the noun and the place fit, preferably one that a condition is about; "" for none."""
    named = [group for group in wish.objects if _is_named(noun, group)]
    placed = [group for group in named if where and _is_at(group, where, wish, scene)]
    found = sorted(placed or named, key=lambda group: group.label not in wish.wanted)
    return found[0].label if found else ""


def _is_named(noun: str, group: WishedObjects) -> bool:
    words = noun.lower().replace("_", " ").strip()
    return fits(words, group.kind) or any(
        fits(mention.noun, group.kind) for mention in mentions_in(tokens_of(words))
    )


def _is_at(group: WishedObjects, where: str, wish: Wish, scene: SceneKinds) -> bool:
    host = wish.groups.get(group.host)
    if host is not None and _is_named(where, host):
        return True
    return scene.room_called(where) == wish.room_of(group.label)


def _parts(conditions: tuple[Condition, ...] | list[Condition], wish: Wish) -> frozenset[str]:
    """Return the conjuncts of the conditions' goal as text, in a normal form."""
    if not conditions:
        return frozenset()
    members = {
        group.label: tuple(f"{group.label}_{number}" for number in range(1, group.count + 1))
        for group in wish.objects
    }
    types = {label: label for label, names in members.items() if len(names) > 1}
    goal = map_atoms(goal_of(conditions, members, types), _cleaned)
    return frozenset(render(part) for part in _conjuncts(_sorted(goal)))


def _cleaned(atom: Atom) -> Formula:
    """Return dust as a stain: people clean both away with the same words."""
    return replace(atom, predicate=WishPredicate.STAINED) if atom.predicate == WishPredicate.DUSTY else atom


def _conjuncts(formula: Formula) -> Iterator[Formula]:
    if isinstance(formula, And):
        for part in formula.parts:
            yield from _conjuncts(part)
    else:
        yield formula


def _sorted(formula: Formula) -> Formula:
    """Return the formula with the parts of each conjunction and disjunction in order."""
    match formula:
        case And(parts) | Or(parts):
            ordered = tuple(sorted(map(_sorted, parts), key=render))
            return type(formula)(ordered)
        case Not(body):
            return Not(_sorted(body))
        case Imply(premise, conclusion):
            return Imply(_sorted(premise), _sorted(conclusion))
        case Quantified():
            return replace(formula, body=_sorted(formula.body))
        case _:
            return formula
