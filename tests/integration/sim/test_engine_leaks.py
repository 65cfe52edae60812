"""Loading and closing scenes leaks nothing, in Python or in pybullet."""

import dataclasses
import gc
import sys
import weakref

from tests.fakes import furniture as make
from tests.fakes.scenes import kitchen_scene, placed, scene_of, upright

from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.asset import Link
from embomatrix.world.bundle import Bundle
from embomatrix.world.geometry import ConvexPart, Pose, Shape
from embomatrix.world.poses import PoseCache
from embomatrix.world.scene import Scene

LOADS = 100
CORNERS = tuple((x, y, z) for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1))


def scene_of_hulls() -> Scene:
    """Return a scene with two objects of one hull each. Assets are new at every call, as in a decoded bundle."""
    hull = ConvexPart(
        Shape.HULL, Pose((0.0, 0.0, 0.0)), (0.2, 0.2, 0.2), tuple((*corner,) for corner in CORNERS)
    )
    thing = dataclasses.replace(make.apple(), size_m=(0.2, 0.2, 0.2), links=(Link("base", (hull,)),))
    places = {"apple_1": 2.0, "apple_2": 3.0}
    return scene_of(
        "hulls",
        [(placed(name, thing, "kitchen_0", upright(x, 2.0, 0, thing)), thing) for name, x in places.items()],
    )


def blocks_after(loads: int, pool: ClientPool) -> int:
    for _ in range(loads):
        engine = BulletEngine(scene_of_hulls(), pool)
        engine.gap("apple_1", "apple_2", 5.0)  # makes their bodies
        engine.settle("apple_1")
        engine.close()
    gc.collect()
    return sys.getallocatedblocks()


def test_loading_and_closing_scenes_of_hulls_leaks_no_objects() -> None:
    pool = ClientPool()
    before = blocks_after(LOADS, pool)  # the first loads fill caches
    # A vertex that pybullet kept would be four blocks: 16 corners would leave 64 of them at each load.
    assert blocks_after(LOADS, pool) - before < 8 * LOADS
    pool.close()


def test_closed_scene_is_freed_without_a_garbage_collection() -> None:
    gc.collect()
    gc.disable()
    try:
        simulator = load_simulator(Bundle(kitchen_scene(), {}, PoseCache({}, {})))
        for _ in simulator.warm_up():
            pass
        world = simulator.world
        owners = [
            weakref.ref(item) for item in (world.engine, world.relations, world.navigator, world.placer)
        ]
        simulator.close()
        del simulator, world
        assert [owner() for owner in owners] == [None] * len(owners)
    finally:
        gc.enable()
