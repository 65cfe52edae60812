"""Role-Playing Agent, offline: a seeded cast for a scene that covers every room, with a day for everyone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol

from embomatrix.factory.social.milieus import HOBBIES, NAMES, milieu_of
from embomatrix.factory.social.occasions import ELSEWHERE, occasions_in
from embomatrix.factory.social.values import Cast, DaySlot, Person

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np

    from embomatrix.factory.social.milieus import Milieu, SocialRole
    from embomatrix.factory.social.occasions import Occasion
    from embomatrix.world.scene import Room, Scene

SLOTS_EACH: Final = 5
"""Things that a person does on the day, at least; every room sees somebody besides."""


class RolePlayingAgent(Protocol):
    """Makes up the people of a scene."""

    def cast(self, scene: Scene, rng: np.random.Generator) -> Cast: ...


class GrammarRolePlayer:
    """Draws roles of the scene's milieu. The generator decides all."""

    def cast(self, scene: Scene, rng: np.random.Generator) -> Cast:
        """Two to five people; every room of the scene is somebody's, or somebody is there on this day."""
        milieu = milieu_of(scene.base)
        count = int(rng.integers(2, min(5, len(milieu.roles)) + 1))
        others = rng.permutation(len(milieu.roles) - 1)[: count - 1]
        roles = [milieu.roles[0], *(milieu.roles[1 + int(at)] for at in sorted(others))]
        names = [str(name) for name in rng.permutation(NAMES)[:count]]
        hobbies = [str(hobby) for hobby in rng.permutation(HOBBIES)[:count]]
        people: list[Person] = []
        for role, name, hobby in zip(roles, names, hobbies, strict=True):
            people.append(_person(role, name, hobby, people[0] if people else None, scene.rooms, rng))
        people[0] = people[0].model_copy(
            update={"ties": {name: role.back for role, name in zip(roles[1:], names[1:], strict=True)}}
        )
        ties = {role.tie for role in roles[1:]}
        told = [each.words for each in milieu.households if each.ties <= ties][:1] or milieu.setting
        setting = told[int(rng.integers(len(told)))]
        return Cast(setting=setting, people=tuple(people), day=_day(people, scene.rooms, milieu, rng))


def _person(
    role: SocialRole,
    name: str,
    hobby: str,
    first: Person | None,
    rooms: Sequence[Room],
    rng: np.random.Generator,
) -> Person:
    low, high = role.age
    if first is not None and role.apart > 0:
        low = max(low, first.age + role.apart)
    elif first is not None and role.apart < 0:
        high = min(high, first.age + role.apart)
    return Person(
        name=name,
        age=int(rng.integers(low, high + 1)),
        job=role.job[int(rng.integers(len(role.job)))],
        hobby=hobby,
        rooms=tuple(room.name for room in rooms if room.type in role.rooms),
        ties={} if first is None else {first.name: role.tie},
    )


def _day(
    people: Sequence[Person], rooms: Sequence[Room], milieu: Milieu, rng: np.random.Generator
) -> tuple[DaySlot, ...]:
    """Everyone's own rooms first; then somebody for all else that is done in each room, and for rooms that nobody came to."""
    types = {room.name: _done_in(room.type, milieu) for room in rooms}
    slots = []
    for person in people:
        own = person.rooms or tuple(types)
        for _ in range(SLOTS_EACH):
            slots.append(_slot(person, own[int(rng.integers(len(own)))], types, rng))
    for room, done in types.items():
        for occasion in done:
            able = [person for person in people if occasion.suits(person)]
            owners = [person for person in able if room in person.rooms] or able
            if owners and (room, occasion.doing) not in {(slot.room, slot.activity) for slot in slots}:
                slots.append(_at(occasion, owners[int(rng.integers(len(owners)))], room, rng))
        if not any(slot.room == room for slot in slots):
            slots.append(_slot(people[int(rng.integers(len(people)))], room, types, rng))
    return tuple(sorted(dict.fromkeys(slots), key=lambda slot: (slot.time, slot.person, slot.room)))


def _done_in(room_type: str, milieu: Milieu) -> tuple[Occasion, ...]:
    """What is done in such a room of such a place."""
    return tuple(each for each in occasions_in(room_type) if milieu.lived_in or not each.private)


def _slot(
    person: Person, room: str, types: Mapping[str, tuple[Occasion, ...]], rng: np.random.Generator
) -> DaySlot:
    """Something that such a person does there; who does nothing of what the room is for passes through."""
    options = [each for each in types[room] if each.suits(person)] or occasions_in(ELSEWHERE)
    return _at(options[int(rng.integers(len(options)))], person, room, rng)


def _at(occasion: Occasion, person: Person, room: str, rng: np.random.Generator) -> DaySlot:
    """The occasion in its hour."""
    minute = 15 * int(rng.integers(4))
    return DaySlot(
        time=f"{occasion.hour:02d}:{minute:02d}", person=person.name, room=room, activity=occasion.doing
    )
