"""Scene information extraction: description of a scene for a language model, from its inventory."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.writer.words import spoken

MAX_OBJECTS_IN_ROOM: Final = 40
"""Maximum number of objects described per room. Objects that a task can be about come first."""


@dataclass(frozen=True, slots=True)
class ObjectFacts:
    """Facts about one object: name, category, room, support, and possible actions."""

    name: str
    category: str
    room: str
    rests: str
    abilities: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RoomFacts:
    """Room with its floor area in m² and its objects. ``left_out`` objects are not listed."""

    name: str
    type: str
    area_m2: float
    things: tuple[ObjectFacts, ...]
    left_out: int
    sight: str = ""
    """Appearance of the room in words, if a vision model described it."""


@dataclass(frozen=True, slots=True)
class SceneFacts:
    """Facts about a scene. Objects have their scene names."""

    base: str
    rooms: tuple[RoomFacts, ...]

    @property
    def things(self) -> dict[str, ObjectFacts]:
        """Objects by name."""
        return {thing.name: thing for room in self.rooms for thing in room.things}

    def described(self) -> str:
        """Return the description: rooms, and one line per object with name, place and possible actions."""
        return "\n".join(_room_lines(room) for room in self.rooms)


def facts_of(view: SceneView, rooms: Sequence[str]) -> SceneFacts:
    """Return the facts about the given rooms of a scene."""
    found = []
    for room in view.scene.rooms:
        if room.name not in rooms:
            continue
        names = sorted(view.in_room[room.name], key=lambda name: not _abilities(view, name))
        kept = tuple(_thing(view, name) for name in names[:MAX_OBJECTS_IN_ROOM])
        area_m2 = round(room.size_m[0] * room.size_m[1], 2)
        found.append(RoomFacts(room.name, room.type, area_m2, kept, len(names) - len(kept)))
    return SceneFacts(view.scene.base, tuple(found))


def with_sights(facts: SceneFacts, sights: Mapping[str, str]) -> SceneFacts:
    """Return the facts with the appearance of each room."""
    return replace(facts, rooms=tuple(replace(room, sight=sights.get(room.name, "")) for room in facts.rooms))


def _thing(view: SceneView, name: str) -> ObjectFacts:
    return ObjectFacts(
        name, view.category(name), view.room(name), view.whereabouts(name), _abilities(view, name)
    )


def _abilities(view: SceneView, name: str) -> tuple[str, ...]:
    """Return the possible actions of a task on an object, in the words of the goal's predicates."""
    tests = (
        ("can be carried", view.is_portable(name)),
        ("things can be put on it", view.is_surface(name)),
        ("things can be put in it", view.is_container(name) or view.is_basket(name)),
        ("open" if view.is_open(name) else "closed", view.is_openable(name)),
        ("on" if view.is_on(name) else "off", view.is_toggleable(name)),
        ("can be cooked", view.asset(name).can("cookable")),
        ("heats or freezes food", view.is_source(name)),
    )
    return tuple(words for words, holds in tests if holds)


def _room_lines(room: RoomFacts) -> str:
    lines = [f"[{room.name}] {spoken(room.type)}, {room.area_m2:.0f} m²"]
    lines += [f"  {room.sight}"] * bool(room.sight)
    lines += [
        f"- {thing.name} ({spoken(thing.category)}, {thing.rests}): {', '.join(thing.abilities) or 'decoration'}"
        for thing in room.things
    ]
    return "\n".join(lines + ([f"- and {room.left_out} things more"] if room.left_out else []))
