"""Bullet engine: exact state, distance queries, settling, and refused inputs."""

import dataclasses
import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fakes import furniture as make
from tests.fakes.scenes import kitchen_scene, placed, scene_of, upright

from embomatrix.sim.bullet.client import ClientPool, connect
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.bullet.mini_world import STAGES_KEPT
from embomatrix.sim.engine import FLOOR, WALL, EngineError
from embomatrix.sim.geometry.bounds import AssetBounds
from embomatrix.world.asset import Joint, JointKind, Link
from embomatrix.world.geometry import Aabb, ConvexPart, Pose, Shape
from embomatrix.world.scene import Scene

MOVABLE = ("bowl_1", "apple_1", "chicken_leg_1", "mug_1", "table_lamp_1", "apple_2")


@pytest.fixture(scope="module")
def pool():
    pool = ClientPool()
    yield pool
    pool.close()


@pytest.fixture
def engine(pool):
    engine = BulletEngine(kitchen_scene(), pool)
    yield engine
    engine.close()


def test_kitchen_is_free_of_penetration(engine) -> None:
    assert {name: engine.penetrates(name) for name in engine.scene.by_name if engine.penetrates(name)} == {}


def test_small_objects_rest_where_the_scene_places_them(engine) -> None:
    for name in MOVABLE:
        settled = engine.settle(name)
        assert settled.stable, name
        assert settled.moved_m < 1e-3, name


@settings(max_examples=15, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(MOVABLE), st.integers(0, 2**31)), min_size=1, max_size=12))
def test_reset_is_bit_exact_after_any_teleports(pool, changes) -> None:
    engine = BulletEngine(kitchen_scene(), pool)
    before = engine.state_bytes()
    gaps = [engine.gap(name, "breakfast_table_1", 50.0) for name in MOVABLE]
    for name, seed in changes:
        rng = np.random.default_rng(seed)
        engine.set_pose(
            name, Pose.from_xyz_yaw(*rng.uniform(0.0, 4.0, 3).tolist(), float(rng.uniform(-3, 3)))
        )
        engine.set_joints("fridge_1", [float(rng.random())])
        if rng.random() < 0.3:
            engine.park(name)
    assert engine.state_bytes() != before
    engine.reset()
    assert engine.state_bytes() == before
    assert [engine.gap(name, "breakfast_table_1", 50.0) for name in MOVABLE] == gaps
    engine.close()


def test_engines_with_different_histories_agree_to_the_bit(pool) -> None:
    first, second = BulletEngine(kitchen_scene(), pool), BulletEngine(kitchen_scene())
    for name in MOVABLE:
        first.settle(name)
    for engine in (first, second):
        engine.set_pose("apple_1", Pose((2.3, 3.6, 0.945)))
    assert first.settle("apple_1") == second.settle("apple_1")
    assert first.state_bytes() == second.state_bytes()
    first.close()
    second.close()


def test_settling_has_no_memory(engine, pool) -> None:
    poses = {name: engine.pose(name) for name in MOVABLE}
    lifted = {
        name: Pose((x, y, z + 0.004), pose.quat_xyzw)
        for name, pose in poses.items()
        for x, y, z in [pose.position_m]
    }
    fresh = {}
    for name in MOVABLE:
        engine.set_pose(name, lifted[name])
        other = BulletEngine(engine.scene, pool)
        other.set_pose(name, lifted[name])
        fresh[name] = other.settle(name)
        other.close()
        engine.set_pose(name, poses[name])
    rng = np.random.default_rng(5)
    for _ in range(STAGES_KEPT + 60):  # the client is emptied in between
        name = MOVABLE[int(rng.integers(len(MOVABLE)))]
        engine.set_pose(name, lifted[name])
        assert engine.settle(name) == fresh[name]
        engine.set_pose(name, poses[name])


def test_settling_changes_nothing(engine) -> None:
    before = engine.state_bytes()
    engine.settle("mug_1")
    assert engine.state_bytes() == before


def test_unsupported_object_falls_and_is_unstable(engine) -> None:
    engine.set_pose("mug_1", Pose((3.0, 1.5, 1.0)))
    settled = engine.settle("mug_1")
    assert not settled.stable
    assert settled.pose.position_m[2] < 0.95


def test_object_on_an_edge_tips_over(engine) -> None:
    engine.set_pose("table_lamp_1", Pose((2.0, 1.3 + 0.69, 0.95)))
    assert not engine.settle("table_lamp_1", steps=240).stable


@pytest.mark.parametrize(
    ("name", "pose", "expected"),
    [
        ("apple_1", Pose((1.0, 1.0, 0.03)), FLOOR),
        ("apple_1", Pose((0.02, 1.0, 1.0)), WALL),
        ("apple_1", Pose((2.0, 1.3, 0.75)), "breakfast_table_1"),
        ("apple_1", Pose((2.0, 1.3, 0.7895)), ""),
        ("mug_1", Pose((0.6, 3.32, 0.8)), "fridge_1"),
        ("chicken_leg_1", Pose((2.2, 3.7, 0.92)), "countertop_1"),
    ],
)
def test_penetration_names_the_body(engine, name, pose, expected) -> None:
    engine.set_pose(name, pose)
    assert engine.penetrates(name) == expected


def test_ignored_object_is_not_reported(engine) -> None:
    engine.set_pose("apple_1", Pose((2.0, 1.3, 0.73)))
    assert engine.penetrates("apple_1", ignore=frozenset(("breakfast_table_1",))) == ""


def test_margin_finds_near_objects(engine) -> None:
    engine.set_pose("apple_1", Pose((2.0, 1.3, 0.75 + 0.04 + 0.003)))
    assert engine.penetrates("apple_1") == ""
    assert engine.penetrates("apple_1", margin_m=0.006) == "breakfast_table_1"


def test_parked_object_collides_with_nothing_until_it_is_put_back(engine) -> None:
    bowl = engine.pose("bowl_1")
    engine.park("bowl_1")
    assert engine.is_parked("bowl_1")
    engine.set_pose("mug_1", Pose((2.1, 1.0, 0.805)))
    assert engine.penetrates("mug_1") == ""
    assert "bowl_1" not in engine.near(engine.aabb("mug_1"))
    with pytest.raises(EngineError, match="parked"):
        engine.gap("bowl_1", "mug_1", 1.0)
    engine.set_pose("bowl_1", bowl)
    assert not engine.is_parked("bowl_1")
    assert engine.penetrates("mug_1") == "bowl_1"


def test_gap_is_the_distance_between_the_surfaces(engine) -> None:
    engine.set_pose("apple_1", Pose((2.0, 1.3, 0.75 + 0.04 + 0.02)))
    assert engine.gap("apple_1", "breakfast_table_1", 0.1) == pytest.approx(0.02, abs=1e-4)
    assert engine.gap("apple_1", "breakfast_table_1", 0.01) is None
    engine.set_pose("apple_1", Pose((2.0, 1.3, 0.75 + 0.04 - 0.01)))
    assert engine.gap("apple_1", "breakfast_table_1", 0.0) == pytest.approx(-0.01, abs=1e-3)


def test_open_door_swings_out_and_collides_there(engine) -> None:
    shut = engine.aabb("fridge_1")
    engine.set_joints("fridge_1", (1.0,))
    opened = engine.aabb("fridge_1")
    assert engine.joints("fridge_1") == (1.0,)
    assert shut.low_m[1] - opened.low_m[1] == pytest.approx(0.68, abs=0.01)
    engine.set_pose("mug_1", Pose((opened.high_m[0] - 0.02, opened.low_m[1] + 0.1, 0.8)))
    assert engine.penetrates("mug_1") == "fridge_1"
    engine.set_joints("fridge_1", (0.0,))
    assert engine.penetrates("mug_1") == ""
    assert engine.aabb("fridge_1") == shut


def test_hull_beside_other_parts_collides(pool) -> None:
    chicken, board = make.chicken_leg(), make.coffee_table()
    hull = chicken.links[0].parts[0]
    lumpy = dataclasses.replace(
        board,
        links=(Link("base", (*board.links[0].parts, dataclasses.replace(hull, pose=Pose((0, 0, 0.25))))),),
        size_m=(0.6, 1.0, 0.55),
    )
    apple = make.apple()
    scene = scene_of(
        "lumpy",
        [
            (placed("lumpy_1", lumpy, "kitchen_0", Pose((2, 2, 0.225)), fixed=True), lumpy),
            (placed("apple_1", apple, "kitchen_0", Pose((2, 2, 0.55))), apple),
        ],
    )
    engine = BulletEngine(scene, pool)
    assert engine.gap("apple_1", "lumpy_1", 0.2) == pytest.approx(0.01, abs=2e-3)
    engine.set_pose("apple_1", Pose((2, 2, 0.53)))
    assert engine.penetrates("apple_1") == "lumpy_1"
    engine.close()


def test_drawer_slides_along_its_axis(pool) -> None:
    box = make.block("chest", "chest.n.01", (0.4, 0.4, 0.4), {})
    front = ConvexPart(Shape.BOX, Pose((0.21, 0, 0)), (0.02, 0.4, 0.3))
    drawer = Link("drawer", (front,), Joint(JointKind.PRISMATIC, (0.2, 0.0, 0.0), (1.0, 0.0, 0.0), 0.3))
    chest = dataclasses.replace(box, links=(*box.links, drawer))
    item = placed("chest_1", chest, "kitchen_0", upright(2, 2, 0, chest), fixed=True)
    apple = placed("apple_1", make.apple(), "kitchen_0", Pose((2.51, 2, 0.2)))
    engine = BulletEngine(scene_of("chest", [(item, chest), (apple, make.apple())]), pool)
    assert engine.penetrates("apple_1") == ""
    engine.set_joints("chest_1", (1.0,))
    assert engine.aabb("chest_1").high_m[0] == pytest.approx(2.52)
    assert engine.penetrates("apple_1") == "chest_1"
    engine.close()


@settings(max_examples=30, deadline=None)
@given(st.floats(-math.pi, math.pi), st.floats(-math.pi / 2, math.pi / 2), st.integers(0, 5))
def test_bounds_enclose_every_part_tightly(yaw, roll, pick) -> None:
    asset = (make.mug(), make.apple(), make.bowl(), make.table_lamp(), make.chicken_leg(), make.fridge())[
        pick
    ]
    lean = Pose((0, 0, 0), (math.sin(roll / 2), 0.0, 0.0, math.cos(roll / 2)))
    pose = Pose.from_xyz_yaw(1.0, 2.0, 3.0, yaw) @ lean
    box = AssetBounds(asset).box(pose, (0.0,) * len(asset.joints))
    loose = Aabb.around(part.aabb(pose) for link in asset.links for part in link.parts)
    for axis in range(3):
        assert loose.low_m[axis] - 1e-9 <= box.low_m[axis]
        assert box.high_m[axis] <= loose.high_m[axis] + 1e-9
        assert box.low_m[axis] <= pose.position_m[axis] <= box.high_m[axis]


def test_apple_has_the_same_box_however_it_is_turned() -> None:
    bounds = AssetBounds(make.apple())
    turned = bounds.box(Pose.from_xyz_yaw(0, 0, 0, 0.7))
    assert turned.size_m == pytest.approx((0.08, 0.08, 0.08))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda e: e.pose("unicorn_1"), "no object 'unicorn_1'"),
        (
            lambda e: e.set_pose("apple_1", Pose((math.nan, 0, 0))),
            "finite coordinates",
        ),
        (lambda e: e.set_pose("apple_1", Pose((0, 0, 0), (0, 0, 0, 0))), "quaternion of length"),
        (lambda e: e.set_joints("fridge_1", ()), "expected 1, one for each joint"),
        (lambda e: e.set_joints("fridge_1", (math.nan,)), "from 0 to 1"),
        (lambda e: e.set_joints("fridge_1", (1.5,)), "from 0 to 1"),
        (lambda e: e.gap("apple_1", "mug_1", math.nan), "limit"),
    ],
)
def test_values_that_physics_cannot_take_are_refused(engine, call, words) -> None:
    before = engine.state_bytes()
    with pytest.raises(EngineError, match=words):
        call(engine)
    assert engine.state_bytes() == before


def _with_asset(**changes: object) -> Scene:
    apple = dataclasses.replace(make.apple(), **changes)  # type: ignore[arg-type]
    return scene_of("broken", [(placed("apple_1", apple, "kitchen_0", Pose((1, 1, 1))), apple)])


def _base(*parts: ConvexPart) -> dict[str, object]:
    return {"links": (Link("base", parts),)}


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (_with_asset(**_base(*[make.box((0, 0, 0), (0.1, 0.1, 0.1))] * 17)), "parts: .*length <= 16"),
        (
            _with_asset(**_base(make.box((0, 0, 0), (0.1, 0.0, 0.1)))),
            r"size_m\[1\]: found 0.0: expected `float` > 0.001",
        ),
        (
            _with_asset(**_base(make.box((0, 0, math.inf), (0.1, 0.1, 0.1)))),
            r"pose\[2\]: found inf: expected `float`",
        ),
        (_with_asset(**_base()), "parts: .*length >= 1"),
        (_with_asset(mass_kg=math.nan), "mass_kg: found nan: expected `float` > 0.0"),
        (_with_asset(links=(*make.apple().links, *make.apple().links)), "a joint for every other link"),
        (
            _with_asset(
                links=(
                    *make.apple().links,
                    Link(
                        "lid",
                        make.apple().links[0].parts,
                        Joint(JointKind.REVOLUTE, (0, 0, 0), (0, 0, 0), 1.0),
                    ),
                )
            ),
            "expected 1|axis",
        ),
    ],
)
def test_broken_assets_are_refused_before_bullet_sees_them(scene, words) -> None:
    items = tuple(
        dataclasses.replace(item, joints=(0.0,) * len(scene.asset_of(item.name).joints))
        for item in scene.objects
    )
    with pytest.raises(EngineError, match=words):
        BulletEngine(dataclasses.replace(scene, objects=items))


def test_scene_with_a_duplicate_name_or_unknown_asset_is_refused() -> None:
    scene = kitchen_scene()
    twice = dataclasses.replace(scene, objects=(*scene.objects, scene.objects[0]))
    with pytest.raises(EngineError, match="two bodies are called 'countertop_1'"):
        BulletEngine(twice)
    lost = dataclasses.replace(scene.objects[0], name="ghost_1", asset_id="ghost-aaaaaa")
    with pytest.raises(EngineError, match="unknown asset 'ghost-aaaaaa'"):
        BulletEngine(dataclasses.replace(scene, objects=(lost,)))


def test_pool_hands_out_the_client_that_was_given_back() -> None:
    pool = ClientPool(spare=1)
    client = pool.take()
    pool.give_back(client)
    assert pool.take() == client
    pool.give_back(client)
    pool.close()


def test_renderer_is_gone_from_every_client() -> None:
    client = connect()
    body = client.createMultiBody(0)
    with pytest.raises(client.error):
        client.getVisualShapeData(body)
    client.disconnect()


def test_loading_prints_nothing() -> None:
    code = "from embomatrix.sim.bullet.client import connect; connect()"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=60, check=True)
    assert (result.stdout, result.stderr) == (b"", b"")
