"""Density of homes: objects in their living rooms, bedrooms and bathrooms, background included."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from embomatrix.factory.clutter.background import HOMES
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.pages.figures import Better, Figure
from embomatrix.world.catalog import Catalog
from embomatrix.world.scene import Scene

GOALS: Final[Mapping[str, float]] = {"living_room": 35.0, "bedroom": 36.0, "bathroom": 31.0}
"""Least median of objects: about 15 % below the medians of 195 hand-made rooms of iTHOR, which are 38, 42 and 36."""


def homes() -> tuple[str, ...]:
    """Return the base scenes with a living room or a bedroom."""
    catalog = Catalog.load()
    return tuple(
        name
        for name in catalog.scene_ids
        if any(room.type in HOMES for room in catalog.inventory(name).rooms)
    )


def objects_by_room(scene: Scene) -> Mapping[str, int]:
    """Return the number of objects in each room, background included."""
    listed = Counter(item.room for item in scene.objects if not item.absent)
    return listed + Counter(item.room for item in scene.background)


def density_figures(scene_ids: Sequence[str], seed: int) -> tuple[Figure, ...]:
    """Return the median number of objects of a room, over the rooms of each type in base scenes. Builds these scenes."""
    found: defaultdict[str, list[int]] = defaultdict(list)
    for scene_id in scene_ids:
        for kind, count in _counts(build_base_scene(scene_id, seed=seed)):
            found[kind].append(count)
    return tuple(
        Figure(
            f"objects_per_{kind}", float(np.median(found[kind])), "", Better.HIGHER, len(found[kind]), goal
        )
        for kind, goal in GOALS.items()
        if found[kind]
    )


def _counts(scene: Scene) -> Iterator[tuple[str, int]]:
    counts = objects_by_room(scene)
    for room in scene.rooms:
        if room.type in GOALS:
            yield room.type, counts.get(room.name, 0)
