"""``PhysicsEngine`` on PyBullet: teleports and narrow-phase queries in one client, settling in another.

Poses and joints are stored in Python; Bullet's copy only answers distance queries. A reset is therefore bit-exact in spite of
Bullet's rounding. The main client is never stepped, and no body is ever removed from it.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Final

from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.mini_world import MiniWorld, StaticObject
from embomatrix.sim.bullet.scene_bodies import SceneBodies
from embomatrix.sim.engine import (
    BACKGROUND,
    FLOOR,
    NOTHING,
    SETTLE_STEPS,
    TOLERANCE_M,
    WALL,
    BodyPlace,
    EngineError,
    EngineMark,
    Journal,
    Settled,
)
from embomatrix.sim.geometry.bounds import AssetBounds, bounds_of, forget
from embomatrix.sim.geometry.spatial_hash import SpatialHash
from embomatrix.sim.validation import check_again, check_fractions, check_pose, check_scene
from embomatrix.world.geometry import IDENTITY, Aabb, Pose, Vec3
from embomatrix.world.scene import Scene

if TYPE_CHECKING:
    from embomatrix.sim.floor.prepared import PreparedScene

BOX_SLACK_M: Final = 0.01
"""Boxes this far apart are still compared part by part: boxes of tilted cylinders may be slightly too small."""
MOST_RAYS: Final = 16_384
"""Rays that Bullet tests in one call."""
SETTLE_RADIUS_M: Final = 0.02
"""Parts with boxes in this range take part in a settle; a stable object moves at most half as far."""


class BulletEngine:
    """Scene in one Bullet client, with a second one for settling. Not thread-safe."""

    def __init__(
        self,
        scene: Scene,
        pool: ClientPool | None = None,
        prepared: PreparedScene | None = None,
        *,
        keeps_bounds: bool = False,
    ) -> None:
        """Load the scene into clients of the pool, or into new ones that close with the engine.

        With ``keeps_bounds``, the bounds of its assets outlive it, for a next scene that has nearly the same assets.
        A scene with ``prepared`` boxes comes from a bundle and was checked there. Raises EngineError for an invalid scene or
        if pybullet is missing.
        """
        if prepared is None:
            check_scene(scene)
        self._scene = scene
        self._keeps_bounds = keeps_bounds
        self._owns_pool = pool is None
        self._pool = pool or ClientPool()
        self._bullet = self._pool.take()
        self._mini = MiniWorld(self._pool)
        self._index = {item.name: number for number, item in enumerate(scene.objects)}
        self._names = tuple(self._index)
        self._assets = [scene.assets[item.asset_id] for item in scene.objects]
        self._bounds: dict[int, AssetBounds] = {}
        self._poses = [item.pose_world_asset for item in scene.objects]
        self._fractions = [tuple(item.joints) for item in scene.objects]
        self._present = [not item.absent for item in scene.objects]
        boxes = prepared.object_boxes if prepared else map(self._box, range(len(self._names)))
        self._boxes = list(boxes)
        self._boxes_at_start = tuple(self._boxes)
        self._around = SpatialHash()
        for number, box in enumerate(self._boxes):
            if self._present[number]:
                self._around.put(number, box)
        walls = prepared.wall_boxes if prepared else [wall.aabb(IDENTITY) for wall in scene.walls]
        self._statics_around = _spatial_hash((*walls, *scene.background_boxes))
        self._journal = Journal()
        self._changed: set[int] = set()
        self._chunks: dict[int, bytes] = {}
        """Entries of ``state_bytes`` for changed objects, valid until their next change."""
        self._all_chunks: bytes | None = b""
        """Concatenated entries, valid until the next change: half of the calls only move the robot."""
        self._bodies = SceneBodies(self._bullet, scene)

    @property
    def scene(self) -> Scene:
        return self._scene

    @property
    def journal(self) -> Journal:
        return self._journal

    def reset(self) -> None:
        for number in sorted(self._changed):
            self._take_on(number, self._placed_at_start(number))
        self._changed.clear()
        self._chunks.clear()
        self._all_chunks = b""
        self._journal.begin_round()

    def mark(self) -> EngineMark:
        return {self._names[number]: self._placed(number) for number in self._changed}

    def return_to(self, mark: EngineMark) -> None:
        numbers = self._changed | {self._index[name] for name in mark}
        for number in sorted(numbers):
            target = mark.get(self._names[number]) or self._placed_at_start(number)
            if target == self._placed(number):
                continue
            self._note(number)
            self._take_on(number, target)

    def _take_on(self, number: int, place: BodyPlace) -> None:
        self._poses[number], self._fractions[number] = place.pose, place.fractions
        self._present[number] = place.present
        self._bodies.leave_behind(number)
        self._bound(number, place.box)

    def _placed(self, number: int) -> BodyPlace:
        return BodyPlace(
            self._poses[number], self._fractions[number], self._present[number], self._boxes[number]
        )

    def _placed_at_start(self, number: int) -> BodyPlace:
        item = self._scene.objects[number]
        return BodyPlace(
            item.pose_world_asset, tuple(item.joints), not item.absent, self._boxes_at_start[number]
        )

    def pose(self, name: str) -> Pose:
        try:
            return self._poses[self._index[name]]
        except KeyError:
            raise self._unknown(name) from None

    def set_pose(self, name: str, pose: Pose) -> None:
        number = self._number(name)
        if pose == self._poses[number] and self._present[number]:
            return
        check_pose(pose, name)
        self._note(number)
        self._present[number] = True
        self._put(number, pose)

    def aabb(self, name: str) -> Aabb:
        try:
            return self._boxes[self._index[name]]
        except KeyError:
            raise self._unknown(name) from None

    def joints(self, name: str) -> tuple[float, ...]:
        try:
            return self._fractions[self._index[name]]
        except KeyError:
            raise self._unknown(name) from None

    def set_joints(self, name: str, fractions: Sequence[float]) -> None:
        number = self._number(name)
        check_fractions(self._scene.objects[number], self._assets[number], fractions)
        self._note(number)
        self._put_joints(number, tuple(map(float, fractions)))

    def park(self, name: str) -> None:
        number = self._number(name)
        if not self._present[number]:
            return
        self._note(number)
        self._present[number] = False
        self._around.take_out(number)

    def is_parked(self, name: str) -> bool:
        try:
            return not self._present[self._index[name]]
        except KeyError:
            raise self._unknown(name) from None

    def penetrates(self, name: str, margin_m: float = 0.0, ignore: frozenset[str] = NOTHING) -> str:
        number = self._number(name)
        limit = margin_m - TOLERANCE_M
        box = self._boxes[number]
        if FLOOR not in ignore and box.low_m[2] < limit:
            return FLOOR
        reach = max(limit, 0.0) + BOX_SLACK_M
        if statics := self._statics_around.near(box, reach):
            for first in sorted({self._bodies.first_of(static) for static in statics}):
                kind = WALL if first < len(self._scene.walls) else BACKGROUND
                if (
                    kind not in ignore
                    and self._closest(self._body(number), self._bodies.static(first), limit) < limit
                ):
                    return kind
        names = self._names
        for other in self._around.near(box, reach):
            if other == number or names[other] in ignore:
                continue
            if self._closest(self._body(number), self._body(other), limit) < limit:
                return names[other]
        return ""

    def near(self, box: Aabb, ignore: frozenset[str] = NOTHING) -> tuple[str, ...]:
        names = self._names
        return tuple(
            names[number] for number in self._around.near(box) if not ignore or names[number] not in ignore
        )

    def first_met(self, start_m: Vec3, ends_m: Sequence[Vec3]) -> tuple[str, ...]:
        if not ends_m:
            return ()
        xs, ys, zs = zip(start_m, *ends_m, strict=True)
        between = Aabb((min(xs), min(ys), min(zs)), (max(xs), max(ys), max(zs)))
        # A body that was left behind may stand in the way where its object no longer is.
        for number in {*self._around.near(between), *self._bodies.behind}:
            if self._present[number]:
                self._body(number)
        for number, present in enumerate(self._present):
            if not present:
                self._bodies.put_away(number)
        for static in self._statics_around.near(between):
            self._bodies.static(self._bodies.first_of(static))
        objects, statics = self._bodies.owners()
        walls = len(self._scene.walls)

        def name(body: int) -> str:
            if body in objects:
                return self._names[objects[body]]
            return "" if body < 0 else WALL if statics[body] < walls else BACKGROUND

        met: list[str] = []
        for begin in range(0, len(ends_m), MOST_RAYS):
            ends = ends_m[begin : begin + MOST_RAYS]
            met += [name(hit[0]) for hit in self._bullet.rayTestBatch([start_m] * len(ends), ends)]
        return tuple(met)

    def is_at_static(self, box: Aabb) -> bool:
        return bool(self._statics_around.near(box))

    def gap(self, a: str, b: str, limit_m: float) -> float | None:
        first, second = self._number(a), self._number(b)
        for name, number in ((a, first), (b, second)):
            if not self._present[number]:
                raise EngineError(f"{name!r} is parked: expected an object in the world; place it first")
        if not 0.0 <= limit_m < 1e3:
            raise EngineError(f"a gap up to {limit_m} m was asked for: expected a limit from 0 to 1,000 m")
        if not self._boxes[first].overlaps(self._boxes[second], limit_m + BOX_SLACK_M):
            return None
        distance = self._closest(self._body(first), self._body(second), limit_m)
        return distance if distance <= limit_m else None

    def settle(self, name: str, steps: int = SETTLE_STEPS, ignore: frozenset[str] = NOTHING) -> Settled:
        number = self._number(name)
        box = self._boxes[number]
        stills = [
            StaticObject(self._assets[other], self._poses[other], self._fractions[other])
            for other in self._around.near(box, SETTLE_RADIUS_M)
            if other != number and self._names[other] not in ignore
        ]
        statics = self._bodies.statics
        parts = [statics[static] for static in self._statics_around.near(box, SETTLE_RADIUS_M)]
        pose = self._poses[number]
        region = box.grown(SETTLE_RADIUS_M)
        self._mini.stage(self._assets[number], pose, self._fractions[number], stills, parts, region)
        return self._mini.drop(pose, steps)

    def state_bytes(self) -> bytes:
        if self._all_chunks is None:
            chunks = self._chunks
            for number in self._changed - chunks.keys():
                chunks[number] = self._chunk(number)
            self._all_chunks = b"".join([chunks[number] for number in sorted(chunks)])
        return self._all_chunks

    def _chunk(self, number: int) -> bytes:
        """Entry of an object in ``state_bytes``; empty if it is as in the scene."""
        item, pose = self._scene.objects[number], self._poses[number]
        fractions, present = self._fractions[number], self._present[number]
        if (pose, fractions, present) == (item.pose_world_asset, tuple(item.joints), not item.absent):
            return b""
        values = (*pose.position_m, *pose.quat_xyzw, *fractions)
        return struct.pack(f"<i?{len(values)}d", number, present, *values)

    def warm_up(self) -> Iterator[None]:
        """Make missing bodies of objects, walls and background, one per step. Changes no answer."""
        for number in self._bodies.missing():
            self._body(number)
            yield
        for first in sorted({self._bodies.first_of(static) for static in range(len(self._bodies.statics))}):
            self._bodies.static(first)
            yield

    def close(self) -> None:
        self._mini.close()
        if not self._keeps_bounds:
            forget(self._scene.assets.values())
            check_again(self._scene.assets.values())
        self._pool.give_back(self._bullet)
        if self._owns_pool:
            self._pool.close()

    def _note(self, number: int) -> None:
        """Record an upcoming change in the journal and for the next reset."""
        self._changed.add(number)
        self._chunks.pop(number, None)
        self._all_chunks = None
        box = self._boxes[number] if self._present[number] else None
        self._journal.entries.append((self._names[number], box))

    def _number(self, name: str) -> int:
        try:
            return self._index[name]
        except KeyError:
            raise self._unknown(name) from None

    def _unknown(self, name: str) -> EngineError:
        return EngineError(
            f"there is no object {name!r} in scene {self._scene.scene_id!r}: expected one of its "
            f"{len(self._names)} objects, such as {', '.join(self._names[:3])}"
        )

    def _put(self, number: int, pose: Pose) -> None:
        self._poses[number] = pose
        self._bodies.leave_behind(number)
        self._bound(number, self._box(number))

    def _put_joints(self, number: int, fractions: tuple[float, ...]) -> None:
        if not fractions:
            return
        self._fractions[number] = fractions
        self._bodies.leave_behind(number)
        self._bound(number, self._box(number))

    def _bound(self, number: int, box: Aabb) -> None:
        """Update the object's box and its entry in the spatial hash."""
        self._boxes[number] = box
        if self._present[number]:
            self._around.put(number, box)
        else:
            self._around.take_out(number)

    def _box(self, number: int) -> Aabb:
        bounds = self._bounds.get(number)
        if bounds is None:
            bounds = self._bounds[number] = bounds_of(self._assets[number])
        return bounds.box(self._poses[number], self._fractions[number])

    def _body(self, number: int) -> int:
        return self._bodies.object(number, self._poses[number], self._fractions[number])

    def _closest(self, body: int, other: int, limit_m: float) -> float:
        """Smallest signed distance between two bodies; infinity beyond ``limit_m`` (at least 0)."""
        contacts = self._bullet.getClosestPoints(body, other, max(limit_m, 0.0))
        return min([contact[8] for contact in contacts]) if contacts else math.inf


def _spatial_hash(boxes: Iterable[Aabb]) -> SpatialHash:
    around = SpatialHash()
    for number, box in enumerate(boxes):
        around.put(number, box)
    return around
