"""Who has a place in a room and who waits for one, and what makes way for those that wait.

What was placed is exchanged for its next model, put down elsewhere, or exchanged for a narrower one; what the task does not
need is taken away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.factory.furnish.roles import FurnitureRole, role_of
from embomatrix.factory.layout.request import placement_class_of
from embomatrix.factory.layout.values import LayoutFailure, LayoutRelation, PlacementClass
from embomatrix.factory.scenes.editor import LayoutReason
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.factory.layout.request import RequestedObject
    from embomatrix.factory.scenes.editor import SceneEditor
    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import Pose

MAX_REMOVALS: Final = 3
"""Things of the base scene that are taken away from a full host, for what the task puts there."""
MAX_MOVES: Final = 2
"""Times that a thing is put elsewhere because the robot does not get at what is on or in it."""
MAX_UNREACHED: Final = 2
"""After so many places at which the robot does not get at a thing, one is taken as it is: verification tells."""
FLOOR_CONTACT_M: Final = 0.05
"""What begins below this stands on the floor."""
MOVABLE: Final = frozenset(
    {
        FurnitureRole.SEAT,
        FurnitureRole.LOW_TABLE,
        FurnitureRole.TABLE,
        FurnitureRole.CORNER,
        FurnitureRole.BACKED,
        FurnitureRole.OPEN,
    }
)
PLUMBED: Final = frozenset({"toilet", "urinal", "pedestal_sink"})
"""Furniture of these roles people would carry out of a room to make place for other, but for what a bathroom needs."""
FULL: Final = frozenset({LayoutReason.NO_FREE_SPOT, LayoutReason.TOO_LARGE})
CROWDED: Final = frozenset({LayoutReason.NO_FREE_SPOT, LayoutReason.BARS_THE_WAY})
FAR: Final = frozenset({LayoutReason.OUT_OF_REACH, LayoutReason.NOT_AT_HAND})


@dataclass(frozen=True, slots=True)
class Support:
    """What a thing was put on, in, under or next to, in the scene's names; without a relation, the floor of a room."""

    relation: Relation | None
    host: str


@dataclass(slots=True)
class PendingObject:
    """An item, which of its models is tried, where it is, and why it had no place before."""

    item: RequestedObject
    asset: Asset
    choice: int = 0
    cleared: int = 0
    moved: int = 0
    unreached: int = 0
    crowded: bool = False
    support: Support | None = None
    last_failure: LayoutFailure | None = None

    def choose(self, choice: int) -> None:
        """Try another of its models."""
        self.choice, self.asset = choice, self.item.asset(choice)

    def narrowest(self, first: int) -> int:
        """Which of its models from the ``first`` on takes the least room."""
        return min(
            range(first, len(self.item.models)),
            key=lambda choice: math.prod(self.item.asset(choice).size_m[:2]),
        )

    @property
    def accepts_unreachable(self) -> bool:
        """Whether it is to be taken as it is, though the robot does not get at it."""
        return self.unreached >= MAX_UNREACHED

    def failure(self, room: str) -> LayoutFailure:
        """Why it found no place in a room."""
        if self.last_failure is not None:
            return self.last_failure
        size = " x ".join(f"{extent:.2f}" for extent in self.asset.size_m)
        detail = (
            f"nothing in {room} takes {self.asset.asset_id}, {size} m: try another room or a smaller model"
        )
        return self.item.failure(self.item.host or room, LayoutReason.NO_HOST, detail)


class PendingObjects:
    """The items of one room: ``waiting`` and ``placed`` by name, ``names`` of the placed in the scene, what failed so far."""

    def __init__(self, editor: SceneEditor, room: str, items: Sequence[RequestedObject]) -> None:
        self.names: dict[str, str] = {}
        self.waiting = {item.name: PendingObject(item, item.asset(0)) for item in items}
        self.placed: dict[str, PendingObject] = {}
        self.failures: list[LayoutFailure] = []
        self.abandoned: list[LayoutFailure] = []
        self._editor = editor
        self._room = room
        self._may_block = False

    def items_by_scene_name(self) -> dict[str, str]:
        """Placed items by their names in the scene."""
        return {there: name for name, there in self.names.items()}

    def place(self, name: str, pose: Pose, rests: tuple[Relation | None, str], at: Support) -> str:
        """Put a waiting item into the scene at a pose, and return its name there. ``rests`` is what it is on or in."""
        pending = self.placed[name] = self.waiting.pop(name)
        pending.support = at
        self.names[name] = self._editor.insert(pending.asset, pose, *rests, self._room)
        return self.names[name]

    def record_failure(
        self, name: str, relation: LayoutRelation, host: str, reason: LayoutReason, detail: str
    ) -> None:
        """Keep why a waiting item can't be at a host."""
        failure = LayoutFailure(name, relation, host, reason, detail)
        pending = self.waiting[name]
        pending.last_failure = failure
        pending.crowded |= reason in CROWDED
        self.failures.append(failure)

    def withdraw(self, name: str, reason: LayoutReason, detail: str) -> None:
        """Take a placed item out again, with all that rests on it, and keep why it can't be there."""
        item, seat = self._editor.known(self.names[name]), self.placed[name].support
        if seat is not None and seat.relation is Relation.UNDER:
            relation, host = LayoutRelation.UNDER, seat.host
        else:
            relation = LayoutRelation(item.relation.value) if item.relation else LayoutRelation.ONTOP
            host = item.host or self._room
        self._remove(name)
        self.record_failure(name, relation, host, reason, detail)

    def next_model(self, name: str) -> None:
        """Try an item with its next model, as if nothing had been tried; give it up after the last, if nothing makes way."""
        pending = self.waiting[name]
        if pending.choice + 1 < len(pending.item.models):
            pending.choose(pending.choice + 1)
            self._forget((name,))
        elif self.waiting.keys() & {pending.item.host, *pending.item.beside}:
            return  # what it is to stand at has no place yet
        elif not any(way(pending) for way in (self.replace_host, self._shrink_sibling, self._allow_blocking, self._remove_spare)):
            del self.waiting[name]
            self.abandoned.append(pending.failure(self._room))

    def replace_host(self, pending: PendingObject) -> bool:
        """Exchange what an item is to be at for its next model, or put it elsewhere; False where it is not of the task."""
        host = self.placed.get(pending.item.host)
        if host is None:
            return False
        if host.choice + 1 < len(host.item.models):
            self._replace_host_model(host)
            return True
        if pending.last_failure is None or pending.last_failure.reason not in FAR or host.moved == MAX_MOVES:
            return False
        host.moved += 1
        detail = f"the robot gets at nothing {pending.last_failure.relation.value} it there"
        self.withdraw(host.item.name, LayoutReason.NOT_AT_HAND, detail)
        self._restart_others(host)
        return True

    def _replace_host_model(self, host: PendingObject) -> None:
        self._remove(host.item.name)
        self._restart_others(host)
        self.next_model(host.item.name)

    def _restart_others(self, host: PendingObject) -> None:
        """All that waits but one is tried with its first model, as if nothing had been tried."""
        others = [name for name in self.waiting if name != host.item.name]
        for name in others:
            self.waiting[name].choose(0)
        self._forget(others)

    def _shrink_sibling(self, pending: PendingObject) -> bool:
        """Exchange the widest other thing at a full host that the task demands for the narrowest model; False without one."""
        if pending.last_failure is None or pending.last_failure.reason not in FULL or not pending.item.host:
            return False
        others = [
            other
            for other in self.placed.values()
            if (other.item.host, other.item.relation) == (pending.item.host, pending.item.relation)
            and other.choice + 1 < len(other.item.models)
        ]
        if not others:
            return False
        widest = max(others, key=lambda other: math.prod(other.asset.size_m[:2]))
        self._remove(widest.item.name)
        widest.choose(widest.narrowest(widest.choice + 1))
        pending.choose(0)
        self._forget((pending.item.name, widest.item.name))
        return True

    def clear_floor(self, pending: PendingObject) -> bool:
        """Take the largest spare piece of furniture off a floor where the robot does not get at an item; False without one."""
        if not self._is_on_floor(pending):
            return False
        pending.crowded = True
        return self._remove_spare(pending)

    def _remove_spare(self, pending: PendingObject) -> bool:
        """Take the largest spare thing from a full host that the task demands, or from a full floor; False without one."""
        host = self.names.get(pending.item.host, pending.item.host)
        if not pending.crowded or pending.cleared == MAX_REMOVALS:
            return False
        spare = self._removable_furniture() if self._is_on_floor(pending) else self._loose_on(host) if host else []
        if not spare:
            return False
        self._editor.remove(max(spare, key=lambda name: math.prod(self._editor.box_of(name).size_m)))
        pending.cleared += 1
        self._restart(pending)
        return True

    def _is_on_floor(self, pending: PendingObject) -> bool:
        """Whether an item is to stand on the room's floor."""
        host = pending.item.host
        return host in self._editor.rooms or (
            not host and placement_class_of(pending.asset) is PlacementClass.FURNITURE
        )

    def _loose_on(self, host: str) -> list[str]:
        """Loose objects at a host that the task is not about."""
        editor = self._editor
        return [
            name
            for name, item in editor.objects.items()
            if item.host == host and not item.fixed and editor.is_spare(name)
        ]

    def _removable_furniture(self) -> list[str]:
        """What stands on the room's floor, with nothing on or over it that the task is about, and is not built in."""
        editor = self._editor
        return [
            name
            for name, item in editor.objects.items()
            if item.room == self._room
            and not item.host
            and editor.is_spare(name)
            and editor.box_of(name).low_m[2] < FLOOR_CONTACT_M
            and _is_movable(editor.asset_of(name))
        ]

    def _allow_blocking(self, pending: PendingObject) -> bool:
        """Let what must stand on a narrow floor bar the robot's way to what the task is not about; False once it may."""
        if pending.last_failure is None or pending.last_failure.reason is not LayoutReason.BARS_THE_WAY or self._may_block:
            return False
        self._may_block = True
        editor = self._editor
        editor.given_up.update(
            name for name, item in editor.objects.items() if item.room == self._room and editor.is_spare(name)
        )
        self._restart(pending)
        return True

    def _restart(self, pending: PendingObject) -> None:
        """With its first model, as if nothing had been tried."""
        pending.choose(0)
        pending.crowded = False
        self._forget((pending.item.name,))

    def _remove(self, name: str) -> None:
        """Remove an item from the scene, with all that rests on it: they wait again."""
        items_by_scene_name = self.items_by_scene_name()
        for gone in self._editor.remove(self.names[name]):
            owner = items_by_scene_name[gone]
            del self.names[owner]
            self.waiting[owner] = self.placed.pop(owner)

    def _forget(self, names: Sequence[str]) -> None:
        self.failures = [failure for failure in self.failures if failure.object_name not in names]


def _is_movable(asset: Asset) -> bool:
    return role_of(asset.category, asset.size_m, asset.mass_kg) in MOVABLE and asset.category not in PLUMBED
