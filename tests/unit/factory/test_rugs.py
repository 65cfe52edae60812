"""Rugs lie under furniture, and no leg stands on a rug's edge."""

from __future__ import annotations

import numpy as np
import pytest

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.evaluate.furnishing import furnishing_counts
from embomatrix.factory.evaluate.room_plans import kind_of, plan_of
from embomatrix.factory.furnish.pieces import REST_GAP_M, FurniturePiece, Placed
from embomatrix.factory.furnish.roles import role_of
from embomatrix.factory.furnish.rugs import lay_rugs
from embomatrix.factory.furnish.solver import RoomSolver
from embomatrix.factory.furnish.space import RoomSpace
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.check import check_scene
from embomatrix.world.catalog import Catalog
from embomatrix.world.scene import Doorway, Room
from embomatrix.world.state import Relation

CATALOG = Catalog.load()
ROOM = Room("living_room_0", "living_room", (0.0, 0.0), (6.0, 5.0))
DOOR = Doorway(("living_room_0", "hall_0"), (0.8, -0.06), 0.9, 2.0, "x")
SMALL_RUG = ("carpet", "ctclvd")
LARGE_RUG = ("carpet", "vlccww")


def piece(category: str, model: str = "", number: int = 0) -> FurniturePiece:
    """Return a piece of the catalog; the first model if none is named."""
    model = model or CATALOG.models_of(category)[0].model_id
    asset = build_asset(CATALOG, category, model)
    return FurniturePiece(number, category, asset, role_of(category, asset.size_m, asset.mass_kg))


def room_with(*items: tuple[FurniturePiece, float, float]) -> RoomSolver:
    """Return a room with pieces at these centres, facing +x."""
    solver = RoomSolver(RoomSpace(ROOM, (DOOR,)), np.random.default_rng(0))
    solver.placed = [Placed(each, ROOM.name, x, y, 0.0, 0.0) for each, x, y in items]
    return solver


def low_parts(item: Placed, below_m: float) -> list[tuple[float, ...]]:
    """Return the floor rectangles of the parts that reach below a height."""
    boxes = (part.aabb(item.pose) for link in item.piece.asset.links for part in link.parts)
    return [(*box.low_m[:2], *box.high_m[:2]) for box in boxes if box.low_m[2] < below_m]


def test_small_rug_lies_under_the_sofa_or_its_table_and_between_their_legs() -> None:
    solver = room_with((piece("sofa", "xhxdqf"), 0.6, 2.5), (piece("coffee_table"), 2.0, 2.5))
    assert lay_rugs(solver, [piece(*SMALL_RUG)]) == []
    (rug,) = [item for item in solver.placed if item.piece.category == "carpet"]
    x0, y0, _, x1, y1, top = rug.box
    others = [item for item in solver.placed if item is not rug and item.host < 0]
    for a, b, c, d in (rect for item in others for rect in low_parts(item, top)):
        assert a >= x1 or c <= x0 or b >= y1 or d <= y0, "a leg stands on the edge"
    overlaps = [
        max(0.0, min(x1, box[3]) - max(x0, box[0])) * max(0.0, min(y1, box[4]) - max(y0, box[1]))
        for box in (item.box for item in solver.placed if item is not rug)
    ]
    assert max(overlaps) >= 0.25 * (x1 - x0) * (y1 - y0)


def test_furniture_on_a_large_rug_is_lifted_by_its_thickness_and_rests_on_it() -> None:
    table = piece("coffee_table")
    solver = room_with((table, 3.0, 2.5))
    solver.placed.append(
        Placed(piece("table_lamp"), ROOM.name, 3.0, 2.5, table.size_m[2], 0.0, 0, Relation.ONTOP)
    )
    assert lay_rugs(solver, [piece(*LARGE_RUG)]) == []
    rug, below, above = solver.placed
    thickness = rug.piece.size_m[2]
    assert (rug.piece.category, below.host, below.relation) == ("carpet", 0, Relation.ONTOP)
    assert below.bottom == pytest.approx(thickness + 2 * REST_GAP_M)
    assert above.host == 1
    assert above.bottom - below.bottom == pytest.approx(table.size_m[2])


def test_cabinets_are_not_lifted() -> None:
    solver = room_with((piece("bottom_cabinet"), 3.0, 2.5))
    rug = piece(*LARGE_RUG)
    assert lay_rugs(solver, [rug]) == [rug]
    assert [item.piece.category for item in solver.placed] == ["bottom_cabinet"]


@pytest.mark.parametrize("scene_id", ["hotel_suite_small", "Ihlen_0_int", "house_double_floor_upper"])
def test_scene_with_rugs_has_all_of_them_under_furniture_and_breaks_no_rule(scene_id: str) -> None:
    scene = build_base_scene(scene_id)
    found, judged = furnishing_counts(scene).carpets_under
    assert found == judged > 0
    assert check_scene(scene) == ()


def test_furniture_on_a_rug_still_counts_as_furniture_on_the_floor() -> None:
    scene = build_base_scene("house_double_floor_upper")
    lifted = [item for item in scene.objects if item.host.startswith("carpet_")]
    assert lifted
    plan = plan_of(scene, lifted[0].room, ())
    kinds = {kind_of(scene.asset_of(item.name).category) for item in lifted}
    assert kinds <= {piece.kind for piece in plan.pieces}
    assert not kinds & {thing.kind for thing in plan.things}
