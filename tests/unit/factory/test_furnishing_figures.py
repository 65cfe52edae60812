"""Figures of furnished scenes: each rule counts a scene that breaks it, and passes one that keeps it."""

from __future__ import annotations

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.evaluate.furnishing import FurnishingCounts, furnishing_counts, furnishing_figures
from embomatrix.world.catalog import Catalog
from embomatrix.world.geometry import ConvexPart, Pose, Shape
from embomatrix.world.scene import RobotStart, Room, Scene, SceneObject

CATALOG = Catalog.load()
ROOM = Room("living_room_0", "living_room", (0.0, 0.0), (8.0, 8.0))
Place = tuple[str, float, float, float]
"""Category, x, y and height of the underside."""


def scene_of(*places: Place, walls: tuple[ConvexPart, ...] = ()) -> Scene:
    """Return a room with the first model of each category at these places, facing +x."""
    objects, assets = [], {}
    for number, (category, x, y, bottom) in enumerate(places):
        asset = build_asset(CATALOG, category, CATALOG.models_of(category)[0].model_id)
        assets[asset.asset_id] = asset
        pose = Pose((x, y, bottom + asset.size_m[2] / 2))
        objects.append(SceneObject(f"{category}_{number}", asset.asset_id, ROOM.name, pose, fixed=True))
    robot = RobotStart(7.0, 7.0, 0.0, ROOM.name)
    return Scene("test", "test", 0, (ROOM,), walls, (), tuple(objects), assets, robot)


def counts(*places: Place, walls: tuple[ConvexPart, ...] = ()) -> FurnishingCounts:
    return furnishing_counts(scene_of(*places, walls=walls))


def size_of(category: str) -> tuple[float, float, float]:
    return CATALOG.models_of(category)[0].size_m


def test_rug_beside_a_sofa_is_counted_and_one_under_it_is_not() -> None:
    front = 2.0 + size_of("sofa")[0] / 2
    half = size_of("carpet")[0] / 2
    assert counts(("sofa", 2.0, 4.0, 0.0), ("carpet", front + half + 0.1, 4.0, 0.0)).carpets_under == (0, 1)
    assert counts(("sofa", 2.0, 4.0, 0.0), ("carpet", front, 4.0, 0.0)).carpets_under == (1, 1)


def test_rugs_of_rooms_without_a_group_are_not_judged() -> None:
    assert counts(("toilet", 2.0, 4.0, 0.0), ("carpet", 5.0, 4.0, 0.0)).carpets_under == (0, 0)
    assert counts(("straight_chair", 2.0, 4.0, 0.0), ("carpet", 5.0, 4.0, 0.0)).carpets_under == (0, 0)


def test_slab_in_the_air_floats_until_something_ends_right_below_it() -> None:
    slab = ("countertop", 4.0, 4.0, 0.72)
    panel = ConvexPart(Shape.BOX, Pose((4.0, 4.0, 0.36)), (0.3, 0.1, 0.72))
    low = ConvexPart(Shape.BOX, Pose((4.0, 4.0, 0.3)), (0.3, 0.1, 0.6))
    assert counts(slab).slabs_floating == (1, 1)
    assert counts(slab, walls=(low,)).slabs_floating == (1, 1)
    assert counts(slab, walls=(panel,)).slabs_floating == (0, 1)


def test_lamp_hangs_low_unless_it_clears_heads_or_hangs_over_a_table() -> None:
    assert counts(("chandelier", 4.0, 4.0, 1.9)).lamps_low == (1, 1)
    assert counts(("chandelier", 4.0, 4.0, 2.1)).lamps_low == (0, 1)
    assert counts(("chandelier", 4.0, 4.0, 1.5), ("breakfast_table", 4.0, 4.0, 0.0)).lamps_low == (0, 1)


def test_desk_needs_a_seat_near_it() -> None:
    far, near = size_of("desk")[0] / 2 + 2.0, size_of("desk")[0] / 2 + 0.3
    assert counts(("desk", 3.0, 4.0, 0.0), ("straight_chair", 3.0 + far, 4.0, 0.0)).desks_seated == (0, 1)
    assert counts(("desk", 3.0, 4.0, 0.0), ("straight_chair", 3.0 + near, 4.0, 0.0)).desks_seated == (1, 1)
    assert counts(("desk", 3.0, 4.0, 0.0)).desks_seated == (0, 0), "a room without seats is not judged"


def test_figures_are_shares_and_counts_with_goals_and_leave_out_what_is_missing() -> None:
    found = FurnishingCounts(carpets_under=(3, 4), slabs_floating=(2, 9))
    figures = {figure.name: figure for figure in furnishing_figures(found)}
    assert figures.keys() == {"carpet_under_share", "floating_slabs"}
    assert (figures["carpet_under_share"].value, figures["carpet_under_share"].n) == (0.75, 4)
    assert (figures["floating_slabs"].value, figures["floating_slabs"].is_reached) == (2.0, False)
