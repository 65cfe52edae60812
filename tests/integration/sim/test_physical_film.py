"""Films of physical mode: the arm moves, and objects move only while they are pushed or carried."""

import itertools
import math

import pytest
from tests.fakes.plans import plan_of, task_over
from tests.fakes.scenes import kitchen_scene

from embomatrix.sim.physical.actor import PhysicalActor
from embomatrix.sim.physical.film import film_physical
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import Bundle


@pytest.fixture(scope="module")
def film():
    bundle = Bundle(kitchen_scene(), {})
    actor = PhysicalActor(bundle)
    simulator = load_simulator(bundle, actor=actor)
    task = task_over(bundle.scene)
    film = film_physical(simulator, actor, task, plan_of(task, "move apple_1; pick_up apple_1"), 0)
    simulator.close()
    return film


def test_arm_reaches_and_lifts_the_object(film) -> None:
    assert [step.ok for step in film.steps] == [True, True]
    start = film.scene.by_name["apple_1"].pose_world_asset.position_m[2]
    assert film.frames[-1].poses["apple_1"].position_m[2] > start + 0.05
    assert len({frame.posture.arm for frame in film.frames if frame.step == 2}) > 5


def test_objects_move_continuously_between_frames(film) -> None:
    heights = [
        frame.poses.get("apple_1", film.scene.by_name["apple_1"].pose_world_asset).position_m
        for frame in film.frames
    ]
    assert max(math.dist(a, b) for a, b in itertools.pairwise(heights)) < 0.5


def test_untouched_objects_stay_in_place(film) -> None:
    moved = {name for frame in film.frames for name in frame.poses}
    assert moved == {"apple_1"}
