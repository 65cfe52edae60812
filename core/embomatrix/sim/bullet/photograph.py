"""Fine pictures of a scene: Bullet's renderer gives depths and bodies, `looks` gives materials, soft light and sky."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.bullet.visual_scene import VisualScene
from embomatrix.sim.looks.light import ShadowMap, shadow_maps
from embomatrix.sim.looks.rooms import PANE, wall_of
from embomatrix.sim.looks.shading import FIGURE, FINER, NOTHING, Rendering, RoomTints, shaded
from embomatrix.sim.looks.surfaces import HullPlanes, table_of
from embomatrix.sim.looks.view import View
from embomatrix.world.geometry import Aabb

MAP_PX: Final = 384
"""Side of the depth map of a light."""
BESIDE_WALL_M: Final = 0.13
"""Walls within this distance of a room get its colour."""


@dataclass(frozen=True, slots=True)
class SeenObject:
    """Object in a picture: its name, the pixel in the middle of what is seen of it, and the number of its pixels."""

    name: str
    column: int
    row: int
    pixels: int


@dataclass(frozen=True)
class Photo:
    """Picture as RGB values, shape (height, width, 3), and the objects that it shows, largest first."""

    pixels: NDArray[np.uint8]
    seen: tuple[SeenObject, ...]


class Photographer:
    """Takes fine pictures of one stage. Light maps are kept until an object moves or another region is lit."""

    def __init__(self, stage: VisualScene) -> None:
        self._stage = stage
        self._planes = HullPlanes()
        self._lit: tuple[int, Aabb] | None = None
        self._maps: tuple[ShadowMap, ...] = ()

    def shoot(
        self, view: View, region: Aabb, width_px: int, height_px: int, *, outdoors: bool = False
    ) -> Photo:
        """Render a view with soft light in a region.

        ``outdoors`` shows sky and ground beside the house instead of a white page. The region is the part of the scene whose
        shadows are drawn; everything outside is lit.
        """
        buffers = self._stage.capture(view, FINER * width_px, FINER * height_px)
        bodies = sorted(self._stage.parts)
        row_of = np.full(max([*bodies, int(buffers.body.max())], default=0) + 2, FIGURE, np.int32)
        row_of[bodies] = np.arange(len(bodies))
        row_of[-1] = NOTHING  # body -1 is nothing
        rendering = Rendering(view, buffers.depth, row_of[buffers.body], buffers.color)
        parts = [self._stage.parts[body] for body in bodies]
        table = table_of([(seen.part, seen.pose, seen.material) for seen in parts], self._planes)
        pixels = shaded(rendering, table, self._light(region), self._tints(bodies), outdoors=outdoors)
        return Photo(pixels, self._seen(buffers.body[::FINER, ::FINER]))

    def _seen(self, body: NDArray[np.int32]) -> tuple[SeenObject, ...]:
        """Return the objects on a map of bodies, shape (height, width)."""
        owners = self._stage.owners
        names = sorted(set(owners.values()))
        number_of = np.full(max([*owners, int(body.max())], default=0) + 2, -1, np.int32)
        number_of[[*owners]] = [names.index(name) for name in owners.values()]
        numbers = number_of[body]
        rows, columns = np.nonzero(numbers >= 0)
        found = numbers[rows, columns]
        order = np.argsort(found, kind="stable")
        kinds, first = np.unique(found[order], return_index=True)
        seen = []
        for kind, points in zip(kinds.tolist(), np.split(order, first[1:]), strict=False):
            # The middle of a table may be hidden or between its legs: the pixel of the object next to it counts.
            apart = np.hypot(rows[points] - rows[points].mean(), columns[points] - columns[points].mean())
            nearest = points[int(np.argmin(apart))]
            seen.append(SeenObject(names[kind], int(columns[nearest]), int(rows[nearest]), len(points)))
        return tuple(sorted(seen, key=lambda each: (-each.pixels, each.name)))

    def _light(self, region: Aabb) -> tuple[ShadowMap, ...]:
        if self._lit != (self._stage.moves, region):
            self._maps = shadow_maps(
                region, MAP_PX, lambda view, side: self._stage.capture(view, side, side).depth
            )
            self._lit = (self._stage.moves, region)
        return self._maps

    def _tints(self, bodies: list[int]) -> RoomTints:
        rooms = self._stage.scene.rooms
        boxes = np.array([(*room.low_m, *room.high_m) for room in rooms], np.float32).reshape(-1, 4)
        boxes += np.array([-BESIDE_WALL_M, -BESIDE_WALL_M, BESIDE_WALL_M, BESIDE_WALL_M], np.float32)
        colors = np.array([wall_of(room.type) for room in rooms], np.float32).reshape(-1, 3) ** 2.2
        walls = [row for row, body in enumerate(bodies) if body in self._stage.walls]
        panes = [row for row, body in enumerate(bodies) if self._stage.parts[body].material is PANE]
        return RoomTints(boxes, colors, np.array(walls, np.intp), np.array(panes, np.intp))
