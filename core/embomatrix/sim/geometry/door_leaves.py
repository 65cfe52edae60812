"""Leaves of the doors between rooms, for pictures only: these doors always stand open, and the simulation has no leaves."""

from typing import Final

from embomatrix.world.geometry import Aabb, ConvexPart, Pose, Shape
from embomatrix.world.scene import Doorway, Scene

_LEAF_M: Final = 0.04
"""Thickness of a leaf."""
_WALL_M: Final = 0.12
"""Thickness of an inner wall."""
_GAP_M: Final = 0.02
"""Distance of a leaf from the wall or the jamb beside it."""
_WIDEST_M: Final = 1.2
"""Wider openings are passages without a door."""


def door_leaves(scene: Scene) -> list[ConvexPart]:
    """Return an open leaf for each doorway between two rooms that has room for it, in the world frame.

    A leaf lies back against the wall on one side of the opening, or stands straight out from a jamb, wherever it touches no
    furniture. A doorway without such a place has a sliding door, which has vanished into the wall.
    """
    taken = [scene.box_of(item.name) for item in scene.objects if item.fixed and not item.absent]
    taken += scene.background_boxes
    leaves: list[ConvexPart] = []
    for doorway in scene.doorways:
        if doorway.rooms[1] and doorway.width_m <= _WIDEST_M:
            free = (
                box
                for box in _places(doorway)
                if _is_inside_a_room(scene, box) and not any(box.overlaps(other) for other in taken)
            )
            leaf = next(free, None)
            if leaf is not None:
                taken.append(leaf)
                leaves.append(ConvexPart(Shape.BOX, Pose(leaf.center_m), leaf.size_m))
    return leaves


def _places(doorway: Doorway) -> list[Aabb]:
    """Return the boxes of a leaf flat against the wall, then straight out from a jamb, on both sides of the wall."""
    half, width = doorway.width_m / 2, doorway.width_m
    flat = [
        (end * (half + _GAP_M), end * (half + _GAP_M + width), side * (_WALL_M / 2 + _GAP_M), side * _LEAF_M)
        for side in (1, -1)
        for end in (1, -1)
    ]
    boxes = [_box(doorway, start, stop, near, near + depth) for start, stop, near, depth in flat]
    for side in (1, -1):
        for end in (1, -1):
            near = side * (_WALL_M / 2)
            boxes.append(_box(doorway, end * (half - _LEAF_M), end * half, near, near + side * width))
    return boxes


def _box(doorway: Doorway, start: float, stop: float, near: float, far: float) -> Aabb:
    """Return a box from two offsets along the wall and two across it, from the middle of the opening."""
    x, y = doorway.center_m
    (a, b), (c, d) = sorted((start, stop)), sorted((near, far))
    top = doorway.height_m - _GAP_M
    if doorway.along == "x":
        return Aabb((x + a, y + c, 0.0), (x + b, y + d, top))
    return Aabb((x + c, y + a, 0.0), (x + d, y + b, top))


def _is_inside_a_room(scene: Scene, box: Aabb) -> bool:
    """Return True if all of the box lies in one room."""
    return any(
        room.contains(*box.low_m[:2], 0.0) and room.contains(*box.high_m[:2], 0.0) for room in scene.rooms
    )
