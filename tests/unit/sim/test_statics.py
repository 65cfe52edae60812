"""What statics proves, a settle finds; what it can't prove is left to the settle."""

import math

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.mini_world import MiniWorld, Still
from embomatrix.sim.geometry.bounds import IDENTITY, bounds_of
from embomatrix.sim.geometry.statics import base_of, is_level, rest_pose
from embomatrix.world.asset import Asset, Link
from embomatrix.world.geometry import ConvexPart, Pose, Shape

LIFT_M = 0.0005
EXTENT = st.floats(0.03, 0.3)
SHAPE = st.sampled_from((Shape.BOX, Shape.CYLINDER))


def solid(name, *parts):
    size = bounds_of(Asset(name, name, "", (1.0, 1.0, 1.0), 1.0, (Link("base", parts),))).box(IDENTITY).size_m
    return Asset(name, name, "", size, 0.5, (Link("base", parts),))


def part(shape, size, at=(0.0, 0.0, 0.0)):
    return ConvexPart(shape, Pose(at), (size[0], size[0] if shape is Shape.CYLINDER else size[1], size[2]))


def over(held, support, x, y, yaw):
    """Pose half a millimetre over the support's top."""
    z = bounds_of(support).box(IDENTITY).high_m[2] - bounds_of(held).box(IDENTITY).low_m[2] + LIFT_M
    return Pose.from_xyz_yaw(x, y, z, yaw)


def proved(held, support, pose):
    base = base_of(held)
    return rest_pose(held, base, pose, support, ()) if base is not None else None


@pytest.fixture(scope="module")
def mini():
    pool = ClientPool()
    world = MiniWorld(pool)
    yield world
    world.close()
    pool.close()


@settings(max_examples=60, deadline=None)
@given(
    SHAPE,
    st.tuples(EXTENT, EXTENT, EXTENT),
    SHAPE,
    st.tuples(EXTENT, EXTENT, EXTENT),
    st.floats(-0.2, 0.2),
    st.floats(-0.2, 0.2),
    st.sampled_from((0.0, math.pi / 2, math.pi, -math.pi / 2, 0.4)),
)
def test_what_is_proved_to_rest_settles_there(mini, shape, size, other_shape, other_size, x, y, yaw) -> None:
    held, support = solid("held", part(shape, size)), solid("support", part(other_shape, other_size))
    pose = over(held, support, x, y, yaw)
    rest = proved(held, support, pose)
    assume(rest is not None)
    stands = Pose((0.0, 0.0, other_size[2] / 2))
    mini.stage(held, stands @ pose, (), [Still(support, stands)])
    settled = mini.drop(stands @ pose)
    assert settled.stable
    assert settled.pose.position_m == pytest.approx((stands @ rest).position_m, abs=3e-4)


def test_a_block_rests_on_a_table_half_a_millimetre_lower() -> None:
    block, table = (
        solid("block", part(Shape.BOX, (0.1, 0.1, 0.1))),
        solid("table", part(Shape.BOX, (1, 1, 0.5))),
    )
    assert proved(block, table, over(block, table, 0.2, 0.1, 0.4)).position_m == pytest.approx(
        (0.2, 0.1, 0.3)
    )


def test_a_block_with_its_weight_beyond_the_edge_is_not_proved() -> None:
    block, table = (
        solid("block", part(Shape.BOX, (0.1, 0.1, 0.1))),
        solid("table", part(Shape.BOX, (1, 1, 0.5))),
    )
    assert proved(block, table, over(block, table, 0.48, 0.0, 0.0)) is not None
    assert proved(block, table, over(block, table, 0.49, 0.0, 0.0)) is None


def test_a_rim_beside_a_block_leaves_it_to_the_settle() -> None:
    block = solid("block", part(Shape.BOX, (0.1, 0.1, 0.1)))
    board, rim = part(Shape.BOX, (0.5, 0.5, 0.02)), part(Shape.BOX, (0.02, 0.5, 0.04), (0.24, 0.0, 0.03))
    tray = solid("tray", board, rim)
    for x, known in ((0.1, True), (0.1795, False), (0.19, False)):
        pose = Pose((x, 0.0, 0.01 + 0.05 + LIFT_M))
        assert (proved(block, tray, pose) is not None) is known


@pytest.mark.parametrize(
    "thing",
    [
        solid("ball", part(Shape.SPHERE, (0.1, 0.1, 0.1))),
        solid(
            "rod",
            ConvexPart(
                Shape.CYLINDER,
                Pose((0.0, 0.0, 0.0), (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))),
                (0.1, 0.1, 0.3),
            ),
        ),
        solid("hook", part(Shape.BOX, (0.02, 0.02, 0.1), (0.1, 0.0, 0.0))),
    ],
)
def test_what_rolls_or_topples_has_no_base(thing) -> None:
    assert base_of(thing) is None


def test_a_slope_of_a_degree_is_no_level() -> None:
    half = math.radians(1.1) / 2
    assert is_level(Pose.from_xyz_yaw(1.0, 2.0, 3.0, 0.7))
    assert not is_level(Pose((0.0, 0.0, 0.0), (math.sin(half), 0.0, 0.0, math.cos(half))))
