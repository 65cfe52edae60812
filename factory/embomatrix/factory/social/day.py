"""A day in a place: events that happen to its people, the needs that they cause, and the wishes with objects and rooms.

A wish names what the scene has, and may name what it lacks. Decoys of the same kind in other places make descriptions
necessary.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from embomatrix.factory.language.nouns import number_word
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.household import place_of
from embomatrix.factory.social.knowledge import Event, GoalPart, Need, ObjectRole, events
from embomatrix.factory.social.values import Cast, Person
from embomatrix.factory.social.wish import (
    COUNTED,
    FLOOR,
    Condition,
    Wish,
    WishedObjects,
    WishPredicate,
)
from embomatrix.world.catalog import Catalog
from embomatrix.world.state import Relation, State

MAX_MISSING: Final = 1
"""Maximum number of furniture pieces that a wish may demand without the scene having them."""
MAX_MISSING_IN_HALLS: Final = 2
"""Halls are empty: people bring tables for what goes on there."""
NEVER_ADDED: Final = frozenset({"countertop", "bar", "commercial_kitchen_table", "microwave"})
"""Kinds that are not added to a room: furniture built into other furniture, and appliances that stand on other furniture."""
DECOY_SHARE: Final = 0.5
OPEN_SHARE: Final = 0.2
"""Share of doors that stand open at the start."""
UNWANTED_OPEN_SHARE: Final = 0.6
"""Share of doors that stand open at the start if the wish wants them closed."""
WATER_NEEDED: Final = frozenset({WishPredicate.STAINED, WishPredicate.SOAKED})
SINKS: Final = frozenset(
    {"furniture_sink", "drop_in_sink", "pedestal_sink", "commercial_kitchen_sink", "tabletop_sink", "wall_mounted_sink",
     "multi_station_furniture_sink"}
)  # fmt: skip
FITTING_EVENT_WEIGHT: Final = 3
"""Weight of an event that somebody's job or hobby causes, relative to an event that happens to anybody."""


@dataclass(frozen=True, slots=True)
class NeedOfDay:
    """Need of a person on this day, with its wish. ``count`` is the number k of the need; 0 if it has none.

    ``clock`` is the hour, such as 18:30.
    """

    event: Event
    person: Person
    clock: str
    need: Need
    wish: Wish
    count: int

    @property
    def hour(self) -> float:
        """Hours since midnight."""
        hour, minute = map(int, self.clock.split(":"))
        return hour + minute / 60

    @property
    def time(self) -> str:
        """Hour in words: *half past six*."""
        hour, minute = map(int, self.clock.split(":"))
        word = number_word((hour - 1) % 12 + 1)
        return f"half past {word}" if minute else f"{word} o'clock"


def events_for(base: str, cast: Cast) -> list[tuple[Event, Person, int]]:
    """Return the events that can happen to the people of a place, with the person and a weight."""
    place = place_of(base)
    found = []
    for event in events():
        if place not in event.places:
            continue
        for person in cast.people:
            if event.ages[0] <= person.age <= event.ages[1]:
                causes = {person.job, person.job.removeprefix("retired "), person.hobby} & event.of
                if causes or not event.of:
                    found.append((event, person, FITTING_EVENT_WEIGHT if causes else 1))
    return found


def draw_needs(
    view: SceneView,
    cast: Cast,
    most: int,
    each_event: int,
    rng: np.random.Generator,
    weights: Mapping[str, float],
) -> list[NeedOfDay]:
    """Return up to ``most`` needs of one day, at most ``each_event`` of an event.

    ``weights`` make needs likelier by name; one of weight 0 is never drawn.
    """

    def best(event: Event) -> float:
        return max(weights.get(need.name, 1.0) for need in event.needs)

    candidates = [item for item in events_for(view.scene.base, cast) if best(item[0]) > 0]
    agenda = Agenda()
    while candidates and len(agenda.needs) < most:
        likely = np.array([weight * best(event) for event, _, weight in candidates])
        event, person, _ = candidates[int(rng.choice(len(candidates), p=likely / likely.sum()))]
        candidates = [item for item in candidates if item[0] is not event]
        low, high = event.hours
        clock = f"{int(rng.integers(low, high + 1)):02d}:{'30' if rng.random() < 0.4 else '00'}"
        order = _drawn_order(event.needs, weights, rng)
        left = min(each_event, most - len(agenda.needs))
        for need in order:
            wished = wish_of(need, view, rng) if left else None
            if wished is None:
                continue
            told = need if len(wished[0].conditions) == len(need.goal) else replace(need, say=())
            if agenda.add(NeedOfDay(event, person, clock, told, *wished)):
                left -= 1
    return agenda.needs


def _drawn_order(needs: Sequence[Need], weights: Mapping[str, float], rng: np.random.Generator) -> list[Need]:
    """Return the needs in random order, those with larger weights earlier, without those of weight 0."""
    possible = [(need, weight) for need in needs if (weight := weights.get(need.name, 1.0)) > 0]
    keys = [rng.random() ** (1 / weight) for _, weight in possible]
    ordered = sorted(zip(keys, possible, strict=True), key=lambda pair: -pair[0])
    return [need for _, (need, _) in ordered]


def wish_of(need: Need, view: SceneView, rng: np.random.Generator) -> tuple[Wish, int] | None:
    """Return the need as a wish in this scene with its number k; None if the scene lacks rooms or too much furniture."""
    rooms: dict[tuple[str, ...], str] = {}
    groups: dict[str, WishedObjects] = {}
    missing = 0
    for role in need.roles:
        if role.rooms and role.rooms not in rooms:
            room = _room(role, view, rng)
            if not room:
                return None
            rooms[role.rooms] = room
        group, lacks = _group(role, groups, rooms, view, rng)
        groups[role.label] = group
        missing += lacks
        if lacks and group.kind in NEVER_ADDED:
            return None
    is_hall = place_of(view.scene.base) == "hall"
    if missing > (MAX_MISSING_IN_HALLS if is_hall else MAX_MISSING) or not _has_water(
        need, groups, view, rng
    ):
        return None
    groups = _with_doors(need, groups, rng)
    count = _count(need, groups, rng)
    if count is None:
        return None
    parts = [part for part in need.goal if not _needs_no_door(part, groups)]
    if not parts:
        return None
    conditions = tuple(_condition(part, count) for part in parts)
    objects = (*groups.values(), *_decoys(need, groups, view, rng))
    return Wish(objects=objects, conditions=conditions), count


def _condition(part: GoalPart, count: int) -> Condition:
    return Condition(
        predicate=part.predicate,
        things=part.things,
        place=part.place,
        quantity=part.quantity,
        count=count if part.quantity in COUNTED else 0,
        holds=part.holds,
        otherwise=_condition(part.otherwise, count) if part.otherwise is not None else None,
    )


def _needs_no_door(part: GoalPart, groups: Mapping[str, WishedObjects]) -> bool:
    """True for *the bookcase is closed*: furniture without a door."""
    return part.predicate is WishPredicate.OPEN and not _can_open(groups[part.things].kind)


def _room(role: ObjectRole, view: SceneView, rng: np.random.Generator) -> str:
    """Return a room of one of the role's types, preferring rooms with suitable furniture; "" if there is none.

    In halls, whose corridors are narrow, an unfurnished room is the largest one.
    """
    found = [room for room in view.scene.rooms if room.type in role.rooms]
    if place_of(view.scene.base) == "hall":
        found = sorted(found, key=lambda room: -room.size_m[0] * room.size_m[1])[:1]
    rooms = [room.name for room in found]
    furnished = [name for name in rooms if _there(role, name, view)]
    options = furnished or rooms
    return options[int(rng.integers(len(options)))] if options else ""


def _there(role: ObjectRole, room: str, view: SceneView) -> list[str]:
    """Return the kinds of the role that the room has as furniture."""
    present = {view.category(name) for name in view.in_room[room] if view.item(name).fixed}
    return [kind for kind in role.kinds if kind in present or kind == FLOOR]


def _group(
    role: ObjectRole,
    groups: Mapping[str, WishedObjects],
    rooms: Mapping[tuple[str, ...], str],
    view: SceneView,
    rng: np.random.Generator,
) -> tuple[WishedObjects, bool]:
    """Return the role's objects, and whether the scene lacks the furniture."""
    count = int(rng.integers(role.count[0], role.count[1] + 1))
    if not role.rooms:
        kind = role.kinds[int(rng.integers(len(role.kinds)))]
        host = groups[role.host]
        group = WishedObjects(
            label=role.label, kind=kind, count=count, room=host.room, relation=role.relation, host=role.host,
            states=role.states,
        )  # fmt: skip
        return group, False
    room = rooms[role.rooms]
    used = {(group.kind, group.room) for group in groups.values() if group.furniture}
    there = [kind for kind in _there(role, room, view) if (kind, room) not in used]
    options = there or [kind for kind in role.kinds if (kind, room) not in used] or list(role.kinds)
    kind = options[int(rng.integers(len(options)))] if there else options[0]
    group = WishedObjects(label=role.label, kind=kind, room=room, furniture=True, states=role.states)
    return group, not there


def _has_water(
    need: Need, groups: dict[str, WishedObjects], view: SceneView, rng: np.random.Generator
) -> bool:
    """Declare a sink if the need takes water and declares none. Return False if the scene has no sink."""
    if not any(part.predicate in WATER_NEEDED for part in need.goal):
        return True
    if any(group.kind in SINKS for group in groups.values()):
        return True
    sinks = [item.name for item in view.scene.objects if view.category(item.name) in SINKS]
    if not sinks:
        return False
    chosen = sinks[int(rng.integers(len(sinks)))]
    groups["tap"] = WishedObjects(
        label="tap", kind=view.category(chosen), room=view.room(chosen), furniture=True
    )
    return True


def _with_doors(
    need: Need, groups: Mapping[str, WishedObjects], rng: np.random.Generator
) -> dict[str, WishedObjects]:
    """Return the groups with some furniture open at the start, more often if it has to be closed."""
    shut = {part.things for part in need.goal if part.predicate is WishPredicate.OPEN}
    changed = dict(groups)
    for label, group in groups.items():
        is_door = group.furniture and group.kind != FLOOR and _can_open(group.kind)
        share = UNWANTED_OPEN_SHARE if label in shut else OPEN_SHARE
        if is_door and State.OPEN not in group.states and rng.random() < share:
            changed[label] = group.model_copy(update={"states": (*group.states, State.OPEN)})
    return changed


def _can_open(kind: str) -> bool:
    return "openable" in Catalog.load().category(kind).abilities


def _count(need: Need, groups: Mapping[str, WishedObjects], rng: np.random.Generator) -> int | None:
    """Return the number k of the need, less than the number of objects; 0 without one, None if there are too few objects."""
    counted = [groups[part.things].count for part in need.goal if part.quantity in COUNTED]
    if not counted:
        return 0
    if need.count:
        return need.count if need.count < min(counted) else None
    return int(rng.integers(2, min(counted))) if min(counted) > 2 else None


def _decoys(
    need: Need, groups: Mapping[str, WishedObjects], view: SceneView, rng: np.random.Generator
) -> list[WishedObjects]:
    """Return objects of the same kinds on other furniture of the same rooms. No condition is about them."""
    wanted = [groups[part.things] for part in need.goal]
    kinds = [group.kind for group in wanted if not group.furniture]
    busy = {(group.kind, group.room) for group in groups.values()}
    found: list[WishedObjects] = []
    for kind in dict.fromkeys(kinds):
        places = [
            (view.category(name), room)
            for room in sorted({group.room for group in groups.values()})
            for name in view.in_room[room]
            if view.is_surface(name)
            and len(view.alike(name)) == 1
            and (view.category(name), room) not in busy
        ]
        if not places or rng.random() > DECOY_SHARE:
            continue
        host, room = places[int(rng.integers(len(places)))]
        label = f"place{len(found)}"
        found.append(WishedObjects(label=label, kind=host, room=room, furniture=True, decoy=True))
        found.append(
            WishedObjects(
                label=f"other{len(found)}",
                kind=kind,
                room=room,
                relation=Relation.ONTOP,
                host=label,
                decoy=True,
            )
        )
    return found


@dataclass
class Agenda:
    """Needs of a day that agree on the start of the furniture that they share."""

    needs: list[NeedOfDay] = field(default_factory=list)

    def add(self, asked: NeedOfDay) -> bool:
        """Add a need, with shared furniture in the state of earlier needs. Return False if they contradict each other."""
        known = {
            (group.kind, group.room): group.states
            for other in self.needs
            for group in other.wish.objects
            if group.furniture
        }
        about = {condition.things for condition in asked.wish.conditions}
        changed = []
        for group in asked.wish.objects:
            states = known.get((group.kind, group.room), group.states) if group.furniture else group.states
            if states != group.states and group.label in about:
                return False
            changed.append(group.model_copy(update={"states": states}))
        if self._repeats(asked):
            return False
        wish = asked.wish.model_copy(update={"objects": tuple(changed)})
        self.needs.append(replace(asked, wish=wish))
        return True

    def _repeats(self, asked: NeedOfDay) -> bool:
        """True if an earlier need wants something of the same furniture, or moves objects of the same kind."""
        return any(bool(wanted_kinds(other.wish) & wanted_kinds(asked.wish)) for other in self.needs)


def wanted_kinds(wish: Wish) -> set[tuple[str, str]]:
    """Return the kinds of the objects that the conditions change, with their rooms."""
    groups = wish.groups
    things = (groups[condition.things] for condition in wish.conditions)
    return {(group.kind, group.room if group.furniture else "") for group in things}
