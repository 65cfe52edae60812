"""Rooms of base scenes: the truth of their furnishing, and the number of objects in rooms of homes, background included."""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from embomatrix.factory.clutter.background import HOMES
from embomatrix.factory.evaluate.furnishing import NOTHING_COUNTED, furnishing_counts, furnishing_figures
from embomatrix.factory.metrics.figures import EvaluationFigures
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.pages.figures import Better, Figure
from embomatrix.world.scene import Scene

GOALS: Final[Mapping[str, float]] = {"living_room": 35.0, "bedroom": 36.0, "bathroom": 31.0}
"""Least median of objects: about 15 % below the medians of 195 hand-made rooms of iTHOR, which are 38, 42 and 36."""


def evaluate_rooms(scene_ids: Sequence[str], seed: int, progress: Callable[[int], None]) -> EvaluationFigures:
    """Build base scenes and return the figures of their furnishing and density."""
    counts = NOTHING_COUNTED
    found: defaultdict[str, list[int]] = defaultdict(list)
    for number, scene_id in enumerate(scene_ids, start=1):
        scene = build_base_scene(scene_id, seed=seed)
        counts = counts.plus(furnishing_counts(scene))
        if any(room.type in HOMES for room in scene.rooms):
            for kind, objects in _objects(scene):
                found[kind].append(objects)
        progress(number)
    density = tuple(
        Figure(
            f"objects_per_{kind}", float(np.median(found[kind])), "", Better.HIGHER, len(found[kind]), goal
        )
        for kind, goal in GOALS.items()
        if found[kind]
    )
    conditions = {"base scenes": len(scene_ids), "seed": seed}
    return EvaluationFigures("rooms", conditions, (*density, *furnishing_figures(counts)))


def objects_by_room(scene: Scene) -> Mapping[str, int]:
    """Return the number of objects in each room, background included."""
    listed = Counter(item.room for item in scene.objects if not item.absent)
    return listed + Counter(item.room for item in scene.background)


def _objects(scene: Scene) -> list[tuple[str, int]]:
    counts = objects_by_room(scene)
    return [(room.type, counts.get(room.name, 0)) for room in scene.rooms if room.type in GOALS]
