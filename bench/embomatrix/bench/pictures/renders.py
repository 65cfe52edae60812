"""CPU time of pictures of base scenes: fast ones in flat colours, fine ones with patterns and soft light."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Final

from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.pages.figures import Better, Figure
from embomatrix.sim.bullet.camera import (
    box_of,
    eye_view,
    furnish_cutaway,
    furnish_whole,
    oblique_view,
    start_of,
    surroundings,
)
from embomatrix.sim.bullet.photograph import Photographer
from embomatrix.sim.bullet.visual_scene import VisualScene
from embomatrix.sim.looks.patterns import atlas
from embomatrix.sim.looks.view import View
from embomatrix.world.geometry import Aabb
from embomatrix.world.scene import Scene

SCENES: Final = (
    "Rs_int",
    "Wainscott_0_int",
    "Rs_garden",
    "hotel_suite_small",
    "restaurant_diner",
    "grocery_store_cafe",
    "office_bike",
    "school_chemistry",
)
"""Homes, a garden, a hotel, a restaurant, a shop, an office and a school."""
FAST_PX: Final = (320, 240)
FINE_PX: Final = (640, 480)
FAST_GOAL_MS: Final = 60.0
FINE_GOAL_S: Final = 1.0


def bench_renders(on_step: Callable[[str], None], scenes: Sequence[str] = SCENES) -> tuple[Figure, ...]:
    """Return medians and the longest CPU time of pictures: one oblique view and four views of the robot for each scene.

    The time covers renderer, light and shading, without loading the scene's bodies. Raises EngineError without pybullet.
    """
    atlas()
    fast: list[float] = []
    fast_large: list[float] = []
    first: list[float] = []
    later: list[float] = []
    for name in scenes:
        on_step(name)
        scene = build_base_scene(name, seed=0)
        for furnish, views, region in _shots(scene):
            with VisualScene(scene) as stage:
                furnish(stage)
                photographer = Photographer(stage)
                for number, view in enumerate(views):
                    fast.append(_cpu_s(partial(stage.shoot, view, *FAST_PX)))
                    fast_large.append(_cpu_s(partial(stage.shoot, view, *FINE_PX)))
                    fine = _cpu_s(partial(photographer.shoot, view, region, *FINE_PX, outdoors=True))
                    (later if number else first).append(fine)
    large = f"{FINE_PX[0]} x {FINE_PX[1]}"
    return (
        _figure("render_fast_ms", median(fast) * 1000, "ms", len(fast), FAST_GOAL_MS),
        _figure(f"render_fast_ms, {large}", median(fast_large) * 1000, "ms", len(fast_large)),
        _figure("render_fine_s", median(first), "s", len(first), FINE_GOAL_S),
        _figure("render_fine_s, longest", max(first), "s", len(first)),
        _figure("render_fine_s, next view of the same place", median(later), "s", len(later)),
    )


def _shots(scene: Scene) -> tuple[tuple[Callable[[VisualScene], None], list[View], Aabb], ...]:
    """Return for each stage how it is furnished, its views, and the region that is lit."""
    start, aspect = start_of(scene), FINE_PX[0] / FINE_PX[1]
    around = [eye_view(replace(start, yaw=start.yaw + turns * math.pi / 2), aspect) for turns in range(4)]
    return (
        (furnish_cutaway, [oblique_view(scene.rooms, aspect)], box_of(scene.rooms)),
        (furnish_whole, around, surroundings(scene, start)),
    )


def _cpu_s(action: Callable[[], object]) -> float:
    begun = time.process_time()
    action()
    return time.process_time() - begun


def _figure(name: str, value: float, unit: str, count: int, goal: float | None = None) -> Figure:
    return Figure(name, value, unit, Better.LOWER, count, goal)
