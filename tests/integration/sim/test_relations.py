"""Relations at their tolerances, and groups of objects that move together."""

import dataclasses
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fakes import furniture as make
from tests.fakes.scenes import kitchen_scene

from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.geometry.surfaces import EDGE_M, REST_M, is_shut, surface_under
from embomatrix.sim.state.relations import Relations
from embomatrix.sim.state.supports import Enclosure, Host
from embomatrix.world.asset import Interior
from embomatrix.world.geometry import Aabb, Pose
from embomatrix.world.state import Relation

TABLE_M = 0.75
APPLE_M = 0.04


@pytest.fixture(scope="module")
def engine():
    pool = ClientPool()
    engine = BulletEngine(kitchen_scene(), pool)
    yield engine
    engine.close()
    pool.close()


@pytest.fixture
def relations(engine):
    engine.reset()
    return Relations(engine)


@pytest.mark.parametrize(
    ("atom", "holds"),
    [
        (("ontop", "apple_1", "breakfast_table_1"), True),
        (("ontop", "apple_1", "bowl_1"), False),
        (("ontop", "mug_1", "shelf_1"), True),
        (("ontop", "chicken_leg_1", "fridge_1"), False),
        (("inside", "chicken_leg_1", "fridge_1"), True),
        (("inside", "mug_1", "shelf_1"), False),
        (("inside", "apple_1", "breakfast_table_1"), False),
        (("ontop", "microwave_1", "countertop_1"), True),
        (("under", "apple_1", "breakfast_table_1"), False),
        (("nextto", "stove_1", "countertop_1"), True),
        (("nextto", "stove_1", "breakfast_table_1"), False),
        (("nextto", "apple_1", "breakfast_table_1"), False),
        (("touching", "apple_1", "breakfast_table_1"), True),
        (("touching", "apple_1", "bowl_1"), False),
        (("inroom", "apple_1", "kitchen_0"), True),
        (("inroom", "mug_1", "kitchen_0"), False),
        (("ontop", "apple_1", "apple_1"), False),
    ],
)
def test_relations_of_the_kitchen_match_a_human_reading(relations, atom, holds) -> None:
    relation, a, b = atom
    assert relations.holds(Relation(relation), a, b) is holds


@pytest.mark.parametrize(("lift_m", "rests"), [(0.0, True), (0.009, True), (0.011, False), (-0.009, True)])
def test_underside_within_a_centimetre_rests(engine, relations, lift_m, rests) -> None:
    engine.set_pose("apple_1", Pose((2.0, 1.3, TABLE_M + APPLE_M + lift_m)))
    assert relations.ontop("apple_1", "breakfast_table_1") is rests


@pytest.mark.parametrize(("past_edge_m", "rests"), [(0.004, True), (0.006, False)])
def test_centre_past_the_edge_does_not_rest(engine, relations, past_edge_m, rests) -> None:
    engine.set_pose("apple_1", Pose((2.4 + past_edge_m, 1.3, TABLE_M + APPLE_M)))
    assert relations.ontop("apple_1", "breakfast_table_1") is rests


@settings(max_examples=60, deadline=None)
@given(st.floats(-3.1, 3.1), st.floats(0.0, 4.0), st.floats(0.0, 2.0))
def test_moving_an_object_away_ends_ontop_and_moving_it_back_restores_it(engine, yaw, away_m, up_m) -> None:
    relations = Relations(engine)
    table = engine.aabb("breakfast_table_1")
    low, high = table.low_m, table.high_m
    x, y = 2.0 + away_m * math.cos(yaw), 1.3 + away_m * math.sin(yaw)
    over = all(a <= b <= c for a, b, c in zip(low[:2], (x, y), high[:2], strict=True))
    off = any(b < a - EDGE_M or b > c + EDGE_M for a, b, c in zip(low[:2], (x, y), high[:2], strict=True))
    engine.set_pose("apple_1", Pose((x, y, TABLE_M + APPLE_M + up_m)))
    if off or up_m > REST_M + 1e-6:
        assert not relations.ontop("apple_1", "breakfast_table_1")
    elif over and up_m < REST_M - 1e-6:
        assert relations.ontop("apple_1", "breakfast_table_1")
    engine.set_pose("apple_1", Pose((2.0, 1.3, TABLE_M + APPLE_M)))
    assert relations.ontop("apple_1", "breakfast_table_1")


def test_object_on_the_floor_below_the_board_is_under_the_table(engine, relations) -> None:
    engine.set_pose("bowl_1", Pose((2.0, 1.3, 0.035)))
    assert relations.under("bowl_1", "breakfast_table_1")
    engine.set_pose("bowl_1", Pose((1.0, 1.3, 0.035)))
    assert not relations.under("bowl_1", "breakfast_table_1")


def test_opening_an_object_does_not_end_under(engine, relations) -> None:
    table, microwave = (engine.scene.asset_of(name) for name in ("breakfast_table_1", "microwave_1"))
    x, y, _ = engine.pose("breakfast_table_1").position_m
    edge = x + table.size_m[0] / 2
    engine.set_pose("microwave_1", Pose((edge - 0.03, y, microwave.size_m[2] / 2)))
    assert relations.under("microwave_1", "breakfast_table_1")
    engine.set_joints("microwave_1", (1.0,))
    assert engine.aabb("microwave_1").center_m[0] > edge
    assert relations.under("microwave_1", "breakfast_table_1")


def test_cavity_roof_ends_under(engine, relations) -> None:
    x, y, top = 0.6, 3.6, 1.7 + APPLE_M
    assert relations.inside("chicken_leg_1", "fridge_1")
    engine.set_pose("apple_1", Pose((x, y, top)))
    assert relations.ontop("apple_1", "fridge_1")
    assert not relations.under("chicken_leg_1", "apple_1")


def test_object_on_a_shelf_board_is_not_under_the_shelf(relations) -> None:
    assert not relations.under("mug_1", "shelf_1")


def test_mug_that_sticks_out_of_a_bowl_is_inside_while_its_centre_is_below_the_rim(engine, relations) -> None:
    for height_m, inside in ((0.81, True), (0.825, False)):
        engine.set_pose("mug_1", Pose((2.1, 1.0, height_m)))
        assert relations.inside("mug_1", "bowl_1") is inside


def test_object_that_sticks_out_of_a_door_opening_is_not_inside(engine, relations) -> None:
    for y, inside in ((3.36, True), (3.33, False)):  # the cavity begins at y = 3.32, the leg is 0.06 m wide
        engine.set_pose("chicken_leg_1", Pose((0.6, y, 0.875)))
        assert relations.inside("chicken_leg_1", "fridge_1") is inside


def test_nextto_ends_at_a_sixth_of_the_mean_extent(engine, relations) -> None:
    # (3 x 0.08 + 0.09 + 0.09 + 0.1) / 6 / 6 is below the least limit of 5 cm.
    for gap_m, near in ((0.048, True), (0.055, False)):
        engine.set_pose("mug_1", Pose((1.9 + 0.04 + 0.045 + gap_m, 1.6, TABLE_M + 0.05)))
        assert relations.nextto("apple_1", "mug_1") is near
        assert relations.nextto("mug_1", "apple_1") is near


def test_objects_at_different_heights_are_not_next_to_each_other(engine, relations) -> None:
    engine.set_pose("mug_1", Pose((1.95, 1.6, TABLE_M + 0.2)))
    assert not relations.nextto("apple_1", "mug_1")


def test_door_is_open_past_five_percent(engine, relations) -> None:
    for fraction, opened in ((0.0, False), (0.05, False), (0.06, True), (1.0, True)):
        engine.set_joints("fridge_1", (fraction,))
        assert relations.open("fridge_1") is opened
        assert relations.enclosing("chicken_leg_1") == (Enclosure("fridge_1", "main", not opened),)
    assert not relations.open("apple_1")


def test_hosts_are_found_through_nesting(engine, relations) -> None:
    engine.set_pose("bowl_1", Pose((0.6, 3.65, 0.85 + 0.035)))
    engine.set_pose("chicken_leg_1", Pose((0.6, 3.65, 0.85 + 0.01 + 0.025)))
    assert relations.host_of("chicken_leg_1") == Host("bowl_1", Relation.INSIDE, "basin")
    assert relations.host_of("bowl_1") == Host("fridge_1", Relation.INSIDE, "main")
    assert [item.name for item in relations.enclosing("chicken_leg_1")] == ["bowl_1", "fridge_1"]
    assert [item.closed for item in relations.enclosing("chicken_leg_1")] == [False, True]
    assert relations.inside("chicken_leg_1", "fridge_1")


def test_food_in_a_bowl_moves_along_and_a_plate_on_its_rim_blocks(engine, relations) -> None:
    engine.set_pose("apple_1", Pose((2.1, 1.0, 0.8)))
    assert relations.group_of("bowl_1") == ("bowl_1", "apple_1")
    engine.set_pose("mug_1", Pose((2.1, 1.0, 0.87)))
    assert relations.host_of("mug_1") == Host("bowl_1", Relation.ONTOP, "top of the box")
    assert relations.resting_on("bowl_1") == ("apple_1", "mug_1")
    assert relations.group_of("bowl_1") == ("bowl_1", "apple_1")


def test_parked_object_has_no_relations(engine, relations) -> None:
    engine.park("apple_1")
    for relation in Relation:
        room_or_thing = "kitchen_0" if relation is Relation.INROOM else "breakfast_table_1"
        assert not relations.holds(relation, "apple_1", room_or_thing)
    assert relations.host_of("apple_1") is None
    assert relations.resting_on("breakfast_table_1") == ("bowl_1",)


def test_one_open_door_of_two_is_an_opening() -> None:
    cabinet = make.cabinet()
    left, right = cabinet.links[1], dataclasses.replace(cabinet.links[1], name="right")
    double = dataclasses.replace(cabinet, links=(cabinet.links[0], left, right))
    interior = Interior("main", (0, 0, 0), (0.4, 0.7, 0.8), ("door", "right"))
    assert is_shut(double, interior, (0.0, 0.05))
    assert not is_shut(double, interior, (0.0, 0.5))
    assert not is_shut(double, dataclasses.replace(interior, closed_by=()), (0.0, 0.0))


@settings(max_examples=60, deadline=None)
@given(
    st.floats(-3.1, 3.1), st.floats(-5, 5), st.floats(-5, 5), st.floats(-0.39, 0.39), st.floats(-0.59, 0.59)
)
def test_resting_does_not_depend_on_where_the_table_stands(yaw, x, y, dx, dy) -> None:
    table = make.kitchen_table()
    pose = Pose.from_xyz_yaw(x, y, TABLE_M / 2, yaw)
    cx, cy, cz = pose.apply((dx, dy, TABLE_M / 2 + APPLE_M))
    box = Aabb((cx - APPLE_M, cy - APPLE_M, cz - APPLE_M), (cx + APPLE_M, cy + APPLE_M, cz + APPLE_M))
    assert surface_under(box, table, pose, in_cavities=False) == "top"


def test_nothing_rests_on_a_table_that_lies_on_its_side() -> None:
    table = make.kitchen_table()
    side = Pose((0, 0, 0.4), (0.0, 0.7071067811865476, 0.0, 0.7071067811865476))
    box = Aabb((0.3, -0.04, 0.4), (0.38, 0.04, 0.48))
    assert surface_under(box, table, side, in_cavities=False) == ""
