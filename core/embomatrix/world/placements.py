"""Verified placements of a bundle as flat arrays, converted to poses on demand.

An analysis finds thousands of poses and a rollout uses a few: loading a bundle converts none of them.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.world.geometry import FloatArray, Pose
from embomatrix.world.poses import PlacementKey
from embomatrix.world.records import SceneInvalidError
from embomatrix.world.state import Relation

RELATIONS: Final = tuple(Relation)
SET_NUMBERS: Final = 5
MAX_POSES: Final = 1024
"""Largest number of poses in a set."""


class Placements(Mapping[PlacementKey, tuple[Pose, ...]]):
    """Sets of poses by key.

    ``names`` are the assets. Each row of ``sets``, shape (m, 5), holds the index of the asset, of its support and of the
    relation in ``RELATIONS``, then the first row in ``spots`` and the number of rows. ``spots``, shape (n, 7), are poses.
    """

    def __init__(self, names: Sequence[str], sets: NDArray[np.int32], spots: FloatArray) -> None:
        """Raise SceneInvalidError for rows and indices out of range and for a duplicate set."""
        self._names = tuple(names)
        self._numbers = {name: number for number, name in enumerate(self._names)}
        self._spots = spots
        if len(self._numbers) != len(self._names):
            raise SceneInvalidError("poses.assets", "an asset stands there twice: expected each once")
        bounds = np.array([len(names), len(names), len(RELATIONS), len(spots) + 1, MAX_POSES + 1])
        wrong = np.flatnonzero(((sets < 0) | (sets >= bounds)).any(axis=1))
        wrong = wrong if len(wrong) else np.flatnonzero(sets[:, 3].astype(np.int64) + sets[:, 4] > len(spots))
        if len(wrong):
            row = int(wrong[0])
            raise SceneInvalidError(
                f"tables.sets[{row}]",
                f"found {sets[row].tolist()}: expected two of {len(names)} assets, one of {len(RELATIONS)} relations and "
                f"rows of {len(spots)}, at most {MAX_POSES} of them",
            )
        self._spans = {(a, b, c): (first, count) for a, b, c, first, count in sets.tolist()}
        if len(self._spans) != len(sets):
            raise SceneInvalidError("tables.sets", "a set stands there twice: expected each once")
        self._made: dict[PlacementKey, tuple[Pose, ...]] = {}

    def __getitem__(self, key: PlacementKey) -> tuple[Pose, ...]:
        if key not in self._made:
            first, count = self._spans[self._index(key)]
            rows = self._spots[first : first + count].tolist()
            self._made[key] = tuple(Pose((x, y, z), (a, b, c, d)) for x, y, z, a, b, c, d in rows)
        return self._made[key]

    def __contains__(self, key: object) -> bool:
        return isinstance(key, PlacementKey) and self._index(key) in self._spans

    def __iter__(self) -> Iterator[PlacementKey]:
        for a, b, c in self._spans:
            yield PlacementKey(self._names[a], self._names[b], RELATIONS[c])

    def __len__(self) -> int:
        return len(self._spans)

    def rows(self, key: PlacementKey) -> FloatArray:
        """Poses of one set, shape (n, 7): position and quaternion. Empty for an unknown set."""
        first, count = self._spans.get(self._index(key), (0, 0))
        return self._spots[first : first + count]

    def _index(self, key: PlacementKey) -> tuple[int, int, int]:
        """Index numbers of a set; -1 for unknown names."""
        numbers = self._numbers
        return (
            numbers.get(key.asset_id, -1),
            numbers.get(key.support_asset_id, -1),
            RELATIONS.index(key.relation),
        )


def rows_of(placements: Mapping[PlacementKey, tuple[Pose, ...]], key: PlacementKey) -> FloatArray:
    """Poses of one set, shape (n, 7): position and quaternion. Empty for an unknown set."""
    if isinstance(placements, Placements):
        return placements.rows(key)
    return pose_rows(placements.get(key, ()))


def pose_rows(poses: Sequence[Pose]) -> FloatArray:
    """Poses as rows, shape (n, 7): position and quaternion."""
    rows = [(*pose.position_m, *pose.quat_xyzw) for pose in poses]
    return np.array(rows, dtype=np.float64).reshape(-1, 7)


def flattened(
    placements: Mapping[PlacementKey, tuple[Pose, ...]],
) -> tuple[list[str], NDArray[np.int32], FloatArray]:
    """Names, sets and spots of ``Placements``, in the order of the mapping."""
    names: dict[str, int] = {}
    sets: list[tuple[int, ...]] = []
    spots: list[tuple[float, ...]] = []
    for key, poses in placements.items():
        held, support = (names.setdefault(name, len(names)) for name in (key.asset_id, key.support_asset_id))
        sets.append((held, support, RELATIONS.index(key.relation), len(spots), len(poses)))
        spots += [(*pose.position_m, *pose.quat_xyzw) for pose in poses]
    return (
        list(names),
        np.array(sets, dtype=np.int32).reshape(-1, SET_NUMBERS),
        np.array(spots, dtype=np.float64).reshape(-1, 7),
    )
