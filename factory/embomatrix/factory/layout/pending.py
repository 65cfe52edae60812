"""Requested objects of one room: pending and placed ones, and the fallbacks that make room for pending ones.

A placed object can be replaced by its next model, moved, or replaced by a narrower model. Objects that the task
doesn't need can be removed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from embomatrix.factory.furnish.roles import FurnitureRole, role_of
from embomatrix.factory.layout.request import RequestedObject, placement_class_of
from embomatrix.factory.layout.values import LayoutFailure, LayoutRelation, PlacementClass
from embomatrix.factory.scenes.editor import LayoutReason, SceneEditor
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import Pose
from embomatrix.world.state import Relation

MAX_REMOVALS: Final = 3
"""Maximum number of scene objects removed from a full host for one requested object."""
MAX_MOVES: Final = 2
"""Maximum number of moves of an object whose contents the robot can't reach."""
MAX_UNREACHED: Final = 2
"""Number of unreachable places after which an object is accepted as unreachable. Verification then judges the task."""
FLOOR_CONTACT_M: Final = 0.05
"""Objects whose lower end is below this height stand on the floor."""
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
"""Furniture of these categories is never removed from a room, although its role is movable."""
FULL: Final = frozenset({LayoutReason.NO_FREE_SPOT, LayoutReason.TOO_LARGE})
CROWDED: Final = frozenset({LayoutReason.NO_FREE_SPOT, LayoutReason.BLOCKS_PATH})
FAR: Final = frozenset({LayoutReason.OUT_OF_REACH, LayoutReason.INACCESSIBLE})


@dataclass(frozen=True, slots=True)
class Support:
    """Support of a placed object, in scene names. Without a relation, ``host`` is the room whose floor it stands on."""

    relation: Relation | None
    host: str


@dataclass(slots=True)
class PendingObject:
    """Requested object with its current model, its support once placed, and its last failure."""

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
        """Switch to another model."""
        self.choice, self.asset = choice, self.item.asset(choice)

    def narrowest(self, first: int) -> int:
        """Return the index of the model with the smallest footprint, starting at ``first``."""
        return min(
            range(first, len(self.item.models)),
            key=lambda choice: math.prod(self.item.asset(choice).size_m[:2]),
        )

    @property
    def accepts_unreachable(self) -> bool:
        """True if the object is accepted although the robot can't reach it."""
        return self.unreached >= MAX_UNREACHED

    @property
    def reason(self) -> LayoutReason | None:
        """Reason of the last failure."""
        return self.last_failure.reason if self.last_failure else None

    def failure(self, room: str) -> LayoutFailure:
        """Return the reason for the missing place in a room."""
        if self.last_failure is not None:
            return self.last_failure
        size = " x ".join(f"{extent:.2f}" for extent in self.asset.size_m)
        detail = f"no host in {room} has space for {self.asset.asset_id}, {size} m: try another room or a smaller model"
        return self.item.failure(self.item.host or room, LayoutReason.NO_HOST, detail)


class PendingObjects:
    """Requested objects of one room: ``waiting`` and ``placed`` by name, scene ``names`` of the placed ones, and failures."""

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
        """Names of the placed objects by scene name."""
        return {there: name for name, there in self.names.items()}

    def place(self, name: str, pose: Pose, rests: tuple[Relation | None, str], at: Support) -> str:
        """Insert a waiting object into the scene and return its scene name.

        ``rests`` is the relation and host that support it.
        """
        pending = self.placed[name] = self.waiting.pop(name)
        pending.support = at
        self.names[name] = self._editor.insert(pending.asset, pose, *rests, self._room)
        return self.names[name]

    def record_failure(
        self, name: str, relation: LayoutRelation, host: str, reason: LayoutReason, detail: str
    ) -> None:
        """Record the reason why a waiting object can't be at a host."""
        failure = LayoutFailure(name, relation, host, reason, detail)
        pending = self.waiting[name]
        pending.last_failure = failure
        pending.crowded |= reason in CROWDED
        self.failures.append(failure)

    def withdraw(self, name: str, reason: LayoutReason, detail: str) -> None:
        """Remove a placed object with all objects on it, and record the reason."""
        item, support = self._editor.known(self.names[name]), self.placed[name].support
        if support is not None and support.relation is Relation.UNDER:
            relation, host = LayoutRelation.UNDER, support.host
        else:
            relation = LayoutRelation(item.relation.value) if item.relation else LayoutRelation.ONTOP
            host = item.host or self._room
        self._remove(name)
        self.record_failure(name, relation, host, reason, detail)

    def next_model(self, name: str) -> None:
        """Switch an object to its next model and clear its failures.

        After the last model, try the fallbacks, then abandon it.
        """
        pending = self.waiting[name]
        if pending.choice + 1 < len(pending.item.models):
            pending.choose(pending.choice + 1)
            self._forget((name,))
        elif self.waiting.keys() & {pending.item.host, *pending.item.beside}:
            return  # its host or neighbour has no place yet
        elif not any(
            way(pending)
            for way in (self.replace_host, self._shrink_sibling, self._allow_blocking, self._remove_spare)
        ):
            del self.waiting[name]
            self.abandoned.append(pending.failure(self._room))

    def replace_host(self, pending: PendingObject) -> bool:
        """Switch the object's host to its next model, or move the host. False if the host is not the task's."""
        host = self.placed.get(pending.item.host)
        if host is None:
            return False
        if host.choice + 1 < len(host.item.models):
            self._remove(host.item.name)
            self._restart_others(host)
            self.next_model(host.item.name)
            return True
        if pending.last_failure is None or pending.reason not in FAR or host.moved == MAX_MOVES:
            return False
        host.moved += 1
        detail = f"the robot can't reach objects {pending.last_failure.relation.value} it there"
        self.withdraw(host.item.name, LayoutReason.INACCESSIBLE, detail)
        self._restart_others(host)
        return True

    def _restart_others(self, host: PendingObject) -> None:
        """Reset all other waiting objects to their first model and clear their failures."""
        others = [name for name in self.waiting if name != host.item.name]
        for name in others:
            self.waiting[name].choose(0)
        self._forget(others)

    def _shrink_sibling(self, pending: PendingObject) -> bool:
        """Replace the widest other object at a full host by its narrowest model. Return False if there is none."""
        if pending.reason not in FULL or not pending.item.host:
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
        """Remove the largest spare furniture from a floor on which the object is unreachable. Return False if there is none."""
        if not self._is_on_floor(pending):
            return False
        pending.crowded = True
        return self._remove_spare(pending)

    def _remove_spare(self, pending: PendingObject) -> bool:
        """Remove the largest spare object from a full host or floor. Return False if there is none."""
        host = self.names.get(pending.item.host, pending.item.host)
        if not pending.crowded or pending.cleared == MAX_REMOVALS:
            return False
        spare = (
            self._removable_furniture()
            if self._is_on_floor(pending)
            else self._loose_on(host)
            if host
            else []
        )
        if not spare:
            return False
        self._editor.remove(max(spare, key=lambda name: math.prod(self._editor.box_of(name).size_m)))
        pending.cleared += 1
        self._restart(pending)
        return True

    def _is_on_floor(self, pending: PendingObject) -> bool:
        """True if the object must stand on the room's floor."""
        host = pending.item.host
        return host in self._editor.rooms or (
            not host and placement_class_of(pending.asset) is PlacementClass.FURNITURE
        )

    def _loose_on(self, host: str) -> list[str]:
        """Return loose objects at a host that the task doesn't name."""
        editor = self._editor
        return [
            name
            for name, item in editor.objects.items()
            if item.host == host and not item.fixed and editor.is_spare(name)
        ]

    def _removable_furniture(self) -> list[str]:
        """Return furniture on the room's floor that is movable and supports nothing that the task names."""
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
        """Let a floor object block the path to objects that the task doesn't name. Return False if that is already allowed."""
        if pending.reason is not LayoutReason.BLOCKS_PATH or self._may_block:
            return False
        self._may_block = True
        editor = self._editor
        editor.given_up.update(
            name for name, item in editor.objects.items() if item.room == self._room and editor.is_spare(name)
        )
        self._restart(pending)
        return True

    def _restart(self, pending: PendingObject) -> None:
        """Reset the object to its first model and clear its failures."""
        pending.choose(0)
        pending.crowded = False
        self._forget((pending.item.name,))

    def _remove(self, name: str) -> None:
        """Remove an object and all objects on it from the scene. They become waiting again."""
        items_by_scene_name = self.items_by_scene_name()
        for gone in self._editor.remove(self.names[name]):
            owner = items_by_scene_name[gone]
            del self.names[owner]
            self.waiting[owner] = self.placed.pop(owner)

    def _forget(self, names: Sequence[str]) -> None:
        self.failures = [failure for failure in self.failures if failure.object_name not in names]


def _is_movable(asset: Asset) -> bool:
    return role_of(asset.category, asset.size_m, asset.mass_kg) in MOVABLE and asset.category not in PLUMBED
