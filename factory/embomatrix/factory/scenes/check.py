"""Rules of a valid scene: no penetration, everything rests or hangs, and the robot reaches everything it may use.

Most rules are checked by geometry. The engine tests penetration a second time and lets all movable objects settle.
"""

import contextlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

from embomatrix.factory.assets.solids import Solids, convex_of, placed_parts
from embomatrix.factory.floorplan.spec import MIN_DOOR_M
from embomatrix.factory.furnish.pieces import Access
from embomatrix.factory.scenes.access import unserved
from embomatrix.factory.scenes.clearance import Clearance
from embomatrix.factory.scenes.floor import ReachableFloor, SceneBoxes, box_of
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.bullet.settling import settle_scene
from embomatrix.sim.engine import FLOOR
from embomatrix.world.geometry import IDENTITY, Aabb
from embomatrix.world.scene import Scene, SceneObject
from embomatrix.world.state import Relation

REST_M: Final = 0.002
HANG_M: Final = 0.03
CUT_OFF_M2: Final = 1.0
CUT_OFF_SHARE: Final = 0.01
"""Limits for unreachable floor on which the robot fits, per room: exceeding both means a blocked aisle."""
STABLE_SHARE: Final = 0.96
"""Share of the movable objects that must stay within 1 cm and 10 degrees when all settle at once."""
_EDGE_M: Final = 0.005


class ProblemKind(StrEnum):
    """Broken rule of a scene."""

    NAME = "name"
    PENETRATION = "penetration"
    FLOATING = "floating"
    ROOM = "room"
    ACCESS = "access"
    UNREACHABLE_ROOM = "unreachable_room"
    AISLE = "aisle"
    DOORWAY = "doorway"
    WINDOW = "window"
    UNSTABLE = "unstable"
    SUNKEN = "sunken"
    UNACCOUNTED = "unaccounted"


@dataclass(frozen=True, slots=True)
class SceneProblem:
    """Broken rule with the objects or rooms concerned and a sentence on the extent."""

    kind: ProblemKind
    names: tuple[str, ...]
    detail: str


def check_scene(scene: Scene) -> tuple[SceneProblem, ...]:
    """Return all rules broken by geometry; empty for a valid scene."""
    return (
        *_names(scene),
        *_penetrations(scene),
        *_supports(scene),
        *_rooms(scene),
        *_background(scene),
        *reach_problems(scene),
        *_openings(scene),
    )


def check_in_engine(scene: Scene) -> tuple[SceneProblem, ...]:
    """Return penetrations of more than 1 mm found by Bullet. Raises EngineError if the engine is missing."""
    with contextlib.closing(BulletEngine(scene)) as engine:
        pairs = [
            (each.name, engine.penetrates(each.name, ignore=frozenset({FLOOR}))) for each in scene.objects
        ]
    return tuple(
        SceneProblem(ProblemKind.PENETRATION, (name, other), "found by the engine")
        for name, other in pairs
        if other
    )


@dataclass(frozen=True, slots=True)
class Settlement:
    """Result of settling a scene: the number of movable objects, those that moved, and objects that sank into others.

    ``stable_share`` is the share of the movable objects that stayed in place; 1 if nothing can move.
    """

    movable: int
    unstable: tuple[str, ...]
    stable_share: float
    problems: tuple[SceneProblem, ...]


def check_settled(scene: Scene) -> Settlement:
    """Let all movable objects settle at once. Raises EngineError if the engine is missing."""
    settled = settle_scene(scene)
    problems = [
        SceneProblem(ProblemKind.SUNKEN, pair, f"{depth * 1000:.1f} mm into one another after settling")
        for pair, depth in settled.overlaps.items()
    ]
    movable, unstable = len(settled.objects), settled.unstable
    stable_share = 1.0 - len(unstable) / movable if movable else 1.0
    if stable_share < STABLE_SHARE:
        moved = max(settled.objects[name].moved_m for name in unstable)
        detail = (
            f"{stable_share:.1%} of {movable} movable objects stay in place, one moves {moved:.2f} m: "
            f"expected {STABLE_SHARE:.0%}"
        )
        problems.append(SceneProblem(ProblemKind.UNSTABLE, unstable, detail))
    return Settlement(movable, unstable, stable_share, tuple(problems))


def _names(scene: Scene) -> Iterator[SceneProblem]:
    for name, count in Counter(item.name for item in scene.objects).items():
        if count > 1:
            yield SceneProblem(
                ProblemKind.NAME, (name,), f"{count} objects have this name: expected unique names"
            )
    known = {item.name for item in scene.objects}
    for item in scene.objects:
        if item.host and item.host not in known:
            yield SceneProblem(ProblemKind.NAME, (item.name,), f"its host {item.host!r} is not in the scene")


def _penetrations(scene: Scene) -> Iterator[SceneProblem]:
    solids = Solids.of_scene(scene)
    seen: set[frozenset[str]] = set()
    for item in scene.objects:
        parts = placed_parts(scene.assets[item.asset_id], item.pose_world_asset)
        for other, depth in solids.overlaps(parts, ignore=item.name).items():
            pair = frozenset((item.name, other))
            if pair not in seen:
                seen.add(pair)
                detail = f"{item.name} and {other} overlap by {depth * 1000:.1f} mm"
                yield SceneProblem(ProblemKind.PENETRATION, (item.name, other), detail)


def _supports(scene: Scene) -> Iterator[SceneProblem]:
    for item in scene.objects:
        box = box_of(scene, item)
        if box.low_m[2] < -REST_M:
            yield SceneProblem(ProblemKind.FLOATING, (item.name,), f"{-box.low_m[2]:.3f} m below the floor")
        elif item.host:
            if item.host in scene.by_name and not _rests(scene, item, box):
                detail = f"underside at {box.low_m[2]:.3f} m rests on no surface of {item.host}"
                yield SceneProblem(ProblemKind.FLOATING, (item.name, item.host), detail)
        elif box.low_m[2] > REST_M and not _hangs(scene, item, box):
            detail = f"underside at {box.low_m[2]:.3f} m, no host, no wall or ceiling within {HANG_M} m"
            yield SceneProblem(ProblemKind.FLOATING, (item.name,), detail)


def _rests(scene: Scene, item: SceneObject, box: Aabb) -> bool:
    """True if the underside lies on a surface of the host, with the box's centre above it."""
    host = scene.by_name[item.host]
    for support in scene.assets[host.asset_id].supports:
        if bool(support.interior) is not (item.relation is Relation.INSIDE):
            continue
        x, y, z = host.pose_world_asset.inverse().apply((*box.center_m[:2], box.low_m[2]))
        cx, cy, cz = support.center_m
        on = abs(x - cx) <= support.size_m[0] / 2 + _EDGE_M and abs(y - cy) <= support.size_m[1] / 2 + _EDGE_M
        if on and -1e-6 <= z - cz <= REST_M:
            return True
    top = box_of(scene, host).high_m[2]
    return item.relation is Relation.ONTOP and -1e-6 <= box.low_m[2] - top <= REST_M


def _hangs(scene: Scene, item: SceneObject, box: Aabb) -> bool:
    if not item.fixed:
        return False
    room = next((r for r in scene.rooms if r.name == item.room), None)
    if room is None or box.high_m[2] > room.height_m - HANG_M:
        return room is not None
    gaps = (
        *(abs(low - edge) for low, edge in zip(box.low_m, room.low_m, strict=False)),
        *(abs(high - edge) for high, edge in zip(box.high_m, room.high_m, strict=False)),
    )
    return min(gaps) <= HANG_M


def _rooms(scene: Scene) -> Iterator[SceneProblem]:
    rooms = {room.name: room for room in scene.rooms}
    for item in scene.objects:
        x, y, _ = item.pose_world_asset.position_m
        if item.room not in rooms or not rooms[item.room].contains(x, y):
            yield SceneProblem(
                ProblemKind.ROOM, (item.name,), f"its middle lies outside its room {item.room!r}"
            )


def _background(scene: Scene) -> Iterator[SceneProblem]:
    """Yield background objects that overlap anything, stand on nothing, or lie outside their room."""
    solids = Solids.of_scene(replace(scene, background=()))
    rooms = {room.name: room for room in scene.rooms}
    places = zip(scene.background, scene.background_parts, scene.background_boxes, strict=True)
    for item, part, box in places:
        names = (f"background {item.asset_id}", item.host)
        convex = [convex_of(part, IDENTITY)]
        for other, depth in solids.overlaps(convex).items():
            detail = f"a background {item.asset_id} and {other} overlap by {depth * 1000:.1f} mm"
            yield SceneProblem(ProblemKind.PENETRATION, (names[0], other), detail)
        solids.add(names[0], convex)
        x, y, _ = item.pose_world_asset.position_m
        if item.room not in rooms or not rooms[item.room].contains(x, y):
            yield SceneProblem(ProblemKind.ROOM, names[:1], f"its middle lies outside its room {item.room!r}")
        standing = SceneObject(
            names[0],
            item.asset_id,
            item.room,
            item.pose_world_asset,
            fixed=True,
            host=item.host,
            relation=Relation.ONTOP,
        )
        if item.host and item.host not in scene.by_name:
            yield SceneProblem(ProblemKind.NAME, names, f"its host {item.host!r} is not in the scene")
        elif item.host and not _rests(scene, standing, box):
            yield SceneProblem(ProblemKind.FLOATING, names, "its underside rests on no surface of its host")


def reach_problems(scene: Scene, boxes: SceneBoxes | None = None) -> Iterator[SceneProblem]:
    """Yield rooms and furniture that the robot can't reach, and rooms with a blocked aisle.

    ``boxes`` are those of earlier, similar scenes.
    """
    floor = ReachableFloor(scene, boxes)
    if not floor.has_start:
        yield SceneProblem(
            ProblemKind.UNREACHABLE_ROOM, (scene.robot.room,), "the robot's start is not free floor"
        )
        return
    for room in scene.rooms:
        if not floor.enters(room):
            yield SceneProblem(ProblemKind.UNREACHABLE_ROOM, (room.name,), "no free floor leads into it")
            continue
        cut_off_m2 = floor.cut_off_m2(room)
        if cut_off_m2 > max(CUT_OFF_M2, CUT_OFF_SHARE * room.size_m[0] * room.size_m[1]):
            detail = f"furniture cuts off {cut_off_m2:.1f} m2 of floor where the robot fits"
            yield SceneProblem(ProblemKind.AISLE, (room.name,), detail)
    for item, access in unserved(scene, floor):
        where = "beside it" if access is Access.BESIDE else "before its front"
        yield SceneProblem(ProblemKind.ACCESS, (item.name,), f"no reachable spot {where}")


def _openings(scene: Scene) -> Iterator[SceneProblem]:
    for doorway in scene.doorways:
        if doorway.width_m < MIN_DOOR_M - _EDGE_M:
            detail = f"{doorway.width_m:.2f} m wide: expected {MIN_DOOR_M} m"
            yield SceneProblem(ProblemKind.DOORWAY, doorway.rooms, detail)
    clearance = Clearance(scene)
    for doorway, room, names in clearance.before_doorways():
        if names:
            beyond = next((other for other in doorway.rooms if other != room), "") or "outside"
            yield SceneProblem(ProblemKind.DOORWAY, names, f"before the doorway from {room} to {beyond}")
    for _, room, names in clearance.before_windows():
        if names:
            yield SceneProblem(ProblemKind.WINDOW, names, f"before a window of {room}")
