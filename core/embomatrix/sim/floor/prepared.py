"""Arrays derived from a scene in its initial state, computed once and carried in the bundle.

With them a worker measures no box and rasterises no floor when it loads the scene. Without them, or after a change of
``VERSION``, loading derives them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.engine import PhysicsEngine
from embomatrix.sim.floor.grid import FloorGrid, grid_shape
from embomatrix.sim.floor.obstacles import WALLS, Obstacles
from embomatrix.world.geometry import IDENTITY, Aabb, FloatArray
from embomatrix.world.scene import Scene

if TYPE_CHECKING:
    from embomatrix.world.bundle import Bundle

VERSION: Final = 1
"""Incremented with every change in the definition of a box, an obstacle or the floor grid."""
MOST_COVERED: Final = 255


class PreparedScene:
    """Arrays of one scene in its initial state, from a decoded bundle."""

    def __init__(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """``arrays`` must have passed the checks of ``of``."""
        self._arrays = arrays

    @staticmethod
    def of(bundle: Bundle) -> PreparedScene | None:
        """Arrays of a decoded bundle; None if this version can't use them."""
        found = {name: bundle.prepared[_key(name)] for name in _KINDS if _key(name) in bundle.prepared}
        if found.keys() != _KINDS.keys():
            return None
        return PreparedScene(found) if _are_sound(found, bundle.scene) else None

    @property
    def object_boxes(self) -> tuple[Aabb, ...]:
        """Boxes in the order of the scene's objects."""
        return _aabbs(self._arrays["objects"])

    @property
    def wall_boxes(self) -> tuple[Aabb, ...]:
        return _aabbs(self._arrays["walls"])

    @property
    def obstacles(self) -> Obstacles:
        """Obstacles of the robot."""
        is_panel = self._arrays["leaves"].astype(np.bool_)
        return Obstacles(self._arrays["obstacles"], self._arrays["owners"], is_panel)

    @property
    def covered(self) -> NDArray[np.int16]:
        """Number of obstacles over each cell of the floor grid, shape (rows, columns)."""
        return self._arrays["covered"].astype(np.int16)

    @property
    def free(self) -> NDArray[np.bool_]:
        """Free cells of the floor grid, shape (rows, columns)."""
        covered = self._arrays["covered"]
        bits = np.unpackbits(self._arrays["free"], count=covered.size)
        return bits.reshape(covered.shape).astype(np.bool_)


_KINDS: Final[Mapping[str, str]] = {
    "objects": "float64",
    "walls": "float64",
    "obstacles": "float64",
    "owners": "int32",
    "leaves": "uint8",
    "covered": "uint8",
    "free": "uint8",
}


def prepared_arrays(engine: PhysicsEngine, obstacles: Obstacles, grid: FloorGrid) -> dict[str, NDArray[Any]]:
    """Arrays for a bundle: boxes, obstacles and floor grid of the engine's scene in its initial state.

    Empty if more than 255 obstacles overlap anywhere: such a scene is not prepared.
    """
    covered = grid.covered
    if covered.max(initial=0) > MOST_COVERED:
        return {}
    scene = engine.scene
    arrays: dict[str, NDArray[Any]] = {
        "objects": _rows([engine.aabb(item.name) for item in scene.objects]),
        "walls": _rows([wall.aabb(IDENTITY) for wall in scene.walls]),
        "obstacles": obstacles.boxes,
        "owners": obstacles.owners,
        "leaves": obstacles.is_panel.astype(np.uint8),
        "covered": covered.astype(np.uint8),
        "free": np.packbits(grid.free),
    }
    return {_key(name): array for name, array in arrays.items()}


def _key(name: str) -> str:
    return f"{VERSION}.{name}"


def _rows(boxes: Sequence[Aabb]) -> FloatArray:
    return np.array([(*box.low_m, *box.high_m) for box in boxes], dtype=np.float64).reshape(-1, 6)


def _aabbs(rows: FloatArray) -> tuple[Aabb, ...]:
    return tuple(Aabb((a, b, c), (d, e, f)) for a, b, c, d, e, f in rows.tolist())


def _are_sound(arrays: Mapping[str, NDArray[Any]], scene: Scene) -> bool:
    """Return True if the arrays' shapes match one another and the scene. Values are not checked."""
    obstacles, owners, covered = arrays["obstacles"], arrays["owners"], arrays["covered"]
    count = len(scene.objects)
    return (
        all(array.dtype == _KINDS[name] for name, array in arrays.items())
        and _are_boxes(arrays["objects"], count)
        and _are_boxes(arrays["walls"], len(scene.walls))
        and obstacles.ndim == 2
        and obstacles.shape[1] == 6
        and bool(np.isfinite(obstacles).all())
        and owners.shape == arrays["leaves"].shape == obstacles.shape[:1]
        and bool(((owners >= WALLS) & (owners < count)).all())
        and covered.shape == grid_shape(scene)
        and arrays["free"].shape == (math.ceil(covered.size / 8),)
    )


def _are_boxes(rows: FloatArray, count: int) -> bool:
    shaped = rows.shape == (count, 6)
    return shaped and bool(np.isfinite(rows).all()) and bool((rows[:, :3] <= rows[:, 3:]).all())
