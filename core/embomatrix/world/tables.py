"""Numeric tables of a bundle: poses and convex parts as flat arrays, checked as whole columns.

The JSON of a bundle refers to poses and parts by row number. Reading arrays costs a tenth of reading the same numbers as text.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from embomatrix.world.geometry import ConvexPart, FloatArray, Pose, Shape, Vec3
from embomatrix.world.placements import SET_NUMBERS, Placements
from embomatrix.world.poses import StandPose
from embomatrix.world.records import (
    MAX_COORDINATE_M,
    MAX_VERTICES,
    MIN_EXTENT_M,
    UNIT_TOLERANCE,
    SceneInvalidError,
)

Arrays = Mapping[str, NDArray[np.generic]]

T = TypeVar("T")

MIN_SPREAD_M: Final = 5e-5
MAX_ROWS: Final = 100_000
"""Rows of all arrays whose rows become objects. The largest shipped bundle has 6,000."""
FLAT_HULL: Final = (
    "the hull's vertices lie in one point, on a line or in a plane: expected a body; give it thickness"
)
SHAPES: Final = tuple(Shape)
POSE_NUMBERS: Final = 7
COLUMNS: Final = ("poses", "parts", "kinds", "vertices", "stands", "sets", "spots")
"""``poses``: rows of x, y, z, qx, qy, qz, qw. ``parts``: rows of a pose and three extents. ``kinds``: per part, the index of
its shape in ``SHAPES`` and the number of its vertices, which follow one another in ``vertices``. ``stands``: rows of x, y
and yaw. ``sets`` and ``spots``: those of ``Placements``."""


@dataclass(frozen=True, slots=True)
class TableWriter:
    """Collects rows while a scene is encoded. Equal poses and equal parts share a row."""

    _poses: dict[bytes, int] = field(default_factory=dict)
    _parts: dict[bytes, tuple[int, ConvexPart]] = field(default_factory=dict)
    _stands: list[Vec3] = field(default_factory=list)
    _placements: dict[str, NDArray[np.generic]] = field(default_factory=dict)

    def pose(self, pose: Pose) -> int:
        # Compared by their bits: 0.0 and -0.0 are equal but encode differently.
        row = struct.pack("<7d", *pose.position_m, *pose.quat_xyzw)
        return self._poses.setdefault(row, len(self._poses))

    def part(self, part: ConvexPart) -> int:
        numbers = [*part.pose.position_m, *part.pose.quat_xyzw, *part.size_m]
        numbers += [value for vertex in part.vertices_m for value in vertex]
        key = struct.pack(f"<{len(numbers)}d", *numbers) + part.shape.encode()
        return self._parts.setdefault(key, (len(self._parts), part))[0]

    def stands(self, rows: Sequence[Vec3]) -> int:
        """Append rows of x, y and yaw; return the number of the first."""
        self._stands.extend(rows)
        return len(self._stands) - len(rows)

    def placements(self, sets: NDArray[np.int32], spots: FloatArray) -> None:
        """Set the arrays of ``Placements``."""
        self._placements.update(sets=sets, spots=spots)

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Arrays of ``COLUMNS``: int32 for ``kinds`` and ``sets``, float64 for the others."""
        parts = [part for _, part in self._parts.values()]
        rows = [(*part.pose.position_m, *part.pose.quat_xyzw, *part.size_m) for part in parts]
        vertices = [vertex for part in parts for vertex in part.vertices_m]
        kinds = [(SHAPES.index(part.shape), len(part.vertices_m)) for part in parts]
        return {
            "poses": np.frombuffer(b"".join(self._poses), dtype="<f8").reshape(-1, POSE_NUMBERS),
            "parts": np.array(rows, dtype=np.float64).reshape(-1, POSE_NUMBERS + 3),
            "kinds": np.array(kinds, dtype=np.int32).reshape(-1, 2),
            "vertices": np.array(vertices, dtype=np.float64).reshape(-1, 3),
            "stands": np.array(self._stands, dtype=np.float64).reshape(-1, 3),
            "sets": np.zeros((0, SET_NUMBERS), dtype=np.int32),
            "spots": np.zeros((0, POSE_NUMBERS)),
            **self._placements,
        }


class Tables:
    """Checked rows of a bundle as values. Raises SceneInvalidError for arrays that break a rule."""

    def __init__(self, arrays: Arrays) -> None:
        poses = _floats(arrays, "poses", POSE_NUMBERS)
        parts = _floats(arrays, "parts", POSE_NUMBERS + 3)
        vertices = _floats(arrays, "vertices", 3)
        stands = _floats(arrays, "stands", 3)
        rows = len(poses) + len(parts) + len(vertices) + len(stands)
        if rows > MAX_ROWS:
            raise SceneInvalidError(
                "tables",
                f"have {rows:,} poses, parts, vertices and standing poses: expected at most {MAX_ROWS:,}",
            )
        _check_poses("poses", poses)
        _check_poses("parts", parts[:, :POSE_NUMBERS])
        sizes = parts[:, POSE_NUMBERS:]
        _check_rows("parts", sizes, sizes.min(axis=1, initial=1) > MIN_EXTENT_M, "an extent of 1 mm or less")
        _check_rows("parts", sizes, sizes.max(axis=1, initial=1) <= MAX_COORDINATE_M, "an extent above 10 km")
        self._poses = [Pose((x, y, z), (a, b, c, d)) for x, y, z, a, b, c, d in poses.tolist()]
        self._stands = stands
        self._spots = _floats(arrays, "spots", POSE_NUMBERS)
        _check_poses("spots", self._spots)
        self._sets = _sets(arrays)
        self._parts = _parts(parts, _kinds(arrays, len(parts), len(vertices)), vertices)

    def placements(self, names: Sequence[str]) -> Placements:
        """Sets of verified poses; ``names`` are the assets that the sets refer to."""
        return Placements(names, self._sets, self._spots)

    def pose(self, row: object) -> Pose:
        return _at(self._poses, row, "pose")

    def part(self, row: object) -> ConvexPart:
        return _at(self._parts, row, "")

    def stands(self, spans: Mapping[str, tuple[int, int]]) -> dict[str, tuple[StandPose, ...]]:
        """Standing poses of objects by name; each span is the first row and the number of rows."""
        rows = [StandPose(x, y, yaw) for x, y, yaw in self._stands.tolist()]
        for name, (first, count) in spans.items():
            if first + count > len(rows):
                raise SceneInvalidError(
                    f"poses.stands[{name!r}]", f"found rows {first} to {first + count}: there are {len(rows)}"
                )
        return {name: tuple(rows[first : first + count]) for name, (first, count) in spans.items()}


def _at(values: Sequence[T], row: object, field: str) -> T:
    if not isinstance(row, int) or not 0 <= row < len(values):
        raise SceneInvalidError(field, f"found {str(row)[:40]}: expected a row from 0 to {len(values) - 1}")
    return values[row]


def check_unit(field: str, quat: Sequence[float]) -> None:
    """Raise SceneInvalidError unless a quaternion has length 1."""
    norm = math.hypot(*quat)
    if not abs(norm - 1.0) <= UNIT_TOLERANCE:
        raise SceneInvalidError(field, f"the quaternion has length {norm:.6g}: expected 1")


def has_volume(vertices: FloatArray) -> bool:
    """Return True if points, shape (n, 3), span a body thicker than 0.1 mm and within the world."""
    return bool(_have_volume(vertices, np.array([len(vertices)]))[0])


def _have_volume(vertices: FloatArray, counts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Apply ``has_volume`` to several bodies; each has ``counts`` consecutive points, at least one."""
    starts = np.concatenate(([0], np.cumsum(counts)[:-1]))
    within = np.maximum.reduceat(np.abs(vertices).max(axis=1), starts) <= MAX_COORDINATE_M
    means = np.add.reduceat(vertices, starts) / counts[:, None]  # (k, 3)
    with np.errstate(over="ignore", invalid="ignore"):  # ``within`` excludes these bodies
        offsets = vertices - np.repeat(means, counts, axis=0)
        squares = np.add.reduceat(offsets[:, :, None] * offsets[:, None, :], starts)  # (k, 3, 3)
    covariances = np.where(within[:, None, None], squares, 0.0) / counts[:, None, None]
    spreads = np.linalg.eigvalsh(covariances)  # (k, 3): variances along the principal axes, rising
    return np.asarray(within & (spreads[:, 0] >= MIN_SPREAD_M**2))


def _check_hulls(kinds: list[tuple[int, int]], vertices: FloatArray) -> None:
    hulls = [row for row, (_, count) in enumerate(kinds) if count]
    if hulls:
        sound = _have_volume(vertices, np.array([kinds[row][1] for row in hulls]))
        if not sound.all():
            raise SceneInvalidError(f"tables.parts[{hulls[int(np.argmin(sound))]}]", FLAT_HULL)


def _floats(arrays: Arrays, name: str, columns: int) -> FloatArray:
    """Float array with this number of columns, all finite."""
    array = arrays.get(name)
    if array is None or array.dtype != np.float64 or array.ndim != 2 or array.shape[1] != columns:
        found = "nothing" if array is None else f"{array.dtype} of shape {array.shape}"
        raise SceneInvalidError(f"tables.{name}", f"found {found}: expected float64 with {columns} columns")
    rows = np.asarray(array, dtype=np.float64)
    finite = np.asarray(np.isfinite(rows).all(axis=1), dtype=np.bool_)  # (n,)
    _check_rows(name, rows, finite, "a number that is not finite")
    return rows


def _check_poses(name: str, rows: FloatArray) -> None:
    x, y, z, w = rows[:, 3:].T
    with np.errstate(over="ignore"):  # an overflow fails the check
        off: FloatArray = np.abs(np.sqrt(x * x + y * y + z * z + w * w) - 1.0)  # (n,)
    _check_rows(name, rows, off <= UNIT_TOLERANCE, "a quaternion whose length is not 1")
    x, y, z = np.abs(rows[:, :3]).T
    near = np.maximum(np.maximum(x, y), z) <= MAX_COORDINATE_M
    _check_rows(name, rows, near, f"a position further than {MAX_COORDINATE_M:g} m from the origin")


def _check_rows(name: str, rows: FloatArray, sound: NDArray[np.bool_], what: str) -> None:
    if not sound.all():
        row = int(np.argmin(sound))
        raise SceneInvalidError(f"tables.{name}[{row}]", f"has {what}: {rows[row].tolist()}")


def _kinds(arrays: Arrays, parts: int, vertices: int) -> list[tuple[int, int]]:
    """Shape and number of vertices of each part."""
    kinds = arrays.get("kinds")
    if kinds is None or kinds.dtype != np.int32 or kinds.shape != (parts, 2):
        raise SceneInvalidError("tables.kinds", f"expected int32 of shape ({parts}, 2)")
    rows = [(int(shape), int(count)) for shape, count in kinds.tolist()]
    for row, (shape, count) in enumerate(rows):
        if not 0 <= shape < len(SHAPES):
            raise SceneInvalidError(
                f"tables.kinds[{row}]", f"found shape {shape}: expected 0 to {len(SHAPES) - 1}"
            )
        hull = SHAPES[shape] is Shape.HULL
        if not (4 <= count <= MAX_VERTICES if hull else count == 0):
            raise SceneInvalidError(
                f"tables.kinds[{row}]",
                f"a {SHAPES[shape].value} has {count} vertices: expected {f'4 to {MAX_VERTICES}' if hull else 0}",
            )
    if sum(count for _, count in rows) != vertices:
        raise SceneInvalidError(
            "tables.vertices", f"has {vertices} rows: expected as many as the parts have vertices"
        )
    return rows


def _sets(arrays: Arrays) -> NDArray[np.int32]:
    sets = arrays.get("sets")
    if sets is None or sets.dtype != np.int32 or sets.ndim != 2 or sets.shape[1] != SET_NUMBERS:
        raise SceneInvalidError("tables.sets", f"expected int32 with {SET_NUMBERS} columns")
    return np.asarray(sets, dtype=np.int32)


def _parts(rows: FloatArray, kinds: list[tuple[int, int]], vertices: FloatArray) -> list[ConvexPart]:
    points = [(x, y, z) for x, y, z in vertices.tolist()]
    _check_hulls(kinds, vertices)
    parts: list[ConvexPart] = []
    first = 0
    for (x, y, z, a, b, c, d, width, depth, height), (shape, count) in zip(rows.tolist(), kinds, strict=True):
        own = tuple(points[first : first + count])
        first += count
        parts.append(ConvexPart(SHAPES[shape], Pose((x, y, z), (a, b, c, d)), (width, depth, height), own))
    return parts
