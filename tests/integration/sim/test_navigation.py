"""Navigation: free space, distances and standing poses."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fakes.furniture import box
from tests.fakes.scenes import kitchen_scene

from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.caches import RecentCache
from embomatrix.sim.floor.grid import CELL_M, FloorGrid
from embomatrix.sim.floor.navigation import Navigator
from embomatrix.sim.state.relations import Relations
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import StandPose

COORDINATE = st.floats(-0.5, 9.5)
RECTANGLE = st.builds(
    lambda x, y, width, depth: (x, y, x + width, y + depth),
    COORDINATE,
    st.floats(-0.5, 4.5),
    st.floats(0.02, 1.5),
    st.floats(0.02, 1.5),
)


def rows_of(rectangles) -> np.ndarray:
    """Return obstacles from the floor to 1 m, shape (n, 6)."""
    return np.array([(*rectangle, 0.0, 1.0) for rectangle in rectangles]).reshape(-1, 6)


@pytest.fixture(scope="module")
def pool():
    pool = ClientPool()
    yield pool
    pool.close()


@pytest.fixture
def engine(pool):
    engine = BulletEngine(kitchen_scene(), pool)
    yield engine
    engine.close()


@pytest.fixture
def navigator(engine):
    return Navigator(engine, Relations(engine))


def walled_off(scene):
    """Return the flat with its doorway bricked up."""
    return dataclasses.replace(scene, walls=(*scene.walls, box((5.05, 2, 1.2), (0.1, 0.9, 2.4))))


def metres_between(navigator: Navigator, start: StandPose, end: StandPose) -> float | None:
    """Length of the shortest free path between two poses, None for no path."""
    grid = navigator.ground.grid
    first, last = (grid.cell(pose.x_m, pose.y_m) for pose in (start, end))
    return grid.distance(first, last) if first is not None and last is not None else None


def test_every_object_has_standing_poses_within_reach_that_face_it(engine, navigator) -> None:
    for name in engine.scene.by_name:
        stands = navigator.stands(name, navigator.start)
        assert stands, name
        low, high = np.array(engine.aabb(name).low_m[:2]), np.array(engine.aabb(name).high_m[:2])
        for stand in stands:
            at = np.array((stand.x_m, stand.y_m))
            offset = np.clip(at, low, high) - at
            assert ROBOT.shoulder_m <= np.linalg.norm(offset) <= ROBOT.reach_m
            assert math.atan2(offset[1], offset[0]) == pytest.approx(stand.yaw)
            assert metres_between(navigator, navigator.start, stand) is not None


def test_robot_never_stands_within_its_radius_of_a_part_or_wall(engine, navigator) -> None:
    corners = [
        (part.aabb(item.pose_world_asset))
        for item in engine.scene.objects
        if item.fixed
        for part in engine.scene.asset_of(item.name).links[0].parts
    ]
    corners += [wall.aabb(Pose((0, 0, 0))) for wall in engine.scene.walls]
    for name in engine.scene.by_name:
        for stand in navigator.stands(name, navigator.start):
            at = np.array((stand.x_m, stand.y_m))
            for part in corners:
                if part.low_m[2] < ROBOT.height_m:
                    nearest = np.clip(at, part.low_m[:2], part.high_m[:2])
                    assert np.linalg.norm(at - nearest) > ROBOT.radius_m - 0.051


def test_object_with_a_door_is_served_from_its_front(navigator) -> None:
    for stand in navigator.stands("cabinet_1", navigator.start):
        assert stand.y_m > 0.45
        assert abs(math.atan2(stand.x_m - 6.5, stand.y_m - 0.225)) <= math.radians(65.5)


def test_object_on_a_shelf_is_served_from_the_shelf_front(navigator) -> None:
    assert all(stand.x_m < 8.8 for stand in navigator.stands("mug_1", navigator.start))


def test_arm_passes_an_open_door_panel_but_not_the_sides_of_furniture(engine, navigator) -> None:
    abeam, ahead = StandPose(1.3, 3.6, math.pi), StandPose(0.6, 2.9, math.pi / 2)
    assert not navigator.line_is_clear(abeam, "chicken_leg_1")
    assert navigator.line_is_clear(ahead, "chicken_leg_1")
    behind = StandPose(2.0, 2.2, -math.pi / 2)
    engine.set_pose("chicken_leg_1", Pose((2.0, 1.7, 0.025)))
    assert navigator.line_is_clear(behind, "chicken_leg_1")  # under the table: its legs leave room


def test_arm_does_not_pass_through_walls(engine, navigator) -> None:
    engine.set_pose("apple_1", Pose((4.9, 0.8, 0.04)))
    navigator.refresh()
    stands = navigator.stands("apple_1", navigator.start)
    assert stands
    assert all(stand.x_m < 5.0 for stand in stands)
    assert not navigator.line_is_clear(StandPose(5.5, 0.8, math.pi), "apple_1")
    assert navigator.line_is_clear(StandPose(4.2, 0.8, 0.0), "apple_1")


def test_path_leads_around_furniture_and_through_the_doorway(navigator) -> None:
    start, target = navigator.start, navigator.stands("mug_1", navigator.start)[0]
    length = metres_between(navigator, start, target)
    straight = math.dist((start.x_m, start.y_m), (target.x_m, target.y_m))
    assert length is not None
    assert straight <= length <= 1.4 * straight
    assert metres_between(navigator, target, start) == pytest.approx(length, abs=1e-4)


def test_straight_drives_between_path_corners_have_about_its_length(navigator) -> None:
    start, end = StandPose(4.5, 0.5, 0.0), StandPose(8.0, 0.5, 0.0)
    corners = navigator.path(start, end)
    points = [(start.x_m, start.y_m), *corners, (end.x_m, end.y_m)]
    driven = sum(math.dist(a, b) for a, b in itertools.pairwise(points))
    assert corners
    assert driven <= metres_between(navigator, start, end) + 0.2
    for (ax, ay), (bx, by) in itertools.pairwise(corners):
        yaw, length = math.atan2(by - ay, bx - ax), math.dist((ax, ay), (bx, by))
        assert navigator.forward(StandPose(ax, ay, yaw), yaw, length) == pytest.approx(length)


def test_no_path_leads_through_a_bricked_up_doorway(pool) -> None:
    engine = BulletEngine(walled_off(kitchen_scene()), pool)
    navigator = Navigator(engine, Relations(engine))
    assert navigator.stands("mug_1", navigator.start) == ()
    assert navigator.room_entry("living_room_0", navigator.start) is None
    assert metres_between(navigator, navigator.start, StandPose(7.0, 1.2, 0.0)) is None
    engine.close()


def test_room_entry_is_just_behind_its_door(engine, navigator) -> None:
    entry = navigator.room_entry("living_room_0", navigator.start)
    assert entry is not None
    assert engine.scene.room_at((entry.x_m, entry.y_m)) == "living_room_0"
    assert math.dist((entry.x_m, entry.y_m), (5.05, 2.0)) < 0.7
    assert navigator.room_entry("kitchen_0", navigator.start) == navigator.start


def test_unknown_room_is_a_key_error(navigator) -> None:
    with pytest.raises(KeyError):
        navigator.room_entry("attic_0", navigator.start)


@pytest.mark.parametrize(
    ("yaw", "distance_m", "low_m", "high_m"),
    [(0.0, 0.5, 0.5, 0.5), (0.0, 5.0, 1.1, 1.27), (math.pi / 2, 5.0, 1.5, 1.68), (math.pi, 5.0, 0.7, 0.86)],
)
def test_driving_forward_stops_in_front_of_obstacles(navigator, yaw, distance_m, low_m, high_m) -> None:
    assert low_m <= navigator.forward(navigator.start, yaw, distance_m) <= high_m


def test_object_on_the_floor_blocks_the_path_until_it_is_picked_up(engine, navigator) -> None:
    before = navigator.forward(navigator.start, 0.0, 1.0)
    engine.set_pose("bowl_1", Pose((4.2, 1.5, 0.035)))
    navigator.refresh()
    assert navigator.forward(navigator.start, 0.0, 1.0) < before
    engine.park("bowl_1")
    navigator.refresh()
    assert navigator.forward(navigator.start, 0.0, 1.0) == before


def test_warmed_up_floors_with_one_open_object_equal_fresh_ones(engine, navigator) -> None:
    jointed = [item for item in engine.scene.objects if item.fixed and item.joints]
    ahead = Navigator(engine, Relations(engine))
    assert len(list(ahead.ground.warm_up())) == len(jointed) > 0
    for item in jointed:
        engine.set_joints(item.name, (1.0,) * len(item.joints))
        for each in (ahead, navigator):
            each.refresh()
        assert _parts_are_equal(ahead.ground.grid, navigator.ground.grid), item.name
        engine.reset()


def test_robot_drives_to_the_first_standing_pose_with_any_open_doors(engine, navigator) -> None:
    openable = [item for item in engine.scene.objects if item.fixed and item.joints]
    for opened in (None, *openable):
        if opened is not None:
            engine.set_joints(opened.name, (1.0,) * len(opened.joints))
        navigator.refresh()
        for item in engine.scene.objects:
            stands = navigator.stands(item.name, navigator.start)
            assert navigator.nearest_stand(item.name, navigator.start) == (stands[0] if stands else None)
        engine.reset()


def test_place_off_the_map_is_not_reachable(navigator) -> None:
    for x, y in ((-50.0, 0.0), (math.nan, 1.0), (2.0, 1.3)):
        assert metres_between(navigator, navigator.start, StandPose(x, y, 0.0)) is None


@settings(max_examples=40, deadline=None)
@given(st.lists(RECTANGLE, max_size=6), st.lists(RECTANGLE, max_size=4), st.data())
def test_changed_grid_equals_a_fresh_one(start, come, data) -> None:
    scene = kitchen_scene()
    gone = data.draw(st.lists(st.sampled_from(start), unique=True)) if start else []
    left = [row for row in start if row not in gone]
    start = left + gone
    changed = FloorGrid(scene, rows_of(start)).changed(rows_of(gone), rows_of(come))
    fresh = FloorGrid(scene, rows_of(left + come))
    assert (changed.free == fresh.free).all()
    assert _parts_are_equal(changed, fresh)
    back = changed.changed(rows_of(come), rows_of(gone))
    assert (back.free == FloorGrid(scene, rows_of(start)).free).all()
    assert _parts_are_equal(back, FloorGrid(scene, rows_of(start)))
    assert (changed.covered == fresh.covered).all()
    assert _parts_are_equal(changed.narrowed(rows_of(gone)), fresh.narrowed(rows_of(gone)))


@settings(max_examples=40, deadline=None)
@given(st.lists(RECTANGLE, max_size=6), st.lists(RECTANGLE, max_size=3), st.lists(RECTANGLE, max_size=4))
def test_narrowed_grid_equals_a_fresh_one(start, come, panels) -> None:
    scene = kitchen_scene()
    grid = FloorGrid(scene, rows_of(start)).changed(rows_of([]), rows_of(come))
    narrowed = grid.narrowed(rows_of(panels))
    fresh = FloorGrid(scene, rows_of(start + come + panels))
    assert (narrowed.free == fresh.free).all()
    assert _parts_are_equal(narrowed, fresh)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(RECTANGLE, max_size=6),
    st.lists(RECTANGLE, max_size=2),
    st.lists(RECTANGLE, min_size=1, max_size=3),
    COORDINATE,
    COORDINATE,
)
def test_main_part_is_the_largest_remaining_component_around_a_point(start, come, panels, x, y) -> None:
    wide = FloorGrid(kitchen_scene(), rows_of(start)).changed(rows_of([]), rows_of(come))
    narrowed = wide.narrowed(rows_of(panels))
    cell = wide.cell(x, y)
    if cell is None:
        assert narrowed.main_part_of(wide, x, y) == 0
        return
    left = narrowed.labels[(wide.labels == wide.label(cell)) & narrowed.free]
    main = narrowed.main_part_of(wide, x, y)
    assert (left == main).sum() == max([0, *np.bincount(left)])
    if wide.label_at(x, y) and not narrowed.may_differ_at(wide, x, y):
        assert narrowed.label_at(x, y), "it is as free as before"


def _parts_are_equal(grid: FloorGrid, other: FloorGrid) -> bool:
    """Return True if the connected parts agree up to their numbering."""
    assert all(grid.label(cell) == grid.labels[cell] for cell in np.ndindex(grid.labels.shape))
    pairs = set(zip(grid.labels.flat, other.labels.flat, strict=True))
    numbers = len(set(grid.labels.flat)), len(set(other.labels.flat))
    return numbers == (len(pairs), len(pairs)) and all((a == 0) == (b == 0) for a, b in pairs)


@settings(max_examples=60, deadline=None)
@given(COORDINATE, COORDINATE)
def test_robot_beside_free_cells_snaps_to_the_nearest(x, y) -> None:
    grid = FloorGrid(kitchen_scene(), rows_of([(2.0, 1.0, 3.0, 2.0)]))
    cell = grid.cell(x, y)
    free = np.argwhere(grid.free)
    centers = np.array([grid.center((int(i), int(j))) for i, j in free])
    nearest = float(np.linalg.norm(centers - (x, y), axis=1).min())
    if cell is None:
        assert nearest > 6 * CELL_M - CELL_M
    else:
        assert grid.free[cell]
        assert float(np.linalg.norm(np.array(grid.center(cell)) - (x, y))) <= nearest + CELL_M


def test_only_recently_used_values_are_cached():
    recent: RecentCache[int, object] = RecentCache(3)
    first = recent.get(0, object)
    assert recent.get(0, object) is first
    for key in range(1, 4):
        recent.get(key, object)
    assert recent.get(3, object) is recent.get(3, object)
    assert recent.get(0, object) is not first
