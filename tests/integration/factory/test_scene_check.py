from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.factory.assets.solids import convex_of, depth_m
from embomatrix.factory.scenes.check import ProblemKind, check_in_engine, check_scene
from embomatrix.world.geometry import ConvexPart, Pose, Shape

if TYPE_CHECKING:
    from embomatrix.world.scene import Scene, SceneObject

HERE = Pose((0.0, 0.0, 0.0))


def moved(scene: Scene, name: str, dx: float = 0.0, dy: float = 0.0, dz: float = 0.0) -> Scene:
    """Return the scene with one object shifted."""

    def shift(item: SceneObject) -> SceneObject:
        x, y, z = item.pose_world_asset.position_m
        return replace(item, pose_world_asset=Pose((x + dx, y + dy, z + dz), item.pose_world_asset.quat_xyzw))

    return replace(scene, objects=tuple(shift(o) if o.name == name else o for o in scene.objects))


def kinds(scene: Scene) -> set[ProblemKind]:
    return {problem.kind for problem in check_scene(scene)}


def test_base_scene_breaks_no_rule(flat: Scene) -> None:
    assert check_scene(flat) == ()


def test_engine_finds_no_penetration_in_a_base_scene(flat: Scene) -> None:
    assert check_in_engine(flat) == ()


def test_sunken_object_penetrates_its_support(flat: Scene) -> None:
    item = next(o for o in flat.objects if o.host and not o.fixed)
    problems = check_scene(moved(flat, item.name, dz=-0.01))
    assert any(p.kind is ProblemKind.PENETRATION and item.name in p.names for p in problems)


def test_lifted_object_floats(flat: Scene) -> None:
    item = next(o for o in flat.objects if o.host and not o.fixed)
    assert ProblemKind.FLOATING in kinds(moved(flat, item.name, dz=0.05))


def test_object_in_another_room_is_reported(flat: Scene) -> None:
    assert ProblemKind.ROOM in kinds(moved(flat, "bed_1", dx=50.0))


def test_name_used_twice_is_reported(flat: Scene) -> None:
    twice = replace(flat, objects=(*flat.objects, flat.objects[0]))
    assert ProblemKind.NAME in kinds(twice)


def test_enclosed_robot_reaches_nothing(flat: Scene) -> None:
    bed = next(o for o in flat.objects if o.name == "bed_1").pose_world_asset.position_m
    stuck = replace(flat, robot=replace(flat.robot, x_m=bed[0], y_m=bed[1]))
    assert ProblemKind.UNREACHABLE_ROOM in kinds(stuck)


def test_boxes_side_by_side_do_not_overlap_and_shifted_ones_do() -> None:
    part = ConvexPart(Shape.BOX, HERE, (1.0, 0.5, 0.2))
    one = convex_of(part, HERE)
    assert depth_m(one, convex_of(part, Pose((1.0, 0.0, 0.0)))) == pytest.approx(0.0, abs=1e-9)
    assert depth_m(one, convex_of(part, Pose((0.99, 0.0, 0.0)))) == pytest.approx(0.01)
    assert depth_m(one, convex_of(part, Pose((0.0, 0.0, 0.3)))) < 0


@given(st.floats(0.05, 0.5), st.floats(0.05, 0.5), st.floats(0.0, 6.28), st.floats(-0.2, 0.2))
def test_overlap_of_round_objects_is_sum_of_radii_minus_distance(
    r1: float, r2: float, angle: float, gap: float
) -> None:
    away = r1 + r2 + gap
    pose = Pose((away * np.cos(angle), away * np.sin(angle), 0.0))
    for shape in (Shape.CYLINDER, Shape.SPHERE):
        a = convex_of(ConvexPart(shape, HERE, (2 * r1, 2 * r1, 2 * r1)), HERE)
        b = convex_of(ConvexPart(shape, HERE, (2 * r2, 2 * r2, 2 * r2)), pose)
        if abs(gap) < min(r1, r2):
            assert depth_m(a, b) == pytest.approx(-gap, abs=0.01 * (r1 + r2))
