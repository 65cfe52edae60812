"""Opening doors, drawers and lids: how far they swing, and how far those do that nothing has been moved near to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.sim.geometry.bounds import bounds_of, parts_of
from embomatrix.sim.geometry.surfaces import links_with_spots
from embomatrix.sim.joints.panels import LEAF_SLACK_M, Leaves, measure_swing
from embomatrix.world.geometry import Aabb

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.sim.state.relations import Relations
    from embomatrix.world.geometry import Pose

SWING: Final = (0.25, 0.5, 0.75, 1.0)
"""Shares of its travel at which a door is checked for things in its way."""
LEAST_OPEN: Final = 0.5
"""A door that something stops before this share of its travel does not open."""
ZONE_SLACK_M: Final = LEAF_SLACK_M + 0.04
"""What is further than this from where the leaves pass, and from what stands there, has no part in how they swing."""


@dataclass(frozen=True, slots=True)
class Foreseen:
    """How an object's leaves stand once they are opened, for as long as nothing has changed in a zone around it."""

    fractions: tuple[float, ...]
    riders: tuple[tuple[str, Pose], ...]
    zone: Aabb


class Swings:
    """Opens the leaves of an engine's objects.

    Where nothing has changed since the scene was loaded, leaves swing as they would have then: that is found out ahead, and
    only what was moved is looked at.
    """

    def __init__(self, engine: PhysicsEngine, relations: Relations) -> None:
        self._engine = engine
        self._relations = relations
        self._foreseen: dict[str, Foreseen] = {}

    def open(self, name: str) -> str:
        """Open every leaf of the object as far as there is room. Returns what stops them too early, "" when nothing does.

        What was stopped is where it was before.
        """
        foreseen = self._foreseen.get(name)
        if foreseen is not None and not self._is_news(name, foreseen.zone):
            self._engine.set_joints(name, foreseen.fractions)
            for rider, pose in foreseen.riders:
                self._engine.set_pose(rider, pose)
            return ""
        return _opened(Leaves(self._engine, self._relations, name), _course(self._engine.joints(name)))

    def complete(self) -> Iterator[None]:
        """Find out how the leaves of each object open in the scene as it was loaded, one object at a step.

        Work for a process that waits. Changes no answer: where anything is otherwise than it was loaded, nothing is foreseen.
        """
        for item in self._engine.scene.objects:
            if item.joints and not item.absent and not self._engine.state_bytes():
                measure_swing(self._engine, item.name, (0.0, *SWING))
                self._foresee(item.name)
                yield

    def _foresee(self, name: str) -> None:
        leaves = Leaves(self._engine, self._relations, name)
        before = self._engine.joints(name)
        if not _opened(leaves, _course(before)):
            fractions = self._engine.joints(name)
            leaves.put_back()
            zone = self._zone(name, leaves, [before, *_course(before)])
            self._foreseen[name] = Foreseen(fractions, leaves.carried(fractions), zone)

    def _zone(self, name: str, leaves: Leaves, stops: Sequence[Sequence[float]]) -> Aabb:
        """Where the leaves and what rides on them pass, and all that stands around: what is there decides what rides along."""
        engine, scene = self._engine, self._engine.scene
        asset, pose = scene.asset_of(name), engine.pose(name)
        boxes: list[Aabb] = []
        for fractions in stops:
            boxes.append(bounds_of(asset).box(pose, fractions))
            boxes += parts_of(asset).leaves(pose, fractions)
            for rider, carried in leaves.carried(fractions):
                boxes.append(bounds_of(scene.asset_of(rider)).box(carried, engine.joints(rider)))
        if links_with_spots(asset) - {""}:
            around = engine.near(engine.aabb(name).grown(ZONE_SLACK_M))
            boxes += [engine.aabb(other) for other in around if not scene.by_name[other].fixed]
        return Aabb.around(boxes).grown(ZONE_SLACK_M)

    def _is_news(self, name: str, zone: Aabb) -> bool:
        """Whether the object itself has changed since the scene was loaded, or anything that was or is in a zone."""
        engine, seen = self._engine, set[str]()
        for other, box in engine.journal.entries:
            if other in seen:
                continue
            seen.add(other)
            if other == name or (box is not None and zone.overlaps(box)):
                return True
        return any(not engine.is_parked(other) and zone.overlaps(engine.aabb(other)) for other in seen)


def _course(before: Sequence[float]) -> list[tuple[float, ...]]:
    """Joint positions that leaves go through as they open from where they are."""
    return [tuple(max(share, fraction) for fraction in before) for share in SWING]


def _opened(leaves: Leaves, course: Sequence[Sequence[float]]) -> str:
    """Swing leaves open. Returns what stops them too early, "" when nothing does."""
    reached, other = leaves.swing(course)
    if not reached or SWING[reached - 1] < LEAST_OPEN:
        leaves.put_back()
        return other
    if other:
        leaves.go_on(course[reached - 1], course[reached])
    return ""
