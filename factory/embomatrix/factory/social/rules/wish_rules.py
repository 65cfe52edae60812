"""Rules about a wish: kinds and rooms exist, the robot can bring the conditions about, and they do not hold already."""

from collections.abc import Iterator
from itertools import combinations
from typing import Final

from embomatrix.factory.social.rules.faults import Fault, FaultKind
from embomatrix.factory.social.rules.kinds import KindAbilities, abilities_of, can_become, effects_of
from embomatrix.factory.social.scene_kinds import SceneKinds
from embomatrix.factory.social.wish import (
    COUNTED,
    FLOOR,
    PLACED,
    THERMAL,
    Condition,
    Quantity,
    Wish,
    WishedObjects,
    WishPredicate,
)
from embomatrix.world.catalog import Catalog, CatalogError
from embomatrix.world.state import Relation, State

MAX_MOVABLE: Final = 16
"""Maximum number of objects that a scene is furnished with for one wish."""
_ONLY_TRUE: Final = frozenset((*THERMAL, WishPredicate.SLICED, WishPredicate.SOAKED))
_ONLY_FALSE: Final = frozenset({WishPredicate.DUSTY, WishPredicate.STAINED})


def wish_faults(wish: Wish, scene: SceneKinds) -> tuple[Fault, ...]:
    """Return the broken rules of a wish about a scene; kinds and rooms first, since the others depend on them."""
    unknown = (*_unknown(wish, scene), *_too_many(wish, scene))
    if unknown:
        return unknown
    parts = [part for condition in wish.conditions for part in condition.parts()]
    return (
        *(fault for group in wish.objects for fault in _start_faults(group, wish)),
        *(fault for part in parts for fault in _impossible(part, wish)),
        *(fault for condition in wish.conditions for fault in _held(condition, wish, scene)),
        *_contradictions(wish),
    )


def is_negative(condition: Condition) -> bool:
    """True if the condition demands that its predicate does not hold."""
    return condition.holds is (condition.quantity is Quantity.NONE)


def _unknown(wish: Wish, scene: SceneKinds) -> Iterator[Fault]:
    for group in wish.objects:
        if group.kind != FLOOR:
            try:
                Catalog.load().category(group.kind)
            except CatalogError as error:
                yield Fault(FaultKind.UNKNOWN_KIND, f"{group.label}: {error.args[0]}")
        if not group.host and group.room not in scene.rooms:
            rooms = ", ".join(scene.rooms)
            yield Fault(FaultKind.UNKNOWN_ROOM, f"{group.label} is in {group.room!r}: the rooms are {rooms}")


def _too_many(wish: Wish, scene: SceneKinds) -> Iterator[Fault]:
    movable = sum(group.count for group in wish.objects if not group.furniture and group.kind != FLOOR)
    if movable > MAX_MOVABLE:
        yield Fault(FaultKind.TOO_MANY, f"the wish has {movable} objects: use at most {MAX_MOVABLE}")
    for group in wish.objects:
        room = wish.room_of(group.label)
        there = sum(each.count for each in scene.alike(group.kind, room))
        if group.furniture and group.count > max(1, there):
            yield Fault(
                FaultKind.TOO_MANY,
                f"{group.label}: {room} has {there} of {group.kind}, the wish takes {group.count}",
            )


def _start_faults(group: WishedObjects, wish: Wish) -> Iterator[Fault]:
    able = _abilities(group)
    if able is None:
        return
    if not group.furniture and not able.is_portable:
        yield Fault(
            FaultKind.NOT_PORTABLE,
            f"{group.label}: a {group.kind} can't be carried: set furniture to true if the room has one, or choose "
            "something smaller",
        )
    if group.relation is not None:
        yield from _hosting(group, WishPredicate(group.relation.value), wish.groups[group.host])
    if State.OPEN in group.states and not able.is_openable:
        yield Fault(FaultKind.IMPOSSIBLE_STATE, f"{group.label}: a {group.kind} has no door, drawer or lid")
    if State.TOGGLED_ON in group.states and not able.is_switchable:
        yield Fault(FaultKind.IMPOSSIBLE_STATE, f"{group.label}: a {group.kind} has no switch")


def _impossible(part: Condition, wish: Wish) -> Iterator[Fault]:
    things = wish.groups[part.things]
    able = _abilities(things)
    if able is None:
        yield Fault(FaultKind.IMPOSSIBLE_STATE, "a floor can only be a place")
    elif part.predicate in PLACED:
        if not able.is_portable or things.furniture:
            yield Fault(FaultKind.NOT_PORTABLE, f"{things.label}: a {things.kind} can't be carried anywhere")
        elif not is_negative(part):
            yield from _hosting(things, part.predicate, wish.groups[part.place])
    else:
        yield from _impossible_state(part, things, able, wish)


def _impossible_state(
    part: Condition, things: WishedObjects, able: KindAbilities, wish: Wish
) -> Iterator[Fault]:
    predicate, kind, negative = part.predicate, things.kind, is_negative(part)
    if (predicate in _ONLY_TRUE and negative) or (predicate in _ONLY_FALSE and not negative):
        wrong = f"not {predicate.value}" if negative else predicate.value
        yield Fault(FaultKind.IMPOSSIBLE_STATE, f"{things.label}: no skill makes anything {wrong}")
    elif predicate is WishPredicate.OPEN and not able.is_openable:
        yield Fault(FaultKind.IMPOSSIBLE_STATE, f"{things.label}: a {kind} has no door, drawer or lid")
    elif predicate is WishPredicate.TOGGLED_ON and not able.is_switchable:
        yield Fault(FaultKind.IMPOSSIBLE_STATE, f"{things.label}: a {kind} has no switch")
    elif predicate is WishPredicate.SLICED and not able.is_sliceable:
        yield Fault(FaultKind.IMPOSSIBLE_STATE, f"{things.label}: a {kind} can't be cut")
    elif predicate in THERMAL:
        state = State(predicate.value)
        # The paper's robot cooks, heats and freezes food; warm ovens and icy cupboards are no request.
        if things.furniture or not can_become(kind, State.COOKED):
            yield Fault(
                FaultKind.IMPOSSIBLE_STATE, f"{things.label}: a {kind} is no food to be {state.value}"
            )
        elif part.place and state not in effects_of(wish.groups[part.place].kind, kind):
            source = wish.groups[part.place].kind
            yield Fault(FaultKind.IMPOSSIBLE_STATE, f"{source} does not make {kind} {state.value}")


def _hosting(guest: WishedObjects, predicate: WishPredicate, host: WishedObjects) -> Iterator[Fault]:
    """Yield a fault if the host has no surface or cavity for the guest."""
    if predicate not in (WishPredicate.ONTOP, WishPredicate.INSIDE):
        return
    inside = predicate is WishPredicate.INSIDE
    able, small = _abilities(host), _abilities(guest)
    if able is None or small is None:
        if inside:
            yield Fault(FaultKind.NO_HOST, f"{host.label}: a floor holds nothing inside")
        return
    if host.label == guest.label or not able.takes(small, inside=inside):
        room = "inside" if inside else "on top"
        yield Fault(
            FaultKind.NO_HOST,
            f"{host.label}: a {host.kind} has no room for a {guest.kind} {room}: choose another place",
        )


def _held(condition: Condition, wish: Wish, scene: SceneKinds) -> Iterator[Fault]:
    if condition.otherwise is not None or condition.provided is not None:
        return
    if condition.quantity in COUNTED:
        return
    if _holds_at_start(condition, wish, scene) is not is_negative(condition):
        things = wish.groups[condition.things]
        yield Fault(
            FaultKind.HOLDS_AT_START,
            f"{condition.predicate.value} of {things.label} is as demanded at the start: demand a change, or let the "
            "objects start otherwise (relation, host, states)",
        )


def _holds_at_start(condition: Condition, wish: Wish, scene: SceneKinds) -> bool:
    things = wish.groups[condition.things]
    if condition.predicate in PLACED:
        return things.host == condition.place and things.relation is Relation(condition.predicate.value)
    state = State(condition.predicate.value)
    if state in things.states:
        return True
    there = scene.alike(things.kind, things.room) if things.furniture and not things.states else ()
    if state is State.OPEN:
        return bool(there) and all(each.is_open for each in there)
    return state is State.TOGGLED_ON and bool(there) and all(each.is_on for each in there)


def _contradictions(wish: Wish) -> Iterator[Fault]:
    for first, second in combinations(wish.conditions, 2):
        if first == second:
            yield Fault(FaultKind.CONTRADICTION, "two conditions are equal: leave one out")
        elif first.things == second.things and _excludes(first, second):
            both = f"{first.predicate.value} and {second.predicate.value} of {first.things}"
            yield Fault(FaultKind.CONTRADICTION, f"{both} can't both hold: leave one of them out")


def _excludes(first: Condition, second: Condition) -> bool:
    """True if no object can meet both conditions on the same group."""
    if any(each.quantity in (Quantity.ANY, *COUNTED) for each in (first, second)):
        return False
    if any(each.otherwise or each.provided for each in (first, second)):
        return False
    negative = is_negative(first), is_negative(second)
    if first.predicate is second.predicate and first.place == second.place:
        return negative[0] is not negative[1]
    if any(negative):
        return False
    hosted = {WishPredicate.ONTOP, WishPredicate.INSIDE}
    if first.predicate in hosted and second.predicate in hosted:
        return True
    return WishPredicate.FROZEN in (first.predicate, second.predicate) and bool(
        {first.predicate, second.predicate} & {WishPredicate.HOT, WishPredicate.COOKED}
    )


def _abilities(group: WishedObjects) -> KindAbilities | None:
    """Return the abilities of the group's kind, None for a floor."""
    return None if group.kind == FLOOR else abilities_of(group.kind)
