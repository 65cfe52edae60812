"""Kinds of objects in a scene, room by room: the description that language models and rules read.

Object names of the scene never appear in it, so that no model can copy one into an instruction.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Self

from embomatrix.factory.language.nouns import everyday_noun
from embomatrix.factory.scenes.view import SceneView
from embomatrix.world.asset import FLOOR_CATEGORY
from embomatrix.world.bddl import is_room_instance


@dataclass(frozen=True, slots=True, order=True)
class KindInRoom:
    """Alike objects of one room. ``host`` is the kind of furniture that they rest on; "" for furniture itself."""

    room: str
    kind: str
    count: int = 1
    host: str = ""
    is_open: bool = False
    is_on: bool = False

    def in_words(self, name: str) -> str:
        """Return the count, this name and the unusual states."""
        states = [*["open"] * self.is_open, *["on"] * self.is_on]
        counted = name if self.count == 1 else f"{self.count} x {name}"
        return f"{counted} ({', '.join(states)})" if states else counted


@dataclass(frozen=True)
class SceneKinds:
    """Rooms of a base scene with the kinds of objects in them. ``rooms`` maps names to types."""

    base: str
    rooms: Mapping[str, str]
    kinds: tuple[KindInRoom, ...]
    sights: Mapping[str, str]
    """Appearance of rooms in words, if a vision model described them."""

    def alike(self, kind: str, room: str = "") -> tuple[KindInRoom, ...]:
        """Return the entries of a kind in a room, or in all rooms."""
        return tuple(each for each in self.kinds if each.kind == kind and room in ("", each.room))

    def room_called(self, words: str) -> str:
        """Return the room with this name, or the only room of this type; otherwise the words themselves."""
        name = words.strip().lower().replace(" ", "_").removeprefix("the_")
        found = [room for room, kind in self.rooms.items() if kind == name]
        return found[0] if name not in self.rooms and len(found) == 1 else name

    def with_sights(self, sights: Mapping[str, str]) -> Self:
        """Return the description with the appearance of rooms."""
        return replace(self, sights=sights)

    def within(self, rooms: Iterable[str]) -> Self:
        """Return the description of these rooms alone."""
        wanted = frozenset(rooms)
        types = {room: kind for room, kind in self.rooms.items() if room in wanted}
        return replace(self, rooms=types, kinds=tuple(each for each in self.kinds if each.room in wanted))

    def listed(self) -> str:
        """Return one line for each room with the catalog's names, for answers that must use them, and everyday words."""
        return self._lines(_with_noun, lambda room: room)

    def told(self) -> str:
        """Return one line for each room in everyday words, for people's dialogues."""
        return self._lines(everyday_noun, lambda room: room.replace("_", " "))

    def _lines(self, name_of: Callable[[str], str], room_of: Callable[[str], str]) -> str:
        lines = []
        for room in self.rooms:
            mine = [each for each in self.kinds if each.room == room]
            names = [each.in_words(name_of(each.kind)) for each in mine if not each.host]
            names += [
                f"{each.in_words(name_of(each.kind))} on {name_of(each.host)}" for each in mine if each.host
            ]
            sight = f" {self.sights[room]}" if self.sights.get(room) else ""
            lines.append(f"{room_of(room)}:{sight} {', '.join(names) or 'empty'}")
        return "\n".join(lines)


def _with_noun(kind: str) -> str:
    """Return the name of a kind, with its everyday noun in quotes if people call it otherwise."""
    noun = everyday_noun(kind)
    return kind if noun == kind.replace("_", " ") else f'{kind} "{noun}"'


def kinds_of(view: SceneView, rooms: Iterable[str] | None = None) -> SceneKinds:
    """Return the kinds in the given rooms of a scene, or in all rooms. Decoration that no task can use is left out."""
    wanted = set(rooms) if rooms is not None else {room.name for room in view.scene.rooms}
    counts: Counter[KindInRoom] = Counter()
    for room in sorted(wanted):
        for name in view.in_room.get(room, ()):
            if view.category(name) != FLOOR_CATEGORY and _is_useful(view, name):
                counts[_entry(view, name)] += 1
    types = {room.name: _type_of(room.name, room.type) for room in view.scene.rooms if room.name in wanted}
    kinds = tuple(sorted(replace(each, count=count) for each, count in counts.items()))
    return SceneKinds(view.scene.base, types, kinds, {})


def _type_of(name: str, kind: str) -> str:
    return kind or (name.rpartition("_")[0] if is_room_instance(name) else name)


def _entry(view: SceneView, name: str) -> KindInRoom:
    host = view.item(name).host if view.is_portable(name) else ""
    return KindInRoom(
        view.room(name),
        view.category(name),
        host=view.category(host) if host else "",
        is_open=view.is_openable(name) and view.is_open(name),
        is_on=view.is_toggleable(name) and view.is_on(name),
    )


def _is_useful(view: SceneView, name: str) -> bool:
    uses = (view.is_portable, view.is_surface, view.is_container, view.is_openable, view.is_switchable)
    return any(use(name) for use in uses)
