"""Placement: the first verified pose that is free and in reach, or a reason."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fakes.pose_caches import build_pose_cache
from tests.fakes.scenes import kitchen_scene

from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.floor.navigation import Navigator
from embomatrix.sim.placing.placement import Placer
from embomatrix.sim.placing.search import in_reach
from embomatrix.sim.state.relations import Relations
from embomatrix.skills.failure import FailureReason
from embomatrix.world.geometry import Aabb, Pose
from embomatrix.world.poses import PoseCache, StandPose
from embomatrix.world.state import Relation

PAIRS = (
    ("apple_1", "countertop_1", Relation.ONTOP),
    ("apple_1", "fridge_1", Relation.INSIDE),
    ("apple_1", "bowl_1", Relation.INSIDE),
    ("chicken_leg_1", "microwave_1", Relation.INSIDE),
    ("mug_1", "coffee_table_1", Relation.ONTOP),
    ("bowl_1", "breakfast_table_1", Relation.UNDER),
    ("mug_1", "sink_1", Relation.INSIDE),
    ("apple_1", "microwave_1", Relation.NEXTTO),
    ("mug_1", "fridge_1", Relation.NEXTTO),
)


@pytest.fixture(scope="module")
def engine():
    pool = ClientPool()
    engine = BulletEngine(kitchen_scene(), pool)
    yield engine
    engine.close()
    pool.close()


@pytest.fixture(scope="module")
def cache(engine):
    held = sorted({name for name, _, _ in PAIRS})
    supports = sorted({name for _, name, _ in PAIRS})
    return build_pose_cache(kitchen_scene(), held, supports, seed=0, engine=engine)


@pytest.fixture
def relations(engine):
    engine.reset()
    return Relations(engine)


@pytest.fixture
def placer(engine, relations, cache):
    return Placer(engine, relations, cache)


@pytest.fixture
def navigator(engine, relations):
    return Navigator(engine, relations)


@pytest.mark.parametrize(("held", "target", "relation"), PAIRS)
@pytest.mark.parametrize("cached", [True, False])
def test_found_pose_has_the_relation_and_is_reachable_free_and_stable(
    engine, relations, navigator, cache, held, target, relation, cached
) -> None:
    placer = Placer(engine, relations, cache if cached else PoseCache())
    robot = navigator.stands(target, navigator.start)[0]
    engine.park(held)
    for seed in range(3):
        pose = placer.find(held, target, relation, robot, np.random.default_rng(seed))
        assert isinstance(pose, Pose)
        engine.set_pose(held, pose)
        assert relations.holds(relation, held, target)
        assert engine.penetrates(held) == ""
        assert engine.settle(held).stable
        assert in_reach(engine.aabb(held), robot)
        engine.park(held)


def test_search_leaves_the_world_unchanged(engine, placer, navigator) -> None:
    robot = navigator.stands("countertop_1", navigator.start)[0]
    engine.park("apple_1")
    before = engine.state_bytes()
    placer.find("apple_1", "countertop_1", Relation.ONTOP, robot)
    assert engine.state_bytes() == before


def test_equal_seeds_choose_equal_poses_and_others_differ(engine, placer, navigator) -> None:
    robot = navigator.stands("countertop_1", navigator.start)[0]
    engine.park("apple_1")

    def pose(seed: int) -> Pose | FailureReason:
        return placer.find("apple_1", "countertop_1", Relation.ONTOP, robot, np.random.default_rng(seed))

    assert pose(3) == pose(3)
    assert len({pose(seed) for seed in range(8)}) > 1


def test_taken_poses_are_skipped(engine, placer, relations, navigator) -> None:
    robot = navigator.stands("coffee_table_1", navigator.start)[0]
    chosen = []
    for name in ("mug_1", "bowl_1", "apple_1", "chicken_leg_1", "table_lamp_1"):
        engine.park(name)
        pose = placer.find(name, "coffee_table_1", Relation.ONTOP, robot)
        assert isinstance(pose, Pose), name
        engine.set_pose(name, pose)
        chosen.append(name)
    for name in chosen:
        assert engine.penetrates(name) == ""
        assert relations.ontop(name, "coffee_table_1")


def test_full_bowl_takes_no_more(engine, placer, navigator) -> None:
    robot = navigator.stands("bowl_1", navigator.start)[0]
    for name in ("mug_1", "table_lamp_1"):
        engine.set_pose(
            name, Pose((2.1 if name == "mug_1" else 2.16, 1.0, 0.81 if name == "mug_1" else 0.97))
        )
    engine.park("chicken_leg_1")
    found = placer.find("chicken_leg_1", "bowl_1", Relation.INSIDE, robot)
    assert found is FailureReason.NO_FREE_POSE


@pytest.mark.parametrize(
    ("held", "target", "relation", "reason"),
    [
        ("mug_1", "stove_1", Relation.INSIDE, FailureReason.NO_CAVITY),
        ("table_lamp_1", "microwave_1", Relation.INSIDE, FailureReason.NO_CAVITY),
        ("mug_1", "stove_1", Relation.UNDER, FailureReason.NO_SURFACE),
        ("mug_1", "mug_1", Relation.ONTOP, FailureReason.PLACE_ON_ITSELF),
    ],
)
def test_impossible_placement_has_its_reason(
    engine, placer, navigator, held, target, relation, reason
) -> None:
    robot = navigator.start
    engine.park(held)
    assert placer.find(held, target, relation, robot) is reason


def test_out_of_reach_is_no_free_pose(engine, placer) -> None:
    engine.park("apple_1")
    far = StandPose(0.5, 0.5, 0.0)
    assert placer.find("apple_1", "countertop_1", Relation.ONTOP, far) is FailureReason.NO_FREE_POSE


def test_reach_is_measured_to_the_nearest_point_of_the_box() -> None:
    robot = StandPose(0.0, 0.0, 0.0)
    assert in_reach(Aabb((1.09, -1.0, 0.5), (1.5, 1.0, 0.6)), robot)
    assert not in_reach(Aabb((1.11, -1.0, 0.5), (1.5, 1.0, 0.6)), robot)
    assert not in_reach(Aabb((0.5, -1.0, 2.0), (1.5, 1.0, 2.2)), robot)


@pytest.mark.parametrize(("rim_m", "is_found"), [(1.5, True), (1.99, False)])
def test_rim_of_an_open_bowl_must_be_within_reach(rim_m, is_found) -> None:
    scene = kitchen_scene()
    bowl = scene.asset_of("bowl_1")
    open_bowl = replace(bowl, supports=tuple(replace(item, clearance_m=2.0) for item in bowl.supports))
    pool = ClientPool()
    engine = BulletEngine(replace(scene, assets={**scene.assets, bowl.asset_id: open_bowl}), pool)
    raised = Pose((0.0, 0.0, rim_m - engine.aabb("bowl_1").high_m[2])) @ engine.pose("bowl_1")
    engine.set_pose("bowl_1", raised)
    engine.park("apple_1")
    x, y, _ = raised.position_m
    placer = Placer(engine, Relations(engine), PoseCache())
    found = placer.find("apple_1", "bowl_1", Relation.INSIDE, StandPose(x - 0.5, y, 0.0))
    assert isinstance(found, Pose) if is_found else found is FailureReason.NO_FREE_POSE
    engine.close()
    pool.close()


def test_object_on_a_shelf_is_placed_within_reach(engine, relations, navigator) -> None:
    held, target, relation = "apple_1", "shelf_1", Relation.ONTOP
    heedless = Placer(engine, relations, PoseCache())
    heedful = Placer(engine, relations, PoseCache(), navigator)
    engine.park(held)

    def is_taken_back(robot: StandPose, pose: Pose) -> bool:
        engine.set_pose(held, pose)
        is_clear = navigator.line_is_clear(robot, held)
        engine.park(held)
        return is_clear

    x, y, _ = engine.aabb(target).center_m
    mattered = 0
    for dy in (-1.05, -0.7, 0.7, 1.05):
        robot = StandPose(x - 0.7, y + dy, 0.0)
        drawn = heedless.choices(held, target, relation, robot, np.random.default_rng(0), most=8)
        chosen = heedful.find(held, target, relation, robot, np.random.default_rng(0))
        assert not isinstance(drawn, FailureReason)
        assert isinstance(chosen, Pose)
        clear = [is_taken_back(robot, pose) for pose in drawn]
        assert is_taken_back(robot, chosen) is any(clear)
        mattered += any(clear) and not clear[0]
    assert mattered > 0
