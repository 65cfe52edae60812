"""Planes of a scene editor: surfaces of furniture and floors of rooms, converted to planar briefs."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.factory.layout.constraints import half_extents
from embomatrix.factory.layout.sampling import LIFT_M
from embomatrix.factory.layout.values import (
    ObjectBrief,
    PlacementConstraint,
    PlaneBrief,
    PlaneFootprint,
    PlaneObject,
    PlaneSpot,
    Size2,
)
from embomatrix.factory.scenes.editor import SceneEditor
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.sim.geometry.candidates import surfaces_for
from embomatrix.skills.limits import ROBOT
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import IDENTITY, Aabb, Pose
from embomatrix.world.state import Relation

MAX_STANDS: Final = 72
"""Maximum number of robot positions in a brief. More positions only cost time."""
LOWEST_M: Final = 0.05
HIGHEST_M: Final = 1.75
"""Surfaces between these heights above the floor are preferred."""
RIM_M: Final = 0.01
FLOOR_RIM_M: Final = 0.02
"""Free strip at the edge of a surface, and at walls."""


@dataclass(frozen=True, slots=True)
class Plane:
    """Rectangle that objects can stand on. ``pose`` is the pose of its centre in the world, with x and y along its sides.

    ``host`` is the object that the surface belongs to; it is empty for the floor of ``room``.
    """

    name: str
    host: str
    room: str
    pose: Pose
    size_m: Size2
    clearance_m: float

    @property
    def on_floor(self) -> bool:
        return not self.host


def planes_of(editor: SceneEditor, host: str) -> list[Plane]:
    """Return the floor of a room, or the open surfaces of an object, the largest at a preferred height first.

    Raise PlacementError.
    """
    if host in editor.rooms:
        room = editor.rooms[host]
        return [Plane(host, "", host, Pose((*room.center_m, 0.0)), room.size_m, math.inf)]
    item, asset = editor.known(host), editor.asset_of(host)
    found = []
    for surface in surfaces_for(asset, Relation.ONTOP):
        if surface.link:
            continue  # surfaces of drawers are left to the sampler
        pose = item.pose_world_asset @ Pose(surface.center_m)
        found.append(
            Plane(f"{host}:{surface.name}", host, item.room, pose, surface.size_m, surface.clearance_m)
        )
    if not found and asset.supports and all(interior.closed_by for interior in asset.interiors):
        # The top of a closed box, such as the lid of a chest, is a surface too; the rim of a bowl is none.
        x, y, z = asset.size_m
        pose = item.pose_world_asset @ Pose((0.0, 0.0, z / 2))
        found.append(Plane(f"{host}:top", host, item.room, pose, (x, y), math.inf))
    return sorted(
        found,
        key=lambda plane: (
            not LOWEST_M <= plane.pose.position_m[2] <= HIGHEST_M,
            -plane.size_m[0] * plane.size_m[1],
        ),
    )


def brief_for(
    editor: SceneEditor,
    plane: Plane,
    objects: Sequence[tuple[ObjectBrief, Asset]],
    constraints: Mapping[str, tuple[PlacementConstraint, ...]],
    seed: int,
) -> PlaneBrief:
    """Return the planar brief of a plane in its current state. Constraints use the scene's object names."""
    width, depth = plane.size_m
    return PlaneBrief(
        plane=plane.name,
        size_m=(width, depth),
        objects=tuple(
            PlaneObject(item.name, _extent(asset), constraints.get(item.name, ()), item.has_front)
            for item, asset in objects
        ),
        obstacles=tuple(_obstacles(editor, plane, max((a.size_m[2] for _, a in objects), default=0.0))),
        zones=tuple(_zones(editor, plane)) if plane.on_floor else (),
        stands=() if plane.on_floor else _stands(editor, plane),
        rim_m=min(FLOOR_RIM_M if plane.on_floor else RIM_M, min(width, depth) / 20),
        on_floor=plane.on_floor,
        seed=seed,
    )


def pose_at(
    plane: Plane, asset: Asset, spot: PlaneSpot, shift_m: Size2 = (0.0, 0.0), turn: float = 0.0
) -> Pose:
    """Return the world pose of an asset with its box centred at a spot and its underside on the plane.

    ``shift_m`` and ``turn`` move and rotate it slightly.
    """
    box = bounds_of(asset).box(IDENTITY)
    yaw = spot.yaw + turn
    cosine, sine = math.cos(yaw), math.sin(yaw)
    x, y, _ = box.center_m
    local = Pose.from_xyz_yaw(
        spot.center_m[0] + shift_m[0] - (cosine * x - sine * y),
        spot.center_m[1] + shift_m[1] - (sine * x + cosine * y),
        LIFT_M - box.low_m[2],
        yaw,
    )
    return plane.pose @ local


def objects_on(editor: SceneEditor, plane: Plane) -> tuple[tuple[str, str], ...]:
    """Return name and category of the objects on a plane."""
    if plane.on_floor:
        names = [n for n, item in editor.objects.items() if item.room == plane.room and not item.host]
    else:
        names = [n for n, item in editor.objects.items() if item.host == plane.host]
    return tuple((name, editor.asset_of(name).category) for name in names)


def _extent(asset: Asset) -> tuple[float, float, float]:
    return bounds_of(asset).box(IDENTITY).size_m


def _obstacles(editor: SceneEditor, plane: Plane, height_m: float) -> Iterator[PlaneFootprint]:
    """Yield everything that reaches into the space above the plane: objects as rotated boxes, the host by its parts."""
    ground = plane.pose.position_m[2]
    inverse = plane.pose.inverse()
    half = half_extents(np.asarray(plane.pose.yaw), plane.size_m)  # (2,)
    x, y, _ = plane.pose.position_m
    low, high = (x - half[0], y - half[1]), (x + half[0], y + half[1])
    for name, item in editor.objects.items():
        if item.absent:
            continue
        box = editor.box_of(name)
        if box.high_m[2] <= ground + 0.001 or box.low_m[2] >= ground + height_m:
            continue
        if any(box.high_m[i] <= low[i] or box.low_m[i] >= high[i] for i in (0, 1)):
            continue
        asset = editor.asset_of(name)
        pose = inverse @ item.pose_world_asset
        if name != plane.host:
            yield _footprint(name, pose, bounds_of(asset).box(IDENTITY))
            continue
        for number, part in enumerate(part for link in asset.links for part in link.parts):
            part_box = part.aabb(IDENTITY)
            if pose.position_m[2] + part_box.high_m[2] > 0.001:
                yield _footprint(f"{name}#{number}", pose, part_box)


def _footprint(name: str, pose: Pose, box: Aabb) -> PlaneFootprint:
    x, y, _ = pose.apply(box.center_m)
    z = pose.position_m[2]
    return PlaneFootprint(name, (x, y), pose.yaw, box.size_m[:2], z + box.low_m[2], z + box.high_m[2])


def _zones(editor: SceneEditor, plane: Plane) -> Iterator[tuple[float, float, float, float]]:
    x, y, _ = plane.pose.position_m
    for x0, y0, x1, y1 in editor.clearance.doorway_floor(plane.room):
        yield (x0 - x, y0 - y, x1 - x, y1 - y)


def _stands(editor: SceneEditor, plane: Plane) -> tuple[Size2, ...]:
    """Return evenly thinned robot positions near the plane, in its frame. Furniture with doors is served from its front."""
    x, y, _ = plane.pose.position_m
    away = math.hypot(*plane.size_m) / 2 + ROBOT.reach_m
    cells = editor.floor.cells((x - away, y - away), (x + away, y + away))  # (n, 2)
    yaw = plane.pose.yaw
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    local = (cells - (x, y)) @ turn  # rows times the rotation are its inverse applied to columns
    if editor.asset_of(plane.host).joints:
        local = local[local[:, 0] > 0.0]
    step = max(1, len(local) // MAX_STANDS)
    return tuple((float(a), float(b)) for a, b in local[step // 2 :: step][:MAX_STANDS])
