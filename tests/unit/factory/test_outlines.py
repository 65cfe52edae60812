"""True outlines: furniture round a corner leaves its nook open, stands rise in tiers, mirrors have a frame."""

from __future__ import annotations

import pytest

from embomatrix.factory.assets.corners import ARM_M, is_corner
from embomatrix.factory.assets.families import Family
from embomatrix.factory.assets.library import build_asset, family_of_model
from embomatrix.factory.furnish.pieces import FurniturePiece, Placed
from embomatrix.factory.furnish.roles import role_of
from embomatrix.factory.furnish.worktops import side_panels
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.check import check_scene
from embomatrix.sim.looks.parts import part_materials
from embomatrix.world.asset import Asset
from embomatrix.world.catalog import Catalog
from embomatrix.world.geometry import IDENTITY

CATALOG = Catalog.load()
CORNERS = [
    (category, model.model_id)
    for category in ARM_M
    for model in CATALOG.models_of(category)
    if is_corner(category, model.size_m)
]


def covers(asset: Asset, x: float, y: float) -> bool:
    """True if a part of the asset lies over this point of the floor."""
    boxes = [part.aabb(IDENTITY) for link in asset.links for part in link.parts]
    return any(box.low_m[0] <= x <= box.high_m[0] and box.low_m[1] <= y <= box.high_m[1] for box in boxes)


def test_every_kind_of_corner_furniture_occurs_in_the_catalog() -> None:
    assert {category for category, _ in CORNERS} == set(ARM_M)


@pytest.mark.parametrize(("category", "model"), CORNERS)
def test_corner_model_is_an_l_with_an_open_nook(category: str, model: str) -> None:
    asset = build_asset(CATALOG, category, model)
    x, y, _ = (extent / 2 - 0.02 for extent in asset.size_m)
    side = -1 if category == "bar" else 1
    assert not covers(asset, side * x, y), "the nook"
    assert covers(asset, -side * x, y)
    assert covers(asset, side * x, -y + 0.1)
    assert len(asset.supports) == 2
    piece = FurniturePiece(0, category, asset, role_of(category, asset.size_m, asset.mass_kg))
    assert len(piece.blocks) > 1, "furnishing uses the nook"


def test_stand_rises_towards_its_back_with_a_seat_on_every_tier() -> None:
    for model in CATALOG.models_of("stadium_stand"):
        asset = build_asset(CATALOG, "stadium_stand", model.model_id)
        seats = [(support.center_m[0], support.center_m[2]) for support in asset.supports]
        assert len(seats) >= 2
        assert seats == sorted(seats, key=lambda seat: -seat[0])
        assert [z for _, z in seats] == sorted(z for _, z in seats)


def test_mirror_shows_pale_glass_in_a_dark_frame() -> None:
    model = CATALOG.models_of("mirror")[0].model_id
    assert family_of_model(CATALOG, "mirror", model) is Family.MIRROR
    glass, *frame = part_materials(build_asset(CATALOG, "mirror", model))
    assert min(glass.color) > 0.85
    assert len(frame) == 4
    assert max(max(material.color) for material in frame) < 0.5


def test_worktop_without_cabinets_stands_on_two_panels() -> None:
    scene = build_base_scene("office_cubicles_right")
    slabs = [item for item in scene.objects if item.name.startswith("countertop_") and not item.host]
    assert slabs
    tops = [wall.aabb(IDENTITY).high_m[2] for wall in scene.walls]
    for item in slabs:
        bottom = scene.box_of(item.name).low_m[2]
        assert sum(abs(top - bottom) < 0.002 for top in tops) >= 2
    assert check_scene(scene) == ()


def test_only_a_worktop_without_a_host_gets_panels() -> None:
    model = CATALOG.models_of("countertop")[0].model_id
    asset = build_asset(CATALOG, "countertop", model)
    piece = FurniturePiece(0, "countertop", asset, role_of("countertop", asset.size_m, asset.mass_kg))
    assert len(side_panels(Placed(piece, "room", 1.0, 1.0, 0.72, 0.0))) == 2
    assert side_panels(Placed(piece, "room", 1.0, 1.0, 0.72, 0.0, host=3)) == ()
