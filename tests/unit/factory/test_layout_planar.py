"""Meaning of the constraints on a plane, and validity of the solver's arrangements."""

import dataclasses
import math

import numpy as np
import pytest

from embomatrix.factory.layout.constraints import (
    WEIGHTS,
    SpotCandidates,
    half_extents,
    holds,
    near_m,
    next_to_m,
)
from embomatrix.factory.layout.planar import arrange
from embomatrix.factory.layout.values import (
    ConstraintKind,
    PlacementConstraint,
    PlaneBrief,
    PlaneFootprint,
    PlaneObject,
)
from embomatrix.factory.scenes.editor import LayoutReason
from embomatrix.skills.limits import ROBOT

PLANE = (2.0, 1.2)
CUP = (0.1, 0.1, 0.12)
EAST = PlaneFootprint("laptop", (0.0, 0.0), 0.0, (0.3, 0.4), 0.0, 0.2)
"""An object in the middle whose front points along the plane's x axis."""


def held(kind, x, y, yaw=0.0, other=EAST, size_m=CUP):
    spots = SpotCandidates.of(np.array([[x, y]]), np.array([yaw]), size_m)
    return bool(holds(PlacementConstraint(kind, other.name if other else ""), spots, PLANE, size_m, other)[0])


def test_every_constraint_has_a_weight():
    assert set(WEIGHTS) == set(ConstraintKind)


@pytest.mark.parametrize(
    ("kind", "there", "not_there"),
    [
        (ConstraintKind.EDGE, (0.92, 0.0), (0.0, 0.0)),
        (ConstraintKind.MIDDLE, (0.1, -0.1), (0.7, 0.0)),
        (ConstraintKind.NEAR, (0.4, 0.0), (0.94, 0.54)),
        (ConstraintKind.FAR, (0.94, 0.54), (0.4, 0.0)),
        (ConstraintKind.IN_FRONT_OF, (0.6, 0.1), (-0.6, 0.1)),
        (ConstraintKind.SIDE_OF, (0.1, 0.5), (0.6, 0.0)),
        (ConstraintKind.CENTER_ALIGNED, (0.0, 0.5), (0.3, 0.4)),
        (ConstraintKind.NEXT_TO, (0.22, 0.1), (0.5, 0.1)),
    ],
)
def test_constraint_holds_only_at_matching_spots(kind, there, not_there):
    assert held(kind, *there)
    assert not held(kind, *not_there)


def test_face_to_holds_when_the_front_points_at_the_other_object():
    rng = np.random.default_rng(0)
    for angle in rng.uniform(-math.pi, math.pi, 50):
        x, y = 0.5 * math.cos(angle), 0.5 * math.sin(angle)
        assert held(ConstraintKind.FACE_TO, x, y, yaw=angle + math.pi)
        assert not held(ConstraintKind.FACE_TO, x, y, yaw=angle + math.pi + 0.2)
        assert not held(ConstraintKind.FACE_TO, x, y, yaw=angle)


def test_front_and_side_rotate_with_the_reference_object():
    rng = np.random.default_rng(1)
    for turn in rng.uniform(-math.pi, math.pi, 50):
        turned = dataclasses.replace(EAST, yaw=float(turn))
        ahead = (0.5 * math.cos(turn), 0.5 * math.sin(turn))
        beside = (-ahead[1], ahead[0])
        assert held(ConstraintKind.IN_FRONT_OF, *ahead, other=turned)
        assert not held(ConstraintKind.SIDE_OF, *ahead, other=turned)
        assert held(ConstraintKind.SIDE_OF, *beside, other=turned)
        assert held(ConstraintKind.CENTER_ALIGNED, *beside, other=turned)


def test_near_and_far_are_complementary():
    rng = np.random.default_rng(2)
    for x, y in rng.uniform((-0.9, -0.5), (0.9, 0.5), (50, 2)):
        assert held(ConstraintKind.NEAR, x, y) is not held(ConstraintKind.FAR, x, y)


def test_next_to_matches_the_engine_and_requires_equal_height():
    assert next_to_m(CUP, EAST) >= 0.05
    high = dataclasses.replace(EAST, low_m=0.5, high_m=0.7)
    assert not held(ConstraintKind.NEXT_TO, 0.22, 0.1, other=high)
    assert near_m((10.0, 10.0)) == 1.0


def test_constraint_about_an_absent_object_never_holds():
    spots = SpotCandidates.of(np.zeros((1, 2)), np.zeros(1), CUP)
    for kind in set(ConstraintKind) - {ConstraintKind.EDGE, ConstraintKind.MIDDLE}:
        assert not holds(PlacementConstraint(kind, "nobody"), spots, PLANE, CUP, None)[0]


def a_brief(seed: int) -> PlaneBrief:
    rng = np.random.default_rng(seed)
    kinds = [*ConstraintKind]
    objects = tuple(
        PlaneObject(
            f"thing_{n}",
            tuple(rng.uniform(0.04, 0.3, 3).tolist()),
            (PlacementConstraint(kinds[int(rng.integers(len(kinds)))], f"thing_{int(rng.integers(4))}"),),
            bool(rng.integers(2)),
        )
        for n in range(4)
    )
    obstacles = tuple(
        PlaneFootprint(
            f"old_{n}",
            tuple(rng.uniform(-0.5, 0.5, 2).tolist()),
            float(rng.uniform(0, 3)),
            (0.2, 0.1),
            0.0,
            0.2,
        )
        for n in range(3)
    )
    stands = tuple((x, -1.0) for x in np.arange(-1.0, 1.1, 0.2).tolist())
    return PlaneBrief("table", PLANE, objects, obstacles, stands=stands, seed=seed)


def corners(item: PlaneFootprint) -> np.ndarray:
    x, y = item.size_m
    square = np.array([(x, y), (-x, y), (-x, -y), (x, -y)]) / 2
    turn = np.array([[math.cos(item.yaw), math.sin(item.yaw)], [-math.sin(item.yaw), math.cos(item.yaw)]])
    return square @ turn + item.center_m


def apart(a: PlaneFootprint, b: PlaneFootprint) -> bool:
    """True if an axis of either rectangle separates the two."""
    return any(
        (corners(a) @ axis).max() <= (corners(b) @ axis).min()
        or (corners(b) @ axis).max() <= (corners(a) @ axis).min()
        for yaw in (a.yaw, a.yaw + math.pi / 2, b.yaw, b.yaw + math.pi / 2)
        for axis in (np.array([math.cos(yaw), math.sin(yaw)]),)
    )


@pytest.mark.parametrize("seed", range(6))
def test_arranged_objects_are_separate_on_the_plane_and_in_reach(seed):
    brief = a_brief(seed)
    for way in arrange(brief):
        sizes = {thing.name: thing.size_m for thing in brief.objects}
        placed = [
            PlaneFootprint(
                spot.object_name,
                spot.center_m,
                spot.yaw,
                sizes[spot.object_name][:2],
                0.0,
                sizes[spot.object_name][2],
            )
            for spot in way.spots
        ]
        assert {spot.object_name for spot in way.spots} | way.left_out.keys() == sizes.keys()
        for number, item in enumerate(placed):
            assert all(apart(item, other) for other in (*placed[:number], *brief.obstacles))
            assert np.all(np.abs(corners(item)) <= np.array(PLANE) / 2)
            half = half_extents(np.asarray(item.yaw), item.size_m)
            off = np.maximum(np.abs(np.asarray(brief.stands) - item.center_m) - half, 0.0)
            assert np.hypot(*off.T).min() <= ROBOT.reach_m


def test_arrangement_is_deterministic_per_seed():
    assert arrange(a_brief(3)) == arrange(a_brief(3))
    assert arrange(a_brief(3)) != arrange(dataclasses.replace(a_brief(3), seed=4))


def test_satisfiable_constraints_are_satisfied():
    plate = PlaneObject("plate", (0.24, 0.24, 0.02), (PlacementConstraint(ConstraintKind.EDGE),))
    fork = PlaneObject(
        "fork", (0.18, 0.03, 0.02), (PlacementConstraint(ConstraintKind.NEXT_TO, "plate", required=True),)
    )
    vase = PlaneObject("vase", (0.1, 0.1, 0.3), (PlacementConstraint(ConstraintKind.MIDDLE),))
    best = arrange(PlaneBrief("table", PLANE, (fork, plate, vase)))[0]
    assert all(spot.held for spot in best.spots)
    assert not best.left_out


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"size_m": (0.05, 0.05)}, LayoutReason.TOO_LARGE),
        ({"zones": ((-1.0, -0.6, 1.0, 0.6),)}, LayoutReason.NO_FREE_SPOT),
        ({"stands": ((9.0, 9.0),)}, LayoutReason.OUT_OF_REACH),
        (
            {
                "objects": (
                    PlaneObject(
                        "cup", CUP, (PlacementConstraint(ConstraintKind.NEXT_TO, "x", required=True),)
                    ),
                )
            },
            LayoutReason.RELATION_NOT_HELD,
        ),
    ],
)
def test_object_without_a_spot_gets_a_reason(change, reason):
    brief = PlaneBrief("table", PLANE, (PlaneObject("cup", CUP),))
    assert arrange(dataclasses.replace(brief, **change))[0].left_out == {"cup": reason}
