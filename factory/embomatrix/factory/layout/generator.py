"""Multi-level scene generation: four agents lay the objects of a task out in a scene, one level after the other.

Scene level: each object gets a room. Room level: a layout tree assigns a host and a relation. Plane level: objects on
one surface are arranged together. Object level: sampling finds a continuous pose that is collision-free, reachable
and stable. Failures go back to the room level with their reason.
"""

import contextlib
import itertools
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from embomatrix.factory.layout.distribution import DistributionError
from embomatrix.factory.layout.facts import hosts_in, rooms_of
from embomatrix.factory.layout.hanging import Hanger
from embomatrix.factory.layout.organization import LayoutTree, tree_in
from embomatrix.factory.layout.pending import PendingObjects, Support
from embomatrix.factory.layout.planes import Plane, brief_for, objects_on, planes_of, pose_at
from embomatrix.factory.layout.request import (
    Layout,
    LayoutAgents,
    LayoutRecord,
    RequestedObject,
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
    ObjectBrief,
    PlacementClass,
    PlacementConstraint,
    PlaneSpot,
    RoomBrief,
)
from embomatrix.factory.scenes.editor import LayoutReason, PlacementError, SceneEditor
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import Pose
from embomatrix.world.scene import Room
from embomatrix.world.state import Relation

MAX_ROUNDS: Final = 24
"""Maximum number of trees requested for one room."""
MAX_ALTERNATIVES: Final = 96
"""Maximum number of other poses tried for an object that the robot can't reach."""
MAX_SURFACES: Final = 4
"""Number of a host's surfaces that the planar solver arranges. After them, only the sampler tries."""
SHIFT_M: Final = 0.008
TURN_RAD: Final = 0.15
"""Random shift in metres and rotation of objects without an aligning constraint, so that layouts don't look like a grid."""
MIN_PACKED: Final = 2
"""Number of objects from which on a loose container is packed from a corner, the largest object first."""
ALIGNING: Final = frozenset(
    {ConstraintKind.CENTER_ALIGNED, ConstraintKind.FACE_TO, ConstraintKind.NEXT_TO, ConstraintKind.EDGE}
)


def lay(
    editor: SceneEditor, items: Sequence[RequestedObject], seed: int, agents: LayoutAgents | None = None
) -> Layout:
    """Place the objects in the scene. An object without a place is left out and reported as a failure.

    Equal arguments give equal layouts. Raise LlmError if a language model doesn't answer.
    """
    agents = agents or LayoutAgents()
    record = LayoutRecord()
    names: dict[str, str] = {}
    trees: dict[str, LayoutTree] = {}
    try:
        rooms = _assign_rooms(editor, items, seed, agents, record)
    except DistributionError as error:
        failures = [item.failure(item.host, LayoutReason.NO_HOST, str(error)) for item in items]
        return Layout({}, {}, tuple(failures), record)
    left: list[LayoutFailure] = []
    unreachable: list[LayoutFailure] = []
    for number, room in enumerate(dict.fromkeys(rooms.values())):
        room_items = [item for item in items if rooms[item.name] == room]
        job = _RoomLayout(editor, agents, editor.rooms[room], room_items, seed * 1009 + number, record)
        left += job.run()
        names |= job.names
        unreachable += job.unreachable
        trees[room] = job.tree()
    return Layout(names, trees, tuple(left), record, tuple(unreachable))


def _assign_rooms(
    editor: SceneEditor,
    items: Sequence[RequestedObject],
    seed: int,
    agents: LayoutAgents,
    record: LayoutRecord,
) -> dict[str, str]:
    """Return the room of each object by name. Raise DistributionError."""
    objects = tuple(object_brief(item, item.asset(0), {}) for item in items)
    named = {name for item in items for name in (item.host, *item.beside) if name in editor.objects}
    homes = {name: editor.objects[name].room for name in sorted(named)}
    brief = DistributionBrief(rooms_of(editor), objects, homes, seed)
    answer = agents.distribute(brief)
    record.distribution = (brief, answer)
    return answer.rooms


def _at_neighbours_host(editor: SceneEditor, item: ObjectBrief) -> ObjectBrief:
    """Give an object that must stand beside an existing object the host of that object."""
    other = next((editor.objects[name] for name in item.beside if name in editor.objects), None)
    if other is None or item.relation is not None:
        return item
    inside = other.relation is Relation.INSIDE
    return replace(item, relation=LayoutRelation.INSIDE if inside else LayoutRelation.ONTOP, host=other.host)


class _RoomLayout:
    """Layout of one room. It requests tree after tree until each object has a place or no option is left."""

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
        """Scene names of the placed objects."""
        return self._pending.names

    @property
    def unreachable(self) -> list[LayoutFailure]:
        """Failures of placed objects that the robot can't reach."""
        return [
            pending.last_failure
            for pending in self._pending.placed.values()
            if pending.accepts_unreachable and pending.last_failure
        ]

    def run(self) -> list[LayoutFailure]:
        """Lay out the room and return the failures."""
        pending_objects = self._pending
        for number in range(MAX_ROUNDS):
            if not pending_objects.waiting:
                if number > 1:
                    self._settle(list(self.names))  # objects placed later may block access to earlier ones
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
            self._place_tree(tree)
            self._settle([name for name in self.names if name not in before])
        left = [pending.failure(self._room.name) for pending in pending_objects.waiting.values()]
        return [*pending_objects.abandoned, *left]

    def tree(self) -> LayoutTree:
        """Return the final tree of the room, in scene names: the placed objects and their supports."""
        return tree_in(self._editor.objects.values(), self._room.name, self.names.values())

    def _brief(self) -> RoomBrief:
        objects = tuple(
            _at_neighbours_host(self._editor, self._brief_of(name)) for name in self._pending.waiting
        )
        named = {item.host for item in objects if item.host in self._editor.objects}
        hosts = tuple(hosts_in(self._editor, self._room.name, named))
        room = next(room for room in rooms_of(self._editor) if room.name == self._room.name)
        return RoomBrief(room, hosts, objects, tuple(self._pending.failures), self._seed * 31 + self._round)

    def _place_tree(self, tree: LayoutTree) -> None:
        """Place the objects of a tree, hosts first. Objects on the same host are placed together."""
        waiting = self._pending.waiting
        groups: dict[tuple[str, LayoutRelation], list[str]] = {}
        for branch in tree.branches():
            if branch.child in waiting:
                groups.setdefault((branch.parent, branch.relation), []).append(branch.child)
        for (parent, relation), children in groups.items():
            if parent in waiting:
                continue  # the host itself has no place
            host = self.names.get(parent, parent)
            if relation is LayoutRelation.ONTOP:
                self._place_on(host, children)
            elif relation is LayoutRelation.ATTACHED:
                for child in children:
                    self._hang(child)
            elif relation is LayoutRelation.INSIDE and self._is_packed(host, children):
                volumes_m3 = {name: math.prod(waiting[name].asset.size_m) for name in children}
                for child in sorted(children, key=volumes_m3.__getitem__, reverse=True):
                    self._sample(child, Relation.INSIDE, host, packed=True)
            else:
                for child in children:
                    self._sample(child, Relation(relation.value), host)

    def _is_packed(self, host: str, children: Sequence[str]) -> bool:
        """True if the children are packed from a corner.

        Furniture shelves are not packed, since their objects must stay reachable.
        """
        item = self._editor.objects.get(host)
        return item is not None and not item.fixed and len(children) >= MIN_PACKED

    def _place_on(self, host: str, children: list[str]) -> None:
        """Arrange objects on the surfaces of a host, the best surface first. The sampler places the rest."""
        try:
            planes = planes_of(self._editor, host)
        except PlacementError as error:
            for child in children:
                self._record_failure(child, LayoutRelation.ONTOP, host, error)
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

    def _constraints(
        self, plane: Plane, children: Sequence[str]
    ) -> dict[str, tuple[PlacementConstraint, ...]]:
        category = self._editor.asset_of(plane.host).category if plane.host else ""
        brief = ConstraintBrief(
            plane.host or plane.room,
            category,
            tuple(self._brief_of(name) for name in children),
            objects_on(self._editor, plane),
            plane.on_floor,
            self._seed,
        )
        answer = self._agents.choose_constraints(brief)
        self._record.constraints.append((brief, answer))
        return answer.of

    def _brief_of(self, name: str) -> ObjectBrief:
        waiting = self._pending.waiting[name]
        return object_brief(waiting.item, waiting.asset, self.names)

    def _arrange(
        self, plane: Plane, children: Sequence[str], constraints: dict[str, tuple[PlacementConstraint, ...]]
    ) -> None:
        objects = [(self._brief_of(name), self._pending.waiting[name].asset) for name in children]
        brief = brief_for(self._editor, plane, objects, constraints, self._seed * 31 + self._round)
        began = time.process_time()
        found = self._agents.arrange(brief)
        spent = self._record.planar_s
        spent[self._room.name] = spent.get(self._room.name, 0.0) + time.process_time() - began
        self._record.planes.append((brief, found))
        for spot in found[0].spots:
            asset = self._pending.waiting[spot.object_name].asset
            others = [
                other for way in found[1:] for other in way.spots if other.object_name == spot.object_name
            ]
            with contextlib.suppress(PlacementError):
                pose = self._sampler.first_free(
                    asset, self._poses_near(plane, asset, (spot, *others)), plane.host
                )
                relation = Relation.ONTOP if plane.host else None
                self._pending.place(
                    spot.object_name,
                    pose,
                    (relation, plane.host),
                    Support(relation, plane.host or plane.room),
                )

    def _poses_near(self, plane: Plane, asset: Asset, spots: Iterable[PlaneSpot]) -> Iterator[Pose]:
        """Yield poses at the spots. Objects without an aligning constraint first get a shifted pose."""
        for spot in spots:
            if not ALIGNING & {constraint.kind for constraint in spot.held}:
                dx, dy, turn = self._rng.uniform(-1.0, 1.0, 3)
                yield pose_at(plane, asset, spot, (SHIFT_M * dx, SHIFT_M * dy), TURN_RAD * turn)
            yield pose_at(plane, asset, spot)

    def _sample(
        self, name: str, relation: Relation | None, target: str, host: str = "", *, packed: bool = False
    ) -> None:
        """Place an object with the sampler alone. ``host`` is the tree's host if the target is a neighbour."""
        sampler, asset = self._sampler, self._pending.waiting[name].asset
        try:
            pose = sampler.pack(asset, target) if packed else sampler.find(asset, relation, target)
        except PlacementError as error:
            known = relation in (Relation.INSIDE, Relation.UNDER)
            level = LayoutRelation(relation.value) if relation and known else LayoutRelation.ONTOP
            self._record_failure(name, level, host or target, error)
        else:
            self._pending.place(name, pose, self._sampler.rests(relation, target), Support(relation, target))

    def _hang(self, name: str) -> None:
        asset = self._pending.waiting[name].asset
        overhead = placement_class_of(asset) is PlacementClass.OVERHEAD
        try:
            pose = self._hanger.under_ceiling(asset) if overhead else self._hanger.on_wall(asset)
        except PlacementError as error:
            self._record_failure(name, LayoutRelation.ATTACHED, self._room.name, error)
        else:
            at = Support(None, self._room.name)
            self._editor.fasten(self._pending.place(name, pose, (None, ""), at))

    def _record_failure(self, name: str, relation: LayoutRelation, host: str, error: PlacementError) -> None:
        self._pending.record_failure(name, relation, host, error.reason, str(error))

    def _settle(self, fresh: Sequence[str]) -> None:
        """Test the new objects for stability and access, and withdraw those that fail together with the objects on them.

        An unreachable object is accepted after repeated attempts. Before, its host is replaced or furniture is
        removed.
        """
        pending_objects = self._pending
        outcome = settle(self._editor, [self.names[name] for name in fresh], self._alternatives)
        wrong = {name: (LayoutReason.INACCESSIBLE, detail) for name, detail in outcome.unreached.items()}
        wrong |= {name: (LayoutReason.UNSTABLE, detail) for name, detail in outcome.unstable.items()}
        for scene_name, (reason, detail) in wrong.items():
            name = pending_objects.items_by_scene_name().get(scene_name, "")
            pending = pending_objects.placed.get(name)
            far = reason is LayoutReason.INACCESSIBLE
            if pending is None or (far and pending.accepts_unreachable):
                continue  # it was removed with its host, or it is accepted as unreachable
            pending_objects.withdraw(name, reason, detail)
            if far and not (pending_objects.replace_host(pending) or pending_objects.clear_floor(pending)):
                pending.unreached += 1

    def _alternatives(self, scene_name: str) -> Iterator[Pose]:
        """Yield other collision-free poses for an object at its host. Objects that support others have none."""
        editor = self._editor
        pending = self._pending.placed[self._pending.items_by_scene_name()[scene_name]]
        borne = any(item.host == scene_name for item in editor.objects.values())
        if pending.support is None or borne or editor.known(scene_name).fixed:
            return
        relation, host = pending.support.relation, pending.support.host
        target = host if host in editor.objects else ""
        with contextlib.suppress(PlacementError):
            for pose in itertools.islice(
                self._sampler.poses(pending.asset, relation, host), MAX_ALTERNATIVES
            ):
                if editor.objection(pending.asset, pose, target) is None:
                    yield pose
