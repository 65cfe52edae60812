"""Background objects in both execution modes: solid, static, without a name."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import pytest
from tests.fakes import furniture as make
from tests.fakes.scenes import kitchen_scene, upright

from embomatrix.sim.bullet.dynamic import DynamicWorld
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.bullet.robot import tucked
from embomatrix.sim.bullet.settling import settle_scene
from embomatrix.sim.engine import BACKGROUND, WALL, EngineError
from embomatrix.sim.executor import Simulator
from embomatrix.sim.physical.space import boxes_around
from embomatrix.skills.failure import FailureReason
from embomatrix.world.bundle import Bundle, decode_bundle, encode_bundle
from embomatrix.world.codec import scene_from_json, scene_to_json
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import StandPose
from embomatrix.world.records import SceneInvalidError
from embomatrix.world.scene import BackgroundObject, Scene
from embomatrix.world.state import Relation

TABLE_M = 0.75
"""Height of the kitchen table."""


def with_bowls(count: int) -> Scene:
    """Return the kitchen with bowls of the background in a row on its table."""
    scene, bowl = kitchen_scene(), make.bowl()
    return replace(
        scene,
        background=tuple(
            BackgroundObject(
                bowl.asset_id,
                "kitchen_0",
                upright(1.6 + number * 0.01, 1.3, TABLE_M + 0.0005, bowl),
                "breakfast_table_1",
            )
            for number in range(count)
        ),
    )


@pytest.fixture
def engine():
    with contextlib.closing(BulletEngine(with_bowls(20))) as engine:
        yield engine


def test_object_in_the_background_penetrates_it(engine) -> None:
    apple = make.apple()
    engine.set_pose("apple_1", upright(1.6, 1.3, TABLE_M + 0.01, apple))
    assert engine.penetrates("apple_1") == BACKGROUND
    assert engine.penetrates("apple_1", ignore=frozenset((BACKGROUND,))) == ""
    engine.set_pose("apple_1", upright(1.6 + 19 * 0.01, 1.3, TABLE_M + 0.01, apple))
    assert engine.penetrates("apple_1") == BACKGROUND


def test_wall_comes_before_background(engine) -> None:
    engine.set_pose("apple_1", Pose((-0.05, 1.3, 1.0)))
    assert engine.penetrates("apple_1") == WALL


def test_object_let_go_over_the_background_comes_to_rest_on_it(engine) -> None:
    apple, bowl = make.apple(), make.bowl()
    engine.set_pose("apple_1", upright(1.7, 1.3, TABLE_M + bowl.size_m[2] + 0.002, apple))
    settled = engine.settle("apple_1")
    assert settled.pose.position_m[2] - apple.size_m[2] / 2 > TABLE_M + bowl.size_m[2] - 0.005


def test_sixteen_background_objects_share_a_body() -> None:
    def bodies(count: int) -> int:
        with contextlib.closing(BulletEngine(with_bowls(count))) as engine:
            return sum(1 for _ in engine.warm_up())

    assert [bodies(count) - bodies(0) for count in (1, 16, 17, 40)] == [1, 1, 2, 3]


def test_whole_scene_settles_around_the_background() -> None:
    scene = with_bowls(1)
    assert settle_scene(scene).unstable == settle_scene(kitchen_scene()).unstable == ()


def test_arm_and_dynamic_world_meet_the_background(engine) -> None:
    assert BACKGROUND in boxes_around(engine, (1.0, 1.0), (2.0, 2.0)).owners
    assert BACKGROUND not in boxes_around(engine, (3.0, 3.0), (4.0, 3.5)).owners
    scene = engine.scene
    with contextlib.closing(DynamicWorld(scene)) as world:
        poses = {item.name: item.pose_world_asset for item in scene.objects}
        world.build(
            poses, {item.name: item.joints for item in scene.objects}, tucked(StandPose(3.5, 1.5, 0.0))
        )
        bodies = [body for body in range(500) if world.bodies.name(body) == BACKGROUND]
        assert len(bodies) == 2


def test_place_avoids_the_background_and_names_it_when_the_table_is_full() -> None:
    scene, bowl = kitchen_scene(), make.bowl()
    step = bowl.size_m[0] + 0.001
    full = tuple(
        BackgroundObject(bowl.asset_id, "kitchen_0", upright(x * step, y * step, TABLE_M + 0.0005, bowl))
        for x in range(40)
        for y in range(40)
        if scene.box_of("breakfast_table_1").grown(0.2).contains((x * step, y * step, 0.4), 0.0)
    )
    clear = [item for item in scene.objects if item.host != "breakfast_table_1"]
    scene = replace(scene, objects=tuple(clear), background=full)
    with contextlib.closing(Simulator(Bundle(scene, {}), BulletEngine(scene))) as simulator:
        simulator.world.engine.park("mug_1")
        reason, other = simulator.world.placer.hindrance(
            "mug_1", "breakfast_table_1", Relation.ONTOP, [simulator.world.robot]
        )
    assert (reason, other) in {
        (FailureReason.NO_FREE_POSE, BACKGROUND),
        (FailureReason.PLACES_OUT_OF_REACH, ""),
    }


def test_scene_with_background_survives_json_and_a_bundle() -> None:
    scene = with_bowls(3)
    assert scene_from_json(scene_to_json(scene)) == scene
    assert decode_bundle(encode_bundle(Bundle(scene, {}))).scene == scene


def test_scene_without_background_encodes_as_before() -> None:
    assert "background" not in scene_to_json(kitchen_scene())


@pytest.mark.parametrize(
    ("key", "value", "field"),
    [
        ("asset_id", "vase-none", "scene.background[0].asset_id"),
        ("room", "attic_0", "scene.background[0].room"),
        ("host", "altar_1", "scene.background[0].host"),
        ("pose", 7, "scene.background[0].pose"),
    ],
)
def test_background_object_with_an_unknown_reference_is_refused(key, value, field) -> None:
    record = scene_to_json(with_bowls(1))
    record["background"][0][key] = value
    with pytest.raises(SceneInvalidError) as refused:
        scene_from_json(record)
    assert refused.value.field == field


def test_engine_refuses_a_background_object_without_an_asset() -> None:
    scene = with_bowls(1)
    broken = replace(scene, background=(replace(scene.background[0], asset_id="vase-none"),))
    with pytest.raises(EngineError, match="vase-none"):
        BulletEngine(broken)
