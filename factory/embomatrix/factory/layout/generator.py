"""Multi-level scene generation: a task's objects are laid out in a scene by four agents, one level after the other.

Scene: each thing gets a room. Room: a layout tree tells what it stands on, in or under. Plane: what shares a surface is
arranged together. Object: a continuous pose, free, in reach, at rest. What fails goes back to the room level with its reason.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.layout.distribution import DistributionError
from embomatrix.factory.layout.facts import hosts_in, rooms_of
from embomatrix.factory.layout.hanging import Hanger
from embomatrix.factory.layout.organization import tree_in
from embomatrix.factory.layout.pending import PendingObjects, Support
from embomatrix.factory.layout.planes import brief_for, objects_on, planes_of, pose_at
from embomatrix.factory.layout.request import (
    Layout,
    LayoutAgents,
    LayoutRecord,
    object_brief,
    placement_class_of,
)
from embomatrix.factory.layout.sampling import ObjectSampler
from embomatrix.factory.layout.stability import settle
from embomatrix.factory.layout.values import (
    ConstraintBrief,
    ConstraintKind,
    DistributionBrief,
    LayoutFailure,
    LayoutRelation,
    PlacementClass,
    RoomBrief,
)
from embomatrix.factory.scenes.editor import LayoutReason, PlacementError
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from embomatrix.factory.layout.organization import LayoutTree
    from embomatrix.factory.layout.planes import Plane
    from embomatrix.factory.layout.request import RequestedObject
    from embomatrix.factory.layout.values import ObjectBrief, PlacementConstraint, PlaneSpot
    from embomatrix.factory.scenes.editor import SceneEditor
    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import Pose
    from embomatrix.world.scene import Room

MAX_ROUNDS: Final = 24
"""Trees that are asked for one room at most."""
MAX_ALTERNATIVES: Final = 96
"""Other poses at its host that are looked at for a thing which the robot does not get at."""
MAX_SURFACES: Final = 4
"""Surfaces of one piece of furniture that are arranged; beyond them the sampler looks alone."""
SHIFT_M: Final = 0.008
TURN_RAD: Final = 0.15
"""How far a thing that nothing aligns is moved off the grid, and turned: people don't put objects down on a raster."""
MIN_PACKED: Final = 2
"""So many objects that one basket or box must take are packed from a corner on, the largest first."""
ALIGNING: Final = frozenset(
    {ConstraintKind.CENTER_ALIGNED, ConstraintKind.FACE_TO, ConstraintKind.NEXT_TO, ConstraintKind.EDGE}
)


def lay(
    editor: SceneEditor, items: Sequence[RequestedObject], seed: int, agents: LayoutAgents | None = None
) -> Layout:
    """Put the items into the scene. What finds no place is left out, with a failure each. Equal arguments, equal layouts.

    Raises LlmError where an agent is a language model that nobody answers for.
    """
    agents = agents or LayoutAgents()
    record = LayoutRecord()
    names: dict[str, str] = {}
    trees: dict[str, LayoutTree] = {}
    try:
        rooms = _distributed(editor, items, seed, agents, record)
    except DistributionError as error:
        failures = [item.failure(item.host, LayoutReason.NO_HOST, str(error)) for item in items]
        return Layout({}, {}, tuple(failures), record)
    left: list[LayoutFailure] = []
    unreachable: list[LayoutFailure] = []
    for number, room in enumerate(dict.fromkeys(rooms.values())):
        mine = [item for item in items if rooms[item.name] == room]
        job = _RoomJob(editor, agents, editor.rooms[room], mine, seed * 1009 + number, record)
        left += job.run()
        names |= job.names
        unreachable += job.unreachable
        trees[room] = job.tree()
    return Layout(names, trees, tuple(left), record, tuple(unreachable))


def _distributed(
    editor: SceneEditor,
    items: Sequence[RequestedObject],
    seed: int,
    agents: LayoutAgents,
    record: LayoutRecord,
) -> dict[str, str]:
    """The room of each item, by name. Raises DistributionError."""
    objects = tuple(_first_look(item) for item in items)
    named = {name for item in items for name in (item.host, *item.beside) if name in editor.objects}
    homes = {name: editor.objects[name].room for name in sorted(named)}
    brief = DistributionBrief(rooms_of(editor), objects, homes, seed)
    answer = agents.distribute(brief)
    record.distribution = (brief, answer)
    return answer.rooms


def _first_look(item: RequestedObject) -> ObjectBrief:
    return object_brief(item, item.asset(0), {})


def _with_carrier(editor: SceneEditor, thing: ObjectBrief) -> ObjectBrief:
    """What must stand beside an object that is there goes where that one stands."""
    other = next((editor.objects[name] for name in thing.beside if name in editor.objects), None)
    if other is None or thing.relation is not None:
        return thing
    inside = other.relation is Relation.INSIDE
    return replace(thing, relation=LayoutRelation.INSIDE if inside else LayoutRelation.ONTOP, host=other.host)


class _RoomJob:
    """The items of one room, tree after tree until each has a place or nothing is left to try."""

    def __init__(
        self,
        editor: SceneEditor,
        agents: LayoutAgents,
        room: Room,
        items: Sequence[RequestedObject],
        seed: int,
        record: LayoutRecord,
    ) -> None:
        self._editor = editor
        self._agents = agents
        self._room = room
        self._seed = seed
        self._round = 0
        self._record = record
        self._rng = np.random.default_rng((seed, 3))
        self._sampler = ObjectSampler(editor, self._rng)
        self._hanger = Hanger(editor, room, self._rng)
        self._pending = PendingObjects(editor, room.name, items)

    @property
    def names(self) -> dict[str, str]:
        """Of the placed items, in the scene."""
        return self._pending.names

    @property
    def unreachable(self) -> list[LayoutFailure]:
        """Placed items that were taken as they are, and what was wrong with their places."""
        return [pending.last_failure for pending in self._pending.placed.values() if pending.accepts_unreachable and pending.last_failure]

    def run(self) -> list[LayoutFailure]:
        """Lay the room out; what is left out."""
        pending_objects = self._pending
        for number in range(MAX_ROUNDS):
            if not pending_objects.waiting:
                if number > 1:
                    self._settle(list(self.names))  # what came last may stand in the way to what came first
                if not pending_objects.waiting:
                    break
            self._round = number
            brief = self._brief()
            tree = self._agents.organize(brief)
            self._record.rooms.append((brief, tree))
            hung = {branch.child for branch in tree.branches()}
            for name in [name for name in pending_objects.waiting if name not in hung]:
                pending_objects.next_model(name)
            before = set(self.names)
            self._realise(tree)
            self._settle([name for name in self.names if name not in before])
        left = [pending.failure(self._room.name) for pending in pending_objects.waiting.values()]
        return [*pending_objects.abandoned, *left]

    def tree(self) -> LayoutTree:
        """How the room's objects hang together in the end, in the scene's names: what was laid, and what that stands on."""
        return tree_in(self._editor.objects.values(), self._room.name, self.names.values())

    def _brief(self) -> RoomBrief:
        objects = tuple(_with_carrier(self._editor, self._thing(name)) for name in self._pending.waiting)
        named = {thing.host for thing in objects if thing.host in self._editor.objects}
        hosts = hosts_in(self._editor, self._room.name, named)
        room = next(room for room in rooms_of(self._editor) if room.name == self._room.name)
        return RoomBrief(room, hosts, objects, tuple(self._pending.failures), self._seed * 31 + self._round)

    def _realise(self, tree: LayoutTree) -> None:
        """Place what the tree says, parents before their children; what stands on one thing together."""
        groups: dict[tuple[str, LayoutRelation], list[str]] = {}
        for branch in tree.branches():
            if branch.child in self._pending.waiting:
                groups.setdefault((branch.parent, branch.relation), []).append(branch.child)
        for (parent, relation), children in groups.items():
            if parent in self._pending.waiting:
                continue  # it found no place itself
            host = self.names.get(parent, parent)
            if relation is LayoutRelation.ONTOP:
                self._onto(host, children)
            elif relation is LayoutRelation.ATTACHED:
                for child in children:
                    self._hang(child)
            elif relation is LayoutRelation.INSIDE and self._is_packed(host, children):
                for child in sorted(children, key=self._volume_m3, reverse=True):
                    self._sample(child, Relation.INSIDE, host, packed=True)
            else:
                for child in children:
                    self._sample(child, Relation(relation.value), host)

    def _is_packed(self, host: str, children: Sequence[str]) -> bool:
        """Baskets and boxes are filled from a corner on; what stands on the shelves of furniture is to be in reach."""
        item = self._editor.objects.get(host)
        return item is not None and not item.fixed and len(children) >= MIN_PACKED

    def _volume_m3(self, name: str) -> float:
        return math.prod(self._pending.waiting[name].asset.size_m)

    def _onto(self, host: str, children: list[str]) -> None:
        """Arrange objects on the surfaces of one host, the best first; what none takes is left to the sampler."""
        try:
            planes = planes_of(self._editor, host)
        except PlacementError as error:
            for child in children:
                self._failed(child, LayoutRelation.ONTOP, host, error)
            return
        constraints = self._constraints(planes[0], children) if planes else {}
        left = children
        for plane in planes[:MAX_SURFACES]:
            fitting = [
                name for name in left if self._pending.waiting[name].asset.size_m[2] < plane.clearance_m
            ]
            if fitting:
                self._arrange(plane, fitting, constraints)
            left = [name for name in left if name in self._pending.waiting]
        for name in left:
            beside = next((w.other for w in constraints.get(name, ()) if w.required), "")
            if beside:
                self._sample(name, Relation.NEXTTO, self.names.get(beside, beside), host)
            else:
                self._sample(name, None if host in self._editor.rooms else Relation.ONTOP, host)

    def _constraints(self, plane: Plane, children: Sequence[str]) -> dict[str, tuple[PlacementConstraint, ...]]:
        category = self._editor.asset_of(plane.host).category if plane.host else ""
        brief = ConstraintBrief(
            plane.host or plane.room,
            category,
            tuple(self._thing(name) for name in children),
            objects_on(self._editor, plane),
            plane.on_floor,
            self._seed,
        )
        answer = self._agents.choose_constraints(brief)
        self._record.constraints.append((brief, answer))
        return answer.of

    def _thing(self, name: str) -> ObjectBrief:
        waiting = self._pending.waiting[name]
        return object_brief(waiting.item, waiting.asset, self.names)

    def _arrange(
        self, plane: Plane, children: Sequence[str], constraints: dict[str, tuple[PlacementConstraint, ...]]
    ) -> None:
        objects = [(self._thing(name), self._pending.waiting[name].asset) for name in children]
        brief = brief_for(self._editor, plane, objects, constraints, self._seed * 31 + self._round)
        began = time.process_time()
        found = self._agents.arrange(brief)
        spent = self._record.planar_s
        spent[self._room.name] = spent.get(self._room.name, 0.0) + time.process_time() - began
        self._record.planes.append((brief, found))
        for spot in found[0].spots:
            asset = self._pending.waiting[spot.object_name].asset
            others = [other for way in found[1:] for other in way.spots if other.object_name == spot.object_name]
            with contextlib.suppress(PlacementError):
                pose = self._sampler.first_free(asset, self._near(plane, asset, (spot, *others)), plane.host)
                relation = Relation.ONTOP if plane.host else None
                self._pending.place(
                    spot.object_name, pose, (relation, plane.host), Support(relation, plane.host or plane.room)
                )

    def _near(self, plane: Plane, asset: Asset, spots: Iterable[PlaneSpot]) -> Iterator[Pose]:
        """Poses at and around spots: off the grid first where nothing aligns the thing."""
        for spot in spots:
            if not ALIGNING & {constraint.kind for constraint in spot.held}:
                dx, dy, turn = self._rng.uniform(-1.0, 1.0, 3)
                yield pose_at(plane, asset, spot, (SHIFT_M * dx, SHIFT_M * dy), TURN_RAD * turn)
            yield pose_at(plane, asset, spot)

    def _sample(
        self, name: str, relation: Relation | None, target: str, host: str = "", *, packed: bool = False
    ) -> None:
        """Let the sampler look for a pose alone; ``host`` is what the tree said, where the target is a neighbour."""
        sampler, asset = self._sampler, self._pending.waiting[name].asset
        try:
            pose = sampler.pack(asset, target) if packed else sampler.find(asset, relation, target)
        except PlacementError as error:
            known = relation in (Relation.INSIDE, Relation.UNDER)
            level = LayoutRelation(relation.value) if relation and known else LayoutRelation.ONTOP
            self._failed(name, level, host or target, error)
        else:
            self._pending.place(name, pose, self._sampler.rests(relation, target), Support(relation, target))

    def _hang(self, name: str) -> None:
        asset = self._pending.waiting[name].asset
        overhead = placement_class_of(asset) is PlacementClass.OVERHEAD
        try:
            pose = self._hanger.under_ceiling(asset) if overhead else self._hanger.on_wall(asset)
        except PlacementError as error:
            self._failed(name, LayoutRelation.ATTACHED, self._room.name, error)
        else:
            at = Support(None, self._room.name)
            self._editor.fasten(self._pending.place(name, pose, (None, ""), at))

    def _failed(self, name: str, relation: LayoutRelation, host: str, error: PlacementError) -> None:
        self._pending.record_failure(name, relation, host, error.reason, str(error))

    def _settle(self, fresh: Sequence[str]) -> None:
        """Let go of what geometry does not prove to be at rest; what does not stay has failed, with all on it.

        So has what the robot doesn't get at, unless it was so elsewhere as well. What the task wants it at is put elsewhere.
        """
        pending_objects = self._pending
        outcome = settle(self._editor, [self.names[name] for name in fresh], self._elsewhere)
        self._record.settled += outcome.dropped
        wrong = {name: (LayoutReason.NOT_AT_HAND, detail) for name, detail in outcome.unreached.items()}
        wrong |= {name: (LayoutReason.UNSTABLE, detail) for name, detail in outcome.unstable.items()}
        for scene_name, (reason, detail) in wrong.items():
            name = pending_objects.items_by_scene_name().get(scene_name, "")
            pending = pending_objects.placed.get(name)
            far = reason is LayoutReason.NOT_AT_HAND
            if pending is None or (far and pending.accepts_unreachable):
                continue  # it went with what it stood on, or is taken as it is
            pending_objects.withdraw(name, reason, detail)
            if far and not (pending_objects.replace_host(pending) or pending_objects.clear_floor(pending)):
                pending.unreached += 1

    def _elsewhere(self, scene_name: str) -> Iterator[Pose]:
        """Other free poses for a thing at what it is at; none for what bears others."""
        editor = self._editor
        pending = self._pending.placed[self._pending.items_by_scene_name()[scene_name]]
        borne = any(item.host == scene_name for item in editor.objects.values())
        if pending.support is None or borne or editor.known(scene_name).fixed:
            return
        relation, host = pending.support.relation, pending.support.host
        target = host if host in editor.objects else ""
        with contextlib.suppress(PlacementError):
            for pose in itertools.islice(self._sampler.poses(pending.asset, relation, host), MAX_ALTERNATIVES):
                if editor.objection(pending.asset, pose, target) is None:
                    yield pose
