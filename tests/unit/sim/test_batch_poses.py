"""Batch pose tests agree with tests of single poses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.sim.geometry.batch_poses import HANDY, REACHED, Neighbours, PoseBoxes, PoseSet, Range
from embomatrix.sim.geometry.bounds import bounds_of, square_box
from embomatrix.sim.placing.search import in_reach
from embomatrix.world.asset import Asset, Joint, JointKind, Link
from embomatrix.world.geometry import Aabb, ConvexPart, Pose, Shape
from embomatrix.world.placements import pose_rows
from embomatrix.world.poses import StandPose

LAMP = Asset(
    "lamp-test",
    "lamp",
    "",
    (0.3, 0.2, 0.4),
    1.0,
    (
        Link("base", (ConvexPart(Shape.CYLINDER, Pose((0.0, 0.0, 0.1)), (0.2, 0.2, 0.2)),)),
        Link(
            "arm",
            (ConvexPart(Shape.SPHERE, Pose((0.1, 0.0, 0.3)), (0.1, 0.1, 0.1)),),
            Joint(JointKind.REVOLUTE, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1.0),
        ),
    ),
)
COORDINATE = st.floats(-2.0, 2.0)
POSE = st.builds(Pose.from_xyz_yaw, COORDINATE, COORDINATE, COORDINATE, st.floats(-math.pi, math.pi))
BOX = st.builds(
    lambda low, size: Aabb(low, (low[0] + size[0], low[1] + size[1], low[2] + size[2])),
    st.tuples(COORDINATE, COORDINATE, COORDINATE),
    st.tuples(*[st.floats(0.02, 1.0)] * 3),
)


def pose_boxes_of(boxes: list[Aabb]) -> PoseBoxes:
    return PoseBoxes(np.array([box.low_m for box in boxes]), np.array([box.high_m for box in boxes]))


@given(st.lists(st.tuples(POSE, st.sampled_from(("", "drawer"))), min_size=1, max_size=5), POSE, POSE, POSE)
def test_batch_boxes_equal_single_boxes(spots, frame, drawer, then) -> None:
    poses, links = [pose for pose, _ in spots], [link for _, link in spots]
    frames = {"": frame, "drawer": drawer}
    bounds = bounds_of(LAMP)
    boxes = PoseSet.of(bounds, pose_rows(poses), links, then).world_boxes((0.5,), frames)
    for row, (pose, link) in enumerate(spots):
        box = bounds.box(frames[link] @ (pose @ then), (0.5,))
        assert boxes.lows_m[row].tolist() == pytest.approx(box.low_m, abs=1e-9)
        assert boxes.highs_m[row].tolist() == pytest.approx(box.high_m, abs=1e-9)


@given(st.lists(BOX, min_size=1, max_size=6), COORDINATE, COORDINATE)
def test_batch_reach_equals_single_reach(boxes, x, y) -> None:
    stand = StandPose(x, y, 0.0)
    assert pose_boxes_of(boxes).reached_from(stand).tolist() == [in_reach(box, stand) for box in boxes]


@pytest.mark.parametrize(
    ("away_m", "height_m", "handy"),
    [(0.6, 0.8, True), (0.9, 0.8, False), (0.6, 0.1, False), (0.6, 1.8, False)],
)
def test_near_place_at_medium_height_is_handy(away_m, height_m, handy) -> None:
    cube = Aabb((away_m, -0.05, height_m - 0.05), (away_m + 0.1, 0.05, height_m + 0.05))
    easy = Range.of(StandPose(0.0, 0.0, 0.0), *HANDY)
    assert easy.includes((*cube.low_m, *cube.high_m)) == handy


@given(st.lists(BOX, min_size=1, max_size=6), COORDINATE, COORDINATE)
def test_range_tells_of_each_box_what_the_batch_tells(boxes, x, y) -> None:
    stand = StandPose(x, y, 0.0)
    reach, batch = Range.of(stand, *REACHED), pose_boxes_of(boxes)
    assert [reach.includes(corner) for corner in batch.corners()] == batch.reached_from(stand).tolist()


def test_range_ends_to_the_bit_where_the_batch_ends() -> None:
    away_m = REACHED[0]
    for x in (away_m, math.nextafter(away_m, 9.0), math.nextafter(away_m, 0.0)):
        box = Aabb((x * 0.6, x * 0.8, 0.5), (x, x, 0.6))
        stand = StandPose(0.0, 0.0, 0.0)
        expected = pose_boxes_of([box]).reached_from(stand).tolist()
        assert [Range.of(stand, *REACHED).includes((*box.low_m, *box.high_m))] == expected


@given(st.lists(BOX, min_size=1, max_size=4), st.lists(BOX, max_size=4), st.floats(0.0, 0.1))
def test_batch_meets_what_single_boxes_overlap(boxes, others, margin_m) -> None:
    expected = [any(box.grown(margin_m).overlaps(other) for other in others) for box in boxes]
    assert pose_boxes_of(boxes).meet(others, margin_m).tolist() == expected


def test_pose_inside_a_solid_object_is_taken_and_beside_it_is_free() -> None:
    boxes = [Aabb((0.0, 0.0, 0.0), (0.1, 0.1, 0.1)), Aabb((0.19, 0.0, 0.0), (0.29, 0.1, 0.1))]
    near = [Aabb((9.0, 9.0, 9.0), (9.1, 9.1, 9.1)), Aabb((0.0, 0.0, 0.0), (0.2, 0.2, 0.2))]
    taken, most = pose_boxes_of(boxes).overlaps(Neighbours.of(near, [True, True], [False, False]))
    assert taken.tolist() == [True, False]
    assert most.tolist() == [1, 1]


def test_object_with_a_cavity_is_taken_only_on_its_own_level() -> None:
    boxes = [Aabb((0.05, 0.05, z), (0.15, 0.15, z + 0.1)) for z in (0.0, 0.05)]
    bowl = Neighbours.of([Aabb((0.0, 0.0, 0.0), (0.2, 0.2, 0.2))], [False], [True])
    assert pose_boxes_of(boxes).overlaps(bowl)[0].tolist() == [True, False]


def test_pose_on_a_link_without_a_frame_is_out_of_reach() -> None:
    places = PoseSet.of(bounds_of(LAMP), pose_rows([Pose((0.0, 0.0, 0.5))]), ["drawer"])
    boxes = places.world_boxes((0.0,), {"": Pose((0.0, 0.0, 0.0))})
    assert not boxes.reached_from(StandPose(0.0, 0.0, 0.0)).any()


def test_poses_taken_in_turn_keep_their_rotations() -> None:
    bounds, poses = bounds_of(LAMP), [Pose.from_xyz_yaw(0.0, 0.0, 0.0, yaw) for yaw in (0.0, 1.0)]
    again = PoseSet.of(bounds, pose_rows(poses), ["", ""]).repeated_at(np.arange(9.0).reshape(3, 3))
    boxes = again.world_boxes((0.0,), {"": Pose((0.0, 0.0, 0.0))})
    for row, yaw in enumerate((0.0, 1.0, 0.0)):
        box = bounds.box(Pose.from_xyz_yaw(3.0 * row, 3.0 * row + 1, 3.0 * row + 2, yaw), (0.0,))
        assert boxes.lows_m[row].tolist() == pytest.approx(box.low_m)
        assert boxes.highs_m[row].tolist() == pytest.approx(box.high_m)


@given(BOX, COORDINATE, COORDINATE, st.sampled_from((0, 1, 2, 3)))
def test_quarter_turn_of_a_box_equals_that_of_its_solid(box, x, y, quarters) -> None:
    solid = Asset(
        "box-test",
        "box",
        "",
        box.size_m,
        1.0,
        (Link("base", (ConvexPart(Shape.BOX, Pose((0.0, 0.0, 0.0)), box.size_m),)),),
    )
    frame = Pose.from_xyz_yaw(x, y, 0.3, quarters * math.pi / 2)
    turned, exact = square_box(box, frame), bounds_of(solid).box(frame @ Pose(box.center_m))
    assert turned is not None
    assert turned.low_m == pytest.approx(exact.low_m, abs=1e-9)
    assert turned.high_m == pytest.approx(exact.high_m, abs=1e-9)


@pytest.mark.parametrize("quat", [(0.1, 0.0, 0.0, math.sqrt(0.99)), (0.0, 0.0, 0.1, math.sqrt(0.99))])
def test_box_is_not_turned_by_other_angles(quat) -> None:
    assert square_box(Aabb((0.0, 0.0, 0.0), (1.0, 2.0, 3.0)), Pose((0.0, 0.0, 0.0), quat)) is None


@given(st.lists(BOX, min_size=1, max_size=5), COORDINATE)
def test_raised_boxes_begin_exactly_over_the_height(boxes, height) -> None:
    raised = pose_boxes_of(boxes).raised_over(height)
    for box, low, high in zip(boxes, raised.lows_m, raised.highs_m, strict=True):
        assert low[2] == pytest.approx(max(box.low_m[2], height))
        assert (high - low).tolist() == pytest.approx(box.size_m)
        assert low[:2].tolist() == list(box.low_m[:2])
