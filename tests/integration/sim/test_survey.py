"""Reachability survey of the flat, and of the flat with obstacles."""

import contextlib
from dataclasses import replace

import pytest
from tests.fakes import furniture as make
from tests.fakes.plans import executed, with_objects
from tests.fakes.scenes import kitchen_scene, placed, upright

from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.live_world import LiveWorld
from embomatrix.sim.physical.survey import ReachabilitySurvey
from embomatrix.sim.placing.pose_cache import standing_poses
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.failure import FailureReason
from embomatrix.world.bundle import Bundle, decode_bundle, encode_bundle
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import Handling, PoseCache

BOX_M = 0.14
"""Inner width of the box around the apple."""
TALL_M = 0.12
"""Height of the box: little more than the apple, so that the line of approach is clear."""
NAMES = ("apple_1", "chicken_leg_1", "microwave_1", "table_lamp_1")


def walled_in():
    """Return the flat with ``apple_1`` on its table between four boards and under a fifth."""
    x, y, top = 1.9, 1.6, 0.75
    side, lid = (
        make.block("board", "board.n.01", (0.02, 0.2, TALL_M), {}),
        make.block("lid", "board.n.01", (0.2, 0.2, 0.02), {}),
    )
    away, turn = BOX_M / 2 + 0.01, 1.5707963267948966
    at = ((away, 0.0, 0.0), (-away, 0.0, 0.0), (0.0, away, turn), (0.0, -away, turn))
    boards = [
        (placed(f"board_{n}", side, "kitchen_0", upright(x + dx, y + dy, top, side, yaw), fixed=True), side)
        for n, (dx, dy, yaw) in enumerate(at, start=1)
    ]
    roof = placed("lid_1", lid, "kitchen_0", upright(x, y, top + TALL_M, lid), fixed=True)
    return with_objects(kitchen_scene(), [*boards, (roof, lid)])


def surveyed(scene, names, foresight=None):
    """Return the cache of a scene after a survey. The world is unchanged afterwards."""
    with contextlib.closing(BulletEngine(scene)) as engine:
        poses = PoseCache({}, standing_poses(engine, names))
        world = LiveWorld(Bundle(scene, {}, poses), engine)
        before = world.state_bytes()
        found = (foresight or ReachabilitySurvey()).survey(world, poses, names)
        assert world.state_bytes() == before
        assert {name: set(stands) for name, stands in found.stands.items()} == {
            name: set(stands) for name, stands in poses.stands.items()
        }
        return found


def executed_with(scene, poses, text):
    simulator = load_simulator(Bundle(scene, {}, poses))
    try:
        return executed(simulator, text)
    finally:
        simulator.close()


@pytest.fixture(scope="module")
def flat():
    return surveyed(kitchen_scene(), NAMES)


def test_open_flat_has_no_blockers(flat):
    assert flat.arm_blockers == {}


def test_walled_in_object_is_refused_in_cached_mode_with_its_blocker():
    scene = walled_in()
    poses = surveyed(scene, ("apple_1",))
    other = poses.arm_blockers[Handling.TAKE]["apple_1"]
    assert other.startswith(("board", "lid"))
    trace = executed_with(scene, poses, "move apple_1; pick_up apple_1")
    assert trace.failure is FailureReason.ARM_BLOCKED
    assert (
        trace.steps[-1].message
        == f"the arm finds no free path to apple_1: {other} blocks it; clear the way first"
    )


def test_object_is_reachable_after_its_blocker_is_removed():
    poses = PoseCache(arm_blockers={Handling.TAKE: {"apple_1": "bowl_1"}})
    scene = kitchen_scene()
    blocked = executed_with(scene, poses, "move apple_1; pick_up apple_1")
    assert blocked.failure is FailureReason.ARM_BLOCKED
    taken = "move bowl_1; pick_up bowl_1; move countertop_1; place countertop_1 ontop; move apple_1; pick_up apple_1"
    assert executed_with(scene, poses, taken).failure is None


def test_moved_object_is_not_blocked_at_its_new_place():
    poses = PoseCache(arm_blockers={Handling.PRESS: {"table_lamp_1": "wall"}})
    blocked = executed_with(kitchen_scene(), poses, "move table_lamp_1; toggle_on table_lamp_1")
    assert blocked.failure is FailureReason.ARM_BLOCKED
    moved = "move table_lamp_1; pick_up table_lamp_1; move coffee_table_1; place coffee_table_1 ontop; toggle_on table_lamp_1"
    assert executed_with(kitchen_scene(), poses, moved).failure is None


def test_object_in_an_opened_drawer_stays_blocked():
    cabinet, apple = make.drawer_cabinet(), make.apple()
    at = upright(3.0, 2.4, 0.0, cabinet, -1.5707963267948966)
    drawers = replace(placed("bottom_cabinet_1", cabinet, "kitchen_0", at, fixed=True), joints=(0.0, 0.0))
    inside = at @ Pose((0.1, 0.0, 0.012 + apple.size_m[2] / 2))
    scene = with_objects(
        kitchen_scene(), [(drawers, cabinet), (placed("apple_9", apple, "kitchen_0", inside), apple)]
    )
    text = "move bottom_cabinet_1; open bottom_cabinet_1; pick_up apple_9"
    assert executed_with(scene, PoseCache(), text).failure is None
    blocked = PoseCache(arm_blockers={Handling.TAKE: {"apple_9": "bottom_cabinet_1"}})
    assert executed_with(scene, blocked, text).failure is FailureReason.ARM_BLOCKED


def test_lid_of_a_portable_object_is_blocked():
    scene = kitchen_scene()
    objects = tuple(replace(item, fixed=item.fixed and item.name != "microwave_1") for item in scene.objects)
    found = surveyed(replace(scene, objects=objects), ("microwave_1",))
    assert found.arm_blockers[Handling.OPEN] == {"microwave_1": "microwave_1"}


def test_results_of_other_scenes_do_not_change_answers(flat):
    foresight = ReachabilitySurvey()
    surveyed(walled_in(), ("microwave_1",), foresight)
    assert surveyed(kitchen_scene(), NAMES, foresight) == flat


def test_blockers_are_stored_in_the_bundle():
    poses = PoseCache(
        arm_blockers={Handling.OPEN: {"fridge_1": "wall"}, Handling.TAKE: {"apple_1": "bowl_1"}}
    )
    bundle = Bundle(kitchen_scene(), {}, poses)
    assert decode_bundle(encode_bundle(bundle)).poses.arm_blockers == poses.arm_blockers
    none = replace(bundle, poses=PoseCache())
    assert decode_bundle(encode_bundle(none)).poses.arm_blockers == {}
