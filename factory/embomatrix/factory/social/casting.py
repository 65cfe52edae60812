"""Role-Playing Agent, offline: a seeded cast for a scene that covers every room, with a day for everyone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol

from embomatrix.factory.social.milieus import HOBBIES, NAMES, activities_in, milieu_of
from embomatrix.factory.social.values import Cast, DaySlot, Person

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from embomatrix.factory.social.milieus import Role
    from embomatrix.world.scene import Room, Scene

SLOTS_EACH: Final = 3
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
        people = [
            _person(role, name, hobby, names[0], scene.rooms, rng)
            for role, name, hobby in zip(roles, names, hobbies, strict=True)
        ]
        people[0] = people[0].model_copy(
            update={"ties": {name: role.back for role, name in zip(roles[1:], names[1:], strict=True)}}
        )
        setting = milieu.setting[int(rng.integers(len(milieu.setting)))]
        return Cast(setting=setting, people=tuple(people), day=_day(people, scene.rooms, rng))


def _person(
    role: Role, name: str, hobby: str, first: str, rooms: Sequence[Room], rng: np.random.Generator
) -> Person:
    return Person(
        name=name,
        age=int(rng.integers(role.age[0], role.age[1] + 1)),
        job=role.job[int(rng.integers(len(role.job)))],
        hobby=hobby,
        rooms=tuple(room.name for room in rooms if room.type in role.rooms),
        ties={} if name == first else {first: role.tie},
    )


def _day(people: Sequence[Person], rooms: Sequence[Room], rng: np.random.Generator) -> tuple[DaySlot, ...]:
    """Everyone's own rooms first; then each room that nobody came to gets somebody."""
    types = {room.name: room.type for room in rooms}
    slots = []
    for person in people:
        own = person.rooms or tuple(types)
        for _ in range(SLOTS_EACH):
            slots.append(_slot(person.name, own[int(rng.integers(len(own)))], types, rng))
    for room in types:
        if not any(slot.room == room for slot in slots):
            owners = [person for person in people if room in person.rooms] or list(people)
            slots.append(_slot(owners[int(rng.integers(len(owners)))].name, room, types, rng))
    return tuple(sorted(dict.fromkeys(slots), key=lambda slot: (slot.time, slot.person, slot.room)))


def _slot(person: str, room: str, types: dict[str, str], rng: np.random.Generator) -> DaySlot:
    options = activities_in(types[room])
    hour, activity = options[int(rng.integers(len(options)))]
    minute = 15 * int(rng.integers(4))
    return DaySlot(time=f"{hour:02d}:{minute:02d}", person=person, room=room, activity=activity)
