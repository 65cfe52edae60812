"""Prepared arrays of a bundle change loading time only."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from tests.fakes.plans import plan_of, task_over
from tests.fakes.scenes import kitchen_scene

from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.executor import Simulator
from embomatrix.sim.floor.grid import grid_shape
from embomatrix.sim.floor.prepared import PreparedScene
from embomatrix.sim.live_world import prepare
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import Bundle, decode_bundle, encode_bundle
from embomatrix.world.goal import Atom

PLANS = (
    "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop",
    "move microwave_1; open microwave_1; move fridge_1; open fridge_1; pick_up chicken_leg_1; "
    "move microwave_1; place microwave_1 inside",
    "go_to_room living_room_0; move_forward 0.4 0.3; move bowl_1; pick_up bowl_1; move shelf_1; place shelf_1 ontop",
)


@pytest.fixture(scope="module")
def bundle():
    """Bundle of the flat, prepared by a used simulator and decoded from bytes."""
    scene = kitchen_scene()
    task = task_over(scene, Atom("open", ("fridge_1",)))
    bare = Bundle(scene, {task.task_id: task})
    with contextlib.closing(load_simulator(bare)) as simulator:
        simulator.execute(task, plan_of(task, PLANS[0]), 0)
        return decode_bundle(encode_bundle(prepare(bare, simulator.world)))


def _loaded(bundle):
    return contextlib.closing(Simulator(bundle, BulletEngine(bundle.scene, None, PreparedScene.of(bundle))))


def test_prepared_arrays_equal_derived_ones(bundle):
    found = PreparedScene.of(bundle)
    bare = replace(bundle, prepared={})
    with _loaded(bare) as derived, _loaded(bundle) as carried:
        boxes = tuple(derived.world.engine.aabb(item.name) for item in bundle.scene.objects)
        one, other = (world.world.navigator.ground.at_start for world in (derived, carried))
    assert boxes == found.object_boxes
    assert np.array_equal(one.grid.covered, other.grid.covered)
    assert np.array_equal(one.grid.free, other.grid.free)
    for column in ("boxes", "owners", "is_panel"):
        assert np.array_equal(getattr(one.obstacles, column), getattr(other.obstacles, column))


@pytest.mark.parametrize("plan", PLANS)
def test_traces_are_equal_with_and_without_prepared_arrays(bundle, plan):
    task = bundle.tasks["test"]
    traces = []
    for variant in (bundle, replace(bundle, prepared={})):
        with _loaded(variant) as simulator:
            traces.append(simulator.execute(task, plan_of(task, plan), 3))
    assert traces[0] == traces[1]
    assert traces[0].failure is None


def _without(arrays, name):
    return {key: array for key, array in arrays.items() if not key.endswith(name)}


@pytest.mark.parametrize(
    "spoil",
    [
        lambda arrays: {},
        lambda arrays: _without(arrays, "owners"),
        lambda arrays: {key.replace("1.", "0.", 1): array for key, array in arrays.items()},
        lambda arrays: arrays | {"1.objects": arrays["1.objects"][1:]},
        lambda arrays: arrays | {"1.objects": arrays["1.objects"] * np.nan},
        lambda arrays: arrays | {"1.objects": -arrays["1.objects"]},
        lambda arrays: arrays | {"1.owners": arrays["1.owners"] + 99},
        lambda arrays: arrays | {"1.covered": arrays["1.covered"][:, 1:]},
        lambda arrays: arrays | {"1.free": arrays["1.free"][1:]},
        lambda arrays: arrays | {"1.leaves": arrays["1.leaves"].astype(np.float64)},
        lambda arrays: arrays | {"1.obstacles": arrays["1.obstacles"].ravel()},
    ],
)
def test_mismatched_arrays_are_derived_instead(bundle, spoil):
    spoilt = replace(bundle, prepared=spoil(dict(bundle.prepared)))
    assert PreparedScene.of(spoilt) is None
    task = bundle.tasks["test"]
    with _loaded(spoilt) as simulator:
        assert simulator.execute(task, plan_of(task, PLANS[0]), 0).failure is None


def test_grid_covers_the_rooms(bundle):
    rows, columns = grid_shape(bundle.scene)
    assert (rows * 0.05, columns * 0.05) == pytest.approx((9.3, 4.2), abs=0.051)
