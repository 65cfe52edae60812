"""Physical mode: the robot carries out every skill once in the flat and reports failures."""

import math
from dataclasses import replace

import pytest
from tests.fakes import furniture as make
from tests.fakes.plans import executed, with_objects
from tests.fakes.scenes import kitchen_scene, placed, scene_of, upright
from tests.fakes.skill_reasons import MISHAPS, reasons_of

from embomatrix.sim.physical.actor import MOTIONS, PhysicalActor, physical_simulator
from embomatrix.sim.physical.stage import PhysicalStage
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.parse import parse_plan
from embomatrix.skills.syntax import Skill
from embomatrix.world.bundle import Bundle
from embomatrix.world.geometry import Pose
from embomatrix.world.scene import RobotStart


@pytest.fixture(scope="module")
def flat():
    simulator = physical_simulator(Bundle(kitchen_scene(), {}))
    yield simulator
    simulator.close()


def executed_physically(scene, text):
    simulator = physical_simulator(Bundle(scene, {}))
    try:
        return executed(simulator, text)
    finally:
        simulator.close()


def test_every_skill_has_a_motion_and_listed_mishaps():
    assert set(MOTIONS) == set(MISHAPS) == set(Skill)


@pytest.mark.parametrize(
    "text",
    [
        "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop",
        "move mug_1; pick_up mug_1; move coffee_table_1; place coffee_table_1 ontop",
        "move apple_1; pick_up apple_1; move breakfast_table_1; place breakfast_table_1 under",
        "move stove_1; toggle_on stove_1; toggle_off stove_1",
        "go_to_room living_room_0; turn 1; move_forward 0.5 0",
    ],
)
def test_physical_mode_succeeds_where_cached_mode_does(flat, text):
    trace = executed(flat, text)
    assert trace.failure is None, trace.steps[-1].message


@pytest.mark.parametrize(("x", "y"), [(1.1, 1.9), (1.2, 2.1), (1.0, 2.2)])
@pytest.mark.parametrize("simulator_of", [load_simulator, physical_simulator])
def test_door_that_an_obstacle_stops_is_shut_after_the_failed_attempt(simulator_of, x, y):
    fridge = make.cupboard("fridge", "electric_refrigerator.n.01", (0.7, 0.7, 1.6), abilities={})
    crate = make.block("crate", "crate.n.01", (0.3, 0.3, 0.3), {})
    objects = [
        (placed("fridge_1", fridge, "kitchen_0", upright(0.36, 2.0, 0.0, fridge), fixed=True), fridge),
        (placed("crate_1", crate, "kitchen_0", upright(x, y, 0.0, crate), fixed=True), crate),
    ]
    scene = replace(scene_of("crate", objects), robot=RobotStart(2.0, 1.2, 0.0, "kitchen_0"))
    simulator = simulator_of(Bundle(scene, {}))
    trace = executed(simulator, "move fridge_1; open fridge_1")
    is_open = simulator.facts.holds("open", ("fridge_1",))
    simulator.close()
    assert trace.failure in {FailureReason.DOOR_BLOCKED, FailureReason.ARM_BLOCKED}
    assert not is_open


@pytest.mark.parametrize("during", ["pick_up apple_1", "move countertop_1", "place countertop_1 ontop"])
def test_object_that_slips_lies_where_it_fell_and_the_hand_is_empty(flat, monkeypatch, during):
    acting = PhysicalActor.act

    def act(actor, world, call, rng):
        slips = call.skill == during.split()[0] and (call.skill != Skill.MOVE or bool(world.carried))
        with monkeypatch.context() as patch:
            if slips:
                patch.setattr(PhysicalStage, "has_slipped", lambda stage: stage.grip is not None)
            return acting(actor, world, call, rng)

    monkeypatch.setattr(PhysicalActor, "act", act)
    plan = "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop"
    trace = executed(flat, plan)
    assert (trace.failure, len(trace.steps)) == (FailureReason.SLIPPED, plan.split("; ").index(during) + 1)
    engine, dynamic = flat.world.engine, flat._actor._stage.dynamic
    assert flat.world.carried == ()
    assert not engine.is_parked("apple_1")
    lies, fell = (bodies.pose("apple_1").position_m for bodies in (engine, dynamic.bodies))
    assert math.dist(lies, fell) < 0.01
    monkeypatch.undo()
    index = [item.name for item in flat.world.scene.objects].index("apple_1")
    for call in parse_plan(f"move {index}\npick_up {index}"):
        step = flat.run_step(call)
        assert step.failure not in (FailureReason.HAND_FULL, FailureReason.SLIPPED), step.message


def test_food_is_taken_out_of_the_opened_fridge(flat):
    text = "move fridge_1; open fridge_1; move chicken_leg_1; pick_up chicken_leg_1; move fridge_1"
    trace = executed(flat, text)
    assert trace.failure is None, trace.steps[-1].message
    assert flat.world.engine.joints("fridge_1")[0] > 0.5
    assert flat.world.carried == ("chicken_leg_1",)


def test_hand_opens_and_shuts_a_door(flat):
    trace = executed(flat, "move fridge_1; open fridge_1; close fridge_1")
    assert trace.failure is None, trace.steps[-1].message
    assert flat.world.engine.joints("fridge_1")[0] < 0.05


def test_bowl_carries_its_contents_to_the_stove_and_both_get_hot(flat):
    text = (
        "move apple_1; pick_up apple_1; move bowl_1; place bowl_1 inside; pick_up bowl_1; move stove_1; "
        "place stove_1 ontop; toggle_on stove_1"
    )
    trace = executed(flat, text)
    assert trace.failure is None, trace.steps[-1].message
    assert flat.facts.holds("inside", ("apple_1", "bowl_1"))
    assert flat.facts.holds("cooked", ("apple_1",))


def test_held_object_is_lifted_and_placed_object_rests(flat):
    executed(flat, "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop")
    pose = flat.world.engine.pose("apple_1")
    assert abs(pose.position_m[2] - 0.94) < 0.005
    assert flat.world.carried == ()


def test_equal_plans_give_bit_equal_traces_after_any_history():
    text = "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop"
    bundle = Bundle(kitchen_scene(), {})
    first, second = physical_simulator(bundle), physical_simulator(bundle)
    try:
        executed(first, "move mug_1; pick_up mug_1")
        assert executed(first, text).digest == executed(second, text).digest
    finally:
        first.close()
        second.close()


def test_refused_call_moves_nothing(flat):
    trace = executed(flat, "pick_up mug_1")
    assert trace.failure is FailureReason.OUT_OF_REACH
    assert flat.world.engine.pose("apple_1") == flat.world.scene.by_name["apple_1"].pose_world_asset


def test_heavy_object_in_front_of_a_door_blocks_it():
    anvil = replace(make.block("anvil", "anvil.n.01", (0.12, 0.3, 0.28), {}), mass_kg=60.0)
    anvil_pose = upright(2.6, 3.47, 0.9, anvil, 1.5707963)
    scene = with_objects(
        kitchen_scene(), [(placed("anvil_1", anvil, "kitchen_0", anvil_pose, fixed=True), anvil)]
    )
    trace = executed_physically(scene, "move microwave_1; open microwave_1")
    assert trace.failure in {
        FailureReason.DOOR_BLOCKED,
        FailureReason.ARM_BLOCKED,
        FailureReason.NO_LINE_OF_APPROACH,
    }


def test_lid_of_a_portable_object_is_no_door():
    scene = kitchen_scene()
    objects = tuple(replace(item, fixed=item.fixed and item.name != "microwave_1") for item in scene.objects)
    trace = executed_physically(replace(scene, objects=objects), "move microwave_1; open microwave_1")
    assert trace.failure is FailureReason.ARM_BLOCKED


def test_object_walled_in_by_heavy_objects_is_unreachable():
    wall = replace(make.block("slab", "slab.n.01", (0.04, 0.6, 0.5), {}), mass_kg=50.0)
    lid = replace(make.block("lid", "lid.n.01", (0.6, 0.6, 0.04), {}), mass_kg=50.0)
    x, y, top = 1.9, 1.6, 0.75
    sides = [
        placed(f"slab_{number}", wall, "kitchen_0", upright(x + dx, y + dy, top, wall, yaw), fixed=True)
        for number, (dx, dy, yaw) in enumerate(
            [(0.12, 0.0, 0.0), (-0.12, 0.0, 0.0), (0.0, 0.34, 1.5707963), (0.0, -0.34, 1.5707963)]
        )
    ]
    cover = placed("lid_1", lid, "kitchen_0", Pose((x, y, top + 0.55)), fixed=True)
    scene = with_objects(kitchen_scene(), [*((side, wall) for side in sides), (cover, lid)])
    simulator = physical_simulator(Bundle(scene, {}))
    try:
        trace = executed(simulator, "move apple_1; pick_up apple_1")
        assert trace.failure is not None
        assert trace.failure in reasons_of(trace.steps[-1].call.skill)
    finally:
        simulator.close()


def test_watch_function_is_called_as_time_passes():
    scene = kitchen_scene()
    actor = PhysicalActor(Bundle(scene, {}))
    simulator = load_simulator(Bundle(scene, {}), actor=actor)
    seen = []
    actor.watch(lambda: seen.append(actor.dynamic.steps))
    try:
        executed(simulator, "move apple_1")
        assert seen == sorted(seen)
        assert len(seen) > 20
    finally:
        simulator.close()
