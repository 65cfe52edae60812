from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.factory.floorplan.layout import plan_floor
from embomatrix.factory.floorplan.spec import RoomSpec
from embomatrix.factory.furnish.groups import room_groups
from embomatrix.factory.furnish.hosts import hosts_of, kept_behind_doors
from embomatrix.factory.furnish.pieces import (
    REST_GAP_M,
    FurnitureGroup,
    FurniturePiece,
    around_table,
    front_depth_m,
)
from embomatrix.factory.furnish.roles import HUNG_BOTTOM_M, FurnitureRole, role_of
from embomatrix.factory.furnish.rooms import MAX_EQUAL, furnish
from embomatrix.factory.furnish.space import LOW_M, RoomSpace
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.floor import box_of
from embomatrix.world.asset import Asset, Joint, JointKind, Link, SupportSurface
from embomatrix.world.catalog import Catalog
from embomatrix.world.geometry import ConvexPart, Pose, Shape, Vec3
from embomatrix.world.scene import Doorway, Room, Scene, SceneObject, Window
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from embomatrix.factory.furnish.rooms import Furnishing

ROOM = Room("kitchen_0", "kitchen", (0.0, 0.0), (4.0, 3.0))
DOOR = Doorway(("kitchen_0", "hall_0"), (2.0, -0.06), 0.9, 2.0, "x")


def block(category: str, size: Vec3, *, door: bool = False) -> Asset:
    """Return a solid box with a surface on top, and a hinged front if ``door``."""
    links = [Link("base", (ConvexPart(Shape.BOX, Pose((0.0, 0.0, 0.0)), size),))]
    if door:
        leaf = ConvexPart(Shape.BOX, Pose((size[0] / 2 - 0.01, 0.0, 0.0)), (0.02, size[1], size[2]))
        hinge = Joint(JointKind.REVOLUTE, (size[0] / 2, size[1] / 2, 0.0), (0.0, 0.0, 1.0), math.pi / 2)
        links.append(Link("door", (leaf,), hinge))
    top = SupportSurface("top", (0.0, 0.0, size[2] / 2), size[:2], 1.0)
    abilities: dict[str, dict[str, float]] = {"openable": {}} if door else {}
    return Asset(
        f"{category}-box", category, f"{category}.n.01", size, 5.0, tuple(links), (top,), (), abilities
    )


def pieces(*assets: Asset) -> list[FurniturePiece]:
    return [
        FurniturePiece(i, a.category, a, role_of(a.category, a.size_m, a.mass_kg))
        for i, a in enumerate(assets)
    ]


def furnished(*assets: Asset, floor: tuple[float, float] = (4.0, 3.0), seed: int = 0) -> Furnishing:
    rng = np.random.default_rng(seed)
    plan = plan_floor([RoomSpec("kitchen_0", "kitchen", floor)], rng)
    return furnish(plan, {"kitchen_0": pieces(*assets)}, rng)


def test_chairs_face_the_table_from_outside_it() -> None:
    table, *chairs = pieces(
        block("breakfast_table", (0.8, 1.4, 0.75)), *[block("straight_chair", (0.45, 0.45, 0.8))] * 6
    )
    for member in around_table(table, chairs)[1:]:
        ahead = (round(math.cos(member.turns * math.pi / 2)), round(math.sin(member.turns * math.pi / 2)))
        toward = (-member.x, -member.y)
        assert ahead[0] * toward[0] + ahead[1] * toward[1] > 0
        assert abs(member.x) >= 0.4 + 0.225 or abs(member.y) >= 0.7 + 0.225


def test_worktop_lies_on_its_tallest_cabinet() -> None:
    cabinet, lower = (
        block("bottom_cabinet", (0.5, 0.5, 0.55), door=True),
        block("bottom_cabinet", (0.5, 0.45, 0.53), door=True),
    )
    groups, left_out = room_groups(pieces(block("countertop", (0.6, 1.0, 0.03)), cabinet, lower), ROOM)
    (counter,) = groups
    assert isinstance(counter, FurnitureGroup)
    slab = counter.members[-1]
    assert slab.piece.category == "countertop"
    assert slab.bottom == pytest.approx(0.55 + REST_GAP_M)
    assert counter.members[slab.on].piece.size_m[2] == 0.55
    assert not left_out


@pytest.mark.parametrize("depth_m", [0.6, 0.7, 0.9, 1.2])
def test_worktop_overhangs_the_drawers_below_it_only_a_little(depth_m) -> None:
    cabinet = block("bottom_cabinet", (0.5, 0.9, 0.55), door=True)
    (counter,), _ = room_groups(pieces(block("countertop", (depth_m, 1.0, 0.03)), cabinet), ROOM)
    under, slab = counter.members
    front = under.x + under.piece.size_m[0] / 2
    assert -1e-9 <= slab.x + slab.piece.size_m[0] / 2 - front <= 0.15 + 1e-9
    assert front - under.piece.size_m[0] >= slab.x - slab.piece.size_m[0] / 2 - 1e-9


def test_worktop_without_cabinets_is_left_out_with_a_reason() -> None:
    groups, left_out = room_groups(pieces(block("countertop", (0.6, 1.0, 0.03))), ROOM)
    assert groups == []
    assert [(piece.category, reason) for piece, reason in left_out] == [
        ("countertop", "no base cabinet of counter height is left to carry it")
    ]


def test_door_panel_needs_its_width_of_free_floor() -> None:
    assert front_depth_m(block("fridge", (0.7, 0.9, 1.8), door=True)) == pytest.approx(0.9, abs=0.05)
    assert front_depth_m(block("stove", (0.6, 0.9, 0.9))) == pytest.approx(0.6)


def test_room_cut_in_two_is_not_passable() -> None:
    space = RoomSpace(ROOM, [DOOR])
    beyond = (1.0, 2.4, 3.0, 3.0)
    assert space.reachable(targets=[beyond])
    assert space.reachable([(0.0, 1.5, 0.0, 3.0, 1.7, 0.9)], [beyond])
    assert not space.reachable([(0.0, 1.5, 0.0, 4.0, 1.7, 0.9)], [beyond])
    assert space.reachable([(0.0, 1.5, 1.5, 4.0, 1.7, 1.9)], [beyond]), (
        "what hangs above the robot bars no way"
    )


def test_floor_before_a_doorway_stays_free() -> None:
    space = RoomSpace(ROOM, [DOOR])
    before, aside = (1.9, 0.1, 0.0, 2.1, 0.5, 0.8), (0.1, 0.1, 0.0, 0.5, 0.5, 0.8)
    assert space.blocks_zone(np.array([before, aside])).tolist() == [True, False]


def test_backed_furniture_faces_away_from_its_wall() -> None:
    result = furnished(block("bookcase", (0.3, 1.0, 2.0)), block("sofa", (0.9, 1.8, 0.8)))
    assert len(result.placed) == 2
    for item in result.placed:
        ahead = item.pose.apply((1.0, 0.0, 0.0))
        center = (2.06, 1.56)
        before, after = (math.dist((x, y), center) for x, y in ((item.x, item.y), ahead[:2]))
        assert after < before or before < 1.2


def test_only_pieces_that_do_not_fit_are_left_out_and_named() -> None:
    result = furnished(*[block("fridge", (0.8, 0.9, 1.8), door=True)] * 9, floor=(2.5, 2.5))
    kept = len(result.placed)
    assert 0 < kept < 9
    assert result.left_out == (f"{9 - kept} fridge-box in kitchen_0: no free place keeps the room passable",)


def test_small_objects_of_one_model_are_capped() -> None:
    result = furnished(block("breakfast_table", (0.9, 1.6, 0.75)), *[block("mug", (0.08, 0.1, 0.1))] * 40)
    mugs = [item for item in result.placed if item.piece.category == "mug"]
    assert len(mugs) == MAX_EQUAL
    assert all(
        item.relation is Relation.ONTOP and item.bottom == pytest.approx(0.75 + REST_GAP_M) for item in mugs
    )
    assert result.left_out == (
        f"{40 - MAX_EQUAL} of 40 mug-box in kitchen_0: at most {MAX_EQUAL} of a model in a room",
    )


def test_unknown_category_gets_a_role_by_its_size() -> None:
    assert role_of("gadget", (0.1, 0.1, 0.1), 0.2) is FurnitureRole.SURFACE
    assert role_of("contraption", (0.6, 1.4, 1.0), 40.0) is FurnitureRole.BACKED
    assert role_of("obelisk", (5.0, 5.0, 9.0), 4000.0) is FurnitureRole.STRUCTURE


def test_same_seed_builds_the_same_scene() -> None:
    first, again, other = (build_base_scene("hotel_suite_small", seed=seed) for seed in (0, 0, 1))
    assert (again.rooms, again.walls, again.objects) == (first.rooms, first.walls, first.objects)
    assert other.objects != first.objects


def test_names_count_from_one_within_a_category(flat: Scene) -> None:
    for category in {flat.assets[item.asset_id].category for item in flat.objects}:
        names = [item.name for item in flat.objects if flat.assets[item.asset_id].category == category]
        assert names == [f"{category}_{i + 1}" for i in range(len(names))]


def test_wall_cabinets_hang_above_the_robot_and_all_joints_are_shut(flat: Scene) -> None:
    cabinets = [item for item in flat.objects if item.name.startswith("top_cabinet")]
    assert cabinets
    assert all(box_of(flat, item).low_m[2] == pytest.approx(HUNG_BOTTOM_M, abs=0.01) for item in cabinets)
    assert all(fraction == 0.0 for item in flat.objects for fraction in item.joints)


def test_every_inventory_item_is_placed_or_accounted_for(flat: Scene) -> None:
    placed = {item.asset_id for item in flat.objects}
    for room in Catalog.load().inventory("Rs_int").rooms:
        for category, model, _ in room.items:
            asset_id = f"{category}-{model}"
            assert asset_id in placed or any(asset_id in sentence for sentence in flat.left_out), asset_id


def test_dishwasher_stays_in_the_run() -> None:
    result = furnished(
        block("fridge", (0.7, 0.65, 1.7), door=True),
        block("furniture_sink", (0.64, 1.3, 1.0)),
        block("oven", (0.5, 0.5, 0.7), door=True),
        block("dishwasher", (0.55, 0.56, 0.65), door=True),
        block("countertop", (0.56, 1.02, 0.03)),
        *[block("bottom_cabinet", (0.45, 0.43, 0.62), door=True)] * 2,
        floor=(3.4, 2.8),
    )
    assert not result.left_out
    slab, washer = (
        next(p for p in result.placed if p.piece.category == c) for c in ("countertop", "dishwasher")
    )
    (x0, y0, _, x1, y1, _), (a0, b0, _, a1, b1, _) = slab.box, washer.box
    assert x0 - 0.05 <= a0 < a1 <= x1 + 0.05
    assert y0 - 0.05 <= b0 < b1 <= y1 + 0.05


def test_kitchen_units_stand_in_one_line_or_round_a_corner() -> None:
    units = [block(c, (0.6, 0.6, 0.9)) for c in ("fridge", "stove", "oven", "dishwasher", "washer")]
    placed = furnished(*units).placed
    assert len(placed) == len(units)
    boxes = [p.box for p in placed]
    for box in boxes:
        gaps = [
            max(box[0] - o[3], o[0] - box[3], box[1] - o[4], o[1] - box[4]) for o in boxes if o is not box
        ]
        assert min(gaps) < 1.0


def test_basin_is_set_into_the_counter() -> None:
    result = furnished(
        block("countertop", (0.56, 1.02, 0.03)),
        *[block("bottom_cabinet", (0.45, 0.48, 0.62), door=True)] * 2,
        block("drop_in_sink", (0.5, 0.7, 0.3)),
    )
    basin = next(p for p in result.placed if p.piece.category == "drop_in_sink")
    slab = result.placed[basin.host]
    assert slab.piece.category == "countertop"
    assert basin.bottom == pytest.approx(slab.box[5] + REST_GAP_M)


def test_basin_without_a_counter_hangs_on_the_wall() -> None:
    (basin,) = furnished(block("drop_in_sink", (0.5, 0.7, 0.3))).placed
    assert basin.host == -1
    assert basin.bottom > 0.4


@pytest.mark.parametrize("seed", range(4))
def test_nothing_stands_in_a_doorways_clearance_and_every_chair_is_at_the_table(seed: int) -> None:
    rng = np.random.default_rng(seed)
    specs = [RoomSpec("hall_0", "corridor", (3.0, 3.0)), RoomSpec("dining_room_0", "dining_room", (4.0, 3.6))]
    plan = plan_floor(specs, rng)
    table, chair = block("breakfast_table", (0.8, 1.3, 0.75)), block("straight_chair", (0.45, 0.45, 0.8))
    assets = (table, *[chair] * 4, block("bookcase", (0.35, 0.9, 1.9)), block("sofa", (0.9, 1.8, 0.8)))
    result = furnish(plan, {"dining_room_0": pieces(*assets)}, rng)
    for room in plan.rooms:
        zones = RoomSpace(room, plan.doorways).zones
        boxes = np.array([p.box for p in result.placed if p.room == room.name]).reshape(-1, 6)
        assert not zones.meets(boxes).any()
    seats = [p for p in result.placed if p.piece.category == "straight_chair"]
    (board,) = (p for p in result.placed if p.piece.category == "breakfast_table")
    for seat in seats:
        x, y, _ = seat.pose.apply((0.225 + 0.1, 0.0, 0.0))
        assert board.box[0] <= x <= board.box[3]
        assert board.box[1] <= y <= board.box[4]


def test_seats_of_a_class_face_one_way() -> None:
    desk, chair = block("desk", (0.6, 0.75, 0.76)), block("straight_chair", (0.5, 0.5, 0.85))
    rng = np.random.default_rng(0)
    plan = plan_floor([RoomSpec("classroom_0", "classroom", (8.0, 7.0))], rng)
    result = furnish(plan, {"classroom_0": pieces(*[desk] * 9, *[chair] * 9)}, rng)
    assert len(result.placed) == 18
    assert len({round(p.yaw, 3) for p in result.placed if p.piece.category == "straight_chair"}) == 1


def test_piece_before_a_window_is_no_higher_than_its_sill() -> None:
    window = Window(("kitchen_0", ""), (2.0, 3.06), 1.2, 0.9, 2.0, "x")
    space = RoomSpace(ROOM, [DOOR], [window])
    low, tall = (1.8, 2.6, 0.0, 2.2, 2.9, 0.8), (1.8, 2.6, 0.0, 2.2, 2.9, 1.8)
    assert space.blocks_zone(np.array([low, tall])).tolist() == [False, True]


@given(
    st.lists(
        st.tuples(st.floats(0.1, 3.4), st.floats(0.1, 2.4), st.floats(0.1, 0.8), st.floats(0.1, 0.8)),
        max_size=5,
    )
)
def test_incremental_floor_equals_floor_computed_at_once(
    corners: list[tuple[float, float, float, float]],
) -> None:
    boxes = [(x, y, 0.0, x + w, y + d, 0.9) for x, y, w, d in corners]
    one_by_one, at_once = RoomSpace(ROOM, [DOOR]), RoomSpace(ROOM, [DOOR])
    for box in boxes:
        one_by_one.occupy([box])
    at_once.occupy(boxes)
    assert np.array_equal(one_by_one.free_cells(), at_once.free_cells())


def test_collisions_match_a_comparison_box_by_box() -> None:
    rng = np.random.default_rng(0)
    space = RoomSpace(ROOM, [DOOR])
    solids = [(1.0, 1.0, 0.0, 2.0, 2.0, 0.9), (3.0, 0.5, 1.2, 3.6, 1.5, 2.0)]
    space.occupy(solids)
    low = np.column_stack([rng.uniform(0, 3, (200, 2)), np.zeros(200)])
    boxes = np.column_stack([low, low + np.array([0.4, 0.3, 1.8])])
    expected = [
        any(all(b[k] < s[k + 3] and s[k] < b[k + 3] for k in range(3)) for s in solids) for b in boxes
    ]
    assert any(expected)
    assert space.solids.meets(boxes).tolist() == expected


def test_crockery_goes_behind_doors_and_milk_into_the_fridge() -> None:
    assert kept_behind_doors("plate", "bottom_cabinet")
    assert kept_behind_doors("carton_of_milk", "fridge")
    assert not kept_behind_doors("table_lamp", "bottom_cabinet")
    assert hosts_of("pillow")[0] == "bed"


WALL_TYPES = (
    *("bed", "bottom_cabinet", "bottom_cabinet_no_top", "fridge", "stove", "oven", "dishwasher", "washer"),
    *("clothes_dryer", "furniture_sink", "pedestal_sink", "toilet", "urinal", "bookcase", "wardrobe"),
    *("console_table", "nightstand", "locker", "hospital_bed", "bathtub", "shower_stall"),
)


def wall_gap_m(scene: Scene, item: SceneObject) -> float:
    """Return the gap between the back of an object and the edge of its room."""
    room = next(room for room in scene.rooms if room.name == item.room)
    box, yaw = box_of(scene, item), item.pose_world_asset.yaw
    for axis, direction in enumerate((round(math.cos(yaw)), round(math.sin(yaw)))):
        if direction:
            low, high = box.low_m[axis] - room.low_m[axis], room.high_m[axis] - box.high_m[axis]
            return low if direction > 0 else high
    raise AssertionError(f"{item.name} is at an odd angle: {yaw}")


def part_rows(scene: Scene, item: SceneObject) -> np.ndarray:
    parts = scene.asset_of(item.name).links[0].parts
    boxes = [part.aabb(item.pose_world_asset) for part in parts]
    return np.array([(*box.low_m, *box.high_m) for box in boxes])


def test_furnished_flat_has_backs_at_walls_and_free_doorways(flat: Scene) -> None:
    listed = sum(count for room in Catalog.load().inventory("Rs_int").rooms for _, _, count in room.items)
    assert len(flat.objects) / listed > 0.9
    standing = [item for item in flat.objects if item.room and not item.host]
    gaps = [wall_gap_m(flat, item) for item in standing if flat.asset_of(item.name).category in WALL_TYPES]
    assert sum(gap <= 0.15 for gap in gaps) / len(gaps) > 0.9
    free, total = 0, 0
    for room in flat.rooms:
        space = RoomSpace(room, flat.doorways)
        total += len(space.free_cells())
        for item in standing:
            rows = part_rows(flat, item)
            rows = rows[rows[:, 5] > LOW_M]
            assert item.room != room.name or not len(rows) or not space.blocks_zone(rows).any(), item.name
        space.occupy(
            [tuple(row) for item in flat.objects if item.room == room.name for row in part_rows(flat, item)]
        )
        free += len(space.free_cells())
    assert 0.1 < free / total < 1.0
