"""Sight of the robot: objects that a straight line from its camera meets first.

The camera looks all around. Walls, furniture, closed doors and drawers hide what is behind or in them, and an object can be
told from afar only if it is large.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.sim.geometry.bounds import bounds_of

if TYPE_CHECKING:
    from embomatrix.sim.live_world import LiveWorld
    from embomatrix.world.geometry import Aabb, Vec3

EYE_M: Final = 1.35
"""Height of the camera above the floor, at the centre of the base."""
LEAST_SHARE: Final = 0.01
"""An object is told apart if its largest extent is at least this share of its distance: a cup of 8 cm up to 8 m away."""
FACE_SHARE: Final = 0.9
"""Points on the sides of a box are moved inwards, to this share of its extent."""
MOST_PARTS: Final = 8
"""Largest parts of an object whose centres are looked at, besides its box."""


def rows_in_sight(world: LiveWorld) -> tuple[int, ...]:
    """Rows of the task's table that the robot sees now, rising. The held object and its contents are always among them."""
    x, y = world.robot.x_m, world.robot.y_m
    eye = (x, y, EYE_M)
    seen = {row for row, name in enumerate(world.table) if name in world.carried}
    rows: list[int] = []
    points: list[Vec3] = []
    for row, name in enumerate(world.table):
        if row in seen or not world.is_real(name):
            continue
        box = world.engine.aabb(name)
        if max(box.size_m) >= LEAST_SHARE * box.level_distance_m(x, y):
            found = _points_of(world, name, box)
            points += found
            rows += [row] * len(found)
    met = world.engine.first_met(eye, points)
    seen.update(row for row, name in zip(rows, met, strict=True) if name == world.table[row])
    return tuple(sorted(seen))


def _points_of(world: LiveWorld, name: str, box: Aabb) -> list[Vec3]:
    """Return the centres of an object's box and of its sides, and those of its largest parts."""
    centre = box.center_m
    points = [centre]
    for axis, extent in enumerate(box.size_m):
        for sign in (-1, 1):
            shift = [0.0, 0.0, 0.0]
            shift[axis] = sign * FACE_SHARE * extent / 2
            points.append((centre[0] + shift[0], centre[1] + shift[1], centre[2] + shift[2]))
    parts = bounds_of(world.asset(name)).part_boxes(world.engine.pose(name), world.engine.joints(name))
    if len(parts) > 1:
        largest = sorted(parts, key=lambda part: -_volume(part))[:MOST_PARTS]
        points += [part.center_m for part in largest]
    return points


def _volume(box: Aabb) -> float:
    width, depth, height = box.size_m
    return width * depth * height
