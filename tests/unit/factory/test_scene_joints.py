"""Furniture that is open at a scene's start keeps its contents."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import pytest
from tests.fakes import furniture as make
from tests.fakes.scenes import NORTH, placed, scene_of, upright

from embomatrix.factory.assets.solids import Solids
from embomatrix.factory.scenes.joints import bumped_into, with_joints
from embomatrix.world.geometry import Pose
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from embomatrix.world.asset import Asset
    from embomatrix.world.scene import SceneObject

TRAVEL_M = 0.36
"""Travel of the fake cabinet's drawers in metres; it faces north."""


def cabinet_with_a_bowl_in_its_lower_drawer() -> tuple[dict[str, SceneObject], dict[str, Asset]]:
    """Return the objects by name, and their assets: a mug in the bowl, a book in the upper drawer, another on top."""
    cabinet, bowl, mug = make.drawer_cabinet(), make.mug(), make.mug()
    book = make.block("book", "book.n.02", (0.2, 0.15, 0.04), {})
    rows = [
        ("cabinet_1", cabinet, upright(4.0, 0.26, 0.0, cabinet, NORTH), "", None),
        ("bowl_1", bowl, upright(4.0, 0.3, 0.03, bowl), "cabinet_1", Relation.INSIDE),
        ("mug_1", mug, upright(4.0, 0.3, 0.035, mug), "bowl_1", Relation.INSIDE),
        ("book_1", book, upright(4.0, 0.2, 0.26, book), "cabinet_1", Relation.INSIDE),
        ("book_2", book, upright(4.0, 0.26, 0.5, book), "cabinet_1", Relation.ONTOP),
    ]
    objects = {
        name: dataclasses.replace(
            placed(name, asset, "kitchen_0", pose, fixed=not host), host=host, relation=relation
        )
        for name, asset, pose, host, relation in rows
    }
    return objects, {asset.asset_id: asset for _, asset, *_ in rows}


def test_contents_move_with_a_drawer_recursively() -> None:
    objects, assets = cabinet_with_a_bowl_in_its_lower_drawer()
    changed = with_joints(objects, assets, "cabinet_1", (0.0, 0.5))
    assert set(changed) == {"cabinet_1", "bowl_1", "mug_1", "book_1"}
    assert changed["cabinet_1"].joints == (0.0, 0.5)
    for name, out_m in (("bowl_1", TRAVEL_M / 2), ("mug_1", TRAVEL_M / 2), ("book_1", 0.0)):
        moved = objects[name].pose_world_asset.inverse() @ changed[name].pose_world_asset
        assert moved.position_m == pytest.approx((0.0, out_m, 0.0))


def test_drawer_hits_an_obstacle_unless_it_is_far_enough() -> None:
    objects, assets = cabinet_with_a_bowl_in_its_lower_drawer()
    for off_m, expected in ((0.2, {"book_9"}), (0.6, set())):
        block = make.block("book", "book.n.02", (0.2, 0.15, 0.4), {})
        block = dataclasses.replace(block, asset_id="tall-book")
        before = placed("book_9", block, "kitchen_0", upright(4.0, 0.26 + 0.25 + off_m, 0.0, block))
        scene = scene_of(
            "drawers", [*((item, assets[item.asset_id]) for item in objects.values()), (before, block)]
        )
        solids = Solids.of_scene(scene)
        assert bumped_into(scene, solids, "cabinet_1", (1.0, 1.0)) == expected


def test_closing_a_drawer_restores_its_contents() -> None:
    objects, assets = cabinet_with_a_bowl_in_its_lower_drawer()
    opened = objects | with_joints(objects, assets, "cabinet_1", (1.0, 1.0))
    shut = opened | with_joints(opened, assets, "cabinet_1", (0.0, 0.0))
    for name, item in objects.items():
        there, back = item.pose_world_asset, shut[name].pose_world_asset
        assert (there.inverse() @ back).position_m == pytest.approx(Pose((0.0, 0.0, 0.0)).position_m)
