"""Algebra of poses and boxes."""

import dataclasses
import math
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.world.geometry import Aabb, ConvexPart, Pose, Shape

METRES = st.floats(-50.0, 50.0)
POINTS = st.tuples(METRES, METRES, METRES)
SIZES = st.tuples(*[st.floats(0.001, 5.0)] * 3)


def unit(values):
    length = math.sqrt(sum(value * value for value in values))
    return tuple(value / length for value in values) if length > 0.1 else (0.0, 0.0, 0.0, 1.0)


POSES = st.builds(Pose, POINTS, st.tuples(*[st.floats(-1.0, 1.0)] * 4).map(unit))
BOXES = st.builds(lambda low, size: Aabb(low, tuple(np.add(low, size).tolist())), POINTS, SIZES)


def near(found, expected) -> bool:
    return bool(np.allclose(found, expected, atol=1e-9))


def same_frame(a: Pose, b: Pose) -> bool:
    """Compare rotations: quaternions of opposite sign are equal rotations."""
    return near(a.position_m, b.position_m) and near(a.rotation, b.rotation)


@given(POSES, POSES, POSES)
def test_pose_product_is_associative(a, b, c) -> None:
    assert same_frame((a @ b) @ c, a @ (b @ c))


@given(POSES)
def test_pose_and_its_inverse_cancel_on_either_side(pose) -> None:
    identity = Pose((0.0, 0.0, 0.0))
    assert same_frame(pose @ pose.inverse(), identity)
    assert same_frame(pose.inverse() @ pose, identity)
    assert same_frame(pose @ identity, pose)


@given(POSES, POSES, POINTS)
def test_product_maps_a_point_like_its_factors_in_sequence(a, b, point) -> None:
    assert near((a @ b).apply(point), a.apply(b.apply(point)))


@given(POSES, st.lists(POINTS, min_size=1, max_size=5))
def test_batch_mapping_equals_mapping_each_point(pose, points) -> None:
    assert near(pose.apply_all(np.array(points)), [pose.apply(point) for point in points])


@given(POSES, POINTS, POINTS)
def test_poses_keep_distances(pose, one, other) -> None:
    assert near(math.dist(pose.apply(one), pose.apply(other)), math.dist(one, other))


@given(POSES)
def test_rotation_matrix_is_orthonormal(pose) -> None:
    assert near(pose.rotation @ pose.rotation.T, np.eye(3))
    assert near(np.linalg.det(pose.rotation), 1.0)


@given(METRES, METRES, METRES, st.floats(-math.pi + 1e-6, math.pi))
def test_upright_pose_returns_its_yaw(x, y, z, yaw) -> None:
    pose = Pose.from_xyz_yaw(x, y, z, yaw)
    assert near(pose.yaw, yaw)
    assert near(pose.apply((1.0, 0.0, 0.0)), (x + math.cos(yaw), y + math.sin(yaw), z))


@given(BOXES, BOXES, st.floats(0.0, 1.0))
def test_overlap_is_symmetric_and_equals_overlap_of_the_grown_box(a, b, margin_m) -> None:
    assert a.overlaps(b, margin_m) == b.overlaps(a, margin_m) == a.grown(margin_m).overlaps(b)


@given(st.lists(BOXES, min_size=1, max_size=4))
def test_box_around_boxes_is_tight(boxes) -> None:
    whole = Aabb.around(boxes)
    assert all(whole.contains(corner) for box in boxes for corner in (box.low_m, box.high_m))
    assert whole.low_m == tuple(np.min([box.low_m for box in boxes], axis=0))
    assert whole.high_m == tuple(np.max([box.high_m for box in boxes], axis=0))


@given(POSES, SIZES, st.tuples(*[st.floats(-0.5, 0.5)] * 3))
def test_bounding_box_contains_every_point_of_a_part(pose, size, share) -> None:
    part = ConvexPart(Shape.BOX, Pose((0.0, 0.0, 0.0)), size)
    point = pose.apply(tuple(np.multiply(size, share).tolist()))
    assert part.aabb(pose).contains(point, margin_m=1e-9)


@pytest.mark.parametrize(
    ("value", "change"),
    [
        (Pose((1.0, 2.0, 3.0)), {"quat_xyzw": (0.0, 0.0, 1.0, 0.0)}),
        (Aabb((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), {"high_m": (2.0, 2.0, 2.0)}),
    ],
)
def test_poses_and_boxes_are_immutable(value, change) -> None:
    assert pickle.loads(pickle.dumps(value)) == value == dataclasses.replace(value)
    assert hash(value) == hash(dataclasses.replace(value))
    assert dataclasses.replace(value, **change) != value
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(value, next(iter(change)), (0.0, 0.0, 0.0))
