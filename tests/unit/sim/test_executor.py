"""Plans executed in the flat: the rules of the skills, every reason of failure, and traces that repeat to the bit."""

from dataclasses import replace

import pytest
from tests.fakes import furniture as make
from tests.fakes.plans import NOTHING, awkward_scene, plan_of, task_over
from tests.fakes.scenes import kitchen_scene, placed, scene_of, upright

from embomatrix.reward.hierarchy import score
from embomatrix.sim.executor import Simulator
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.library import LIBRARY, reasons_of
from embomatrix.skills.syntax import Skill
from embomatrix.world.bundle import Bundle
from embomatrix.world.goal import And, Atom
from embomatrix.world.scene import RobotStart
from embomatrix.world.state import Relation

HEATED = And((Atom("hot", ("chicken_leg_1",)), Atom("inside", ("chicken_leg_1", "microwave_1"))))
FETCH = "move microwave_1; open microwave_1; move fridge_1; open fridge_1; pick_up chicken_leg_1; move microwave_1"
STOCK = f"{FETCH}; place microwave_1 inside"


@pytest.fixture(scope="module")
def flat():
    simulator = Simulator(Bundle(kitchen_scene(), {}))
    yield simulator
    simulator.close()


@pytest.fixture(scope="module")
def awkward():
    simulator = Simulator(Bundle(awkward_scene(), {}))
    yield simulator
    simulator.close()


def run(simulator, text, goal=NOTHING, seed=0):
    task = task_over(simulator.world.scene, goal)
    return simulator.execute(task, plan_of(task, text), seed)


def run_alone(scene, text):
    """Execute in a scene of its own."""
    simulator = Simulator(Bundle(scene, {}))
    try:
        return run(simulator, text)
    finally:
        simulator.close()


def failures(trace):
    return [step.failure for step in trace.steps if step.failure is not None]


# The paper's three plans for "Heat Chicken".


def test_gpt_4o_forgets_to_open_the_microwave_and_fails_at_placing(flat):
    plan = "move fridge_1; open fridge_1; pick_up chicken_leg_1; move microwave_1; place microwave_1 inside"
    plan += "; toggle_on microwave_1"
    trace = run(flat, plan, HEATED)
    assert trace.failure is FailureReason.CONTAINER_CLOSED
    assert trace.steps[-1].message == "microwave_1 is closed: open it first"
    assert len(trace.steps) == 5
    assert score(task_over(flat.world.scene, HEATED), trace.touched, flat.facts).goal == 0.0


def test_deepseek_r1_never_switches_the_microwave_on_and_earns_half(flat):
    trace = run(flat, f"{STOCK}; close microwave_1", HEATED)
    reward = score(task_over(flat.world.scene, HEATED), trace.touched, flat.facts)
    assert trace.failure is None
    assert reward.goal == 15.0
    assert not reward.success


def test_embobrain_opens_inserts_closes_switches_on_and_succeeds(flat):
    trace = run(flat, f"{STOCK}; close microwave_1; toggle_on microwave_1", HEATED)
    reward = score(task_over(flat.world.scene, HEATED), trace.touched, flat.facts)
    assert reward.success
    assert reward.total == pytest.approx(0.5 + 2 * 0.2 + 30.0)
    assert "chicken_leg_1 is now hot and cooked" in trace.steps[-1].message


# Every reason of failure, each by the shortest plan that meets it.

REACHED = {
    FailureReason.UNKNOWN_INDEX: "pick_up 99",
    FailureReason.UNKNOWN_ROOM: "go_to_room attic_0",
    FailureReason.BLOCKED: "move_forward 4.9 0",
    FailureReason.STEP_TOO_LONG: "move_forward 6 0",
    FailureReason.OUT_OF_REACH: "pick_up mug_1",
    FailureReason.TOO_HIGH: "pick_up apple_4",
    FailureReason.HAND_FULL: "move apple_1; pick_up apple_1; move fridge_1; open fridge_1",
    FailureReason.HAND_EMPTY: "move fridge_1; place fridge_1 ontop",
    FailureReason.NOT_PORTABLE: "move fridge_1; pick_up fridge_1",
    FailureReason.TOO_HEAVY: "move anvil_1; pick_up anvil_1",
    FailureReason.SUPPORTS_OTHERS: "move tray_1; pick_up tray_1",
    FailureReason.CONTAINER_CLOSED: "move chicken_leg_1; pick_up chicken_leg_1",
    FailureReason.NOT_OPENABLE: "move stove_1; open stove_1",
    FailureReason.ALREADY_OPEN: "move fridge_1; open fridge_1; open fridge_1",
    FailureReason.ALREADY_CLOSED: "move fridge_1; close fridge_1",
    FailureReason.OPENED_WHILE_ON: "move microwave_1; toggle_on microwave_1; open microwave_1",
    FailureReason.NOT_TOGGLEABLE: "move fridge_1; toggle_on fridge_1",
    FailureReason.ALREADY_ON: "move stove_1; toggle_on stove_1; toggle_on stove_1",
    FailureReason.ALREADY_OFF: "move stove_1; toggle_off stove_1",
    FailureReason.MUST_BE_CLOSED: "move microwave_1; open microwave_1; toggle_on microwave_1",
    FailureReason.NO_SURFACE: "move bowl_1; pick_up bowl_1; move apple_1; place apple_1 ontop",
    FailureReason.NO_CAVITY: "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 inside",
    FailureReason.PLACE_ON_ITSELF: "move apple_1; pick_up apple_1; place apple_1 ontop",
    FailureReason.NOT_A_HEAT_SOURCE: "heat_object_with_source apple_1 fridge_1",
    FailureReason.NOT_A_COLD_SOURCE: "froze_object_with_source apple_1 stove_1",
    FailureReason.NOT_HEATABLE: "heat_object_with_source table_lamp_1 stove_1",
    FailureReason.NOT_COOKABLE: "cook_object_with_tool mug_1 stove_1",
    FailureReason.NOT_FREEZABLE: "froze_object_with_source mug_1 fridge_1",
    FailureReason.SOURCE_OFF: "move apple_1; pick_up apple_1; move stove_1; place stove_1 ontop; "
    "heat_object_with_source apple_1 stove_1",
    FailureReason.SOURCE_OPEN: "move fridge_1; open fridge_1; froze_object_with_source chicken_leg_1 fridge_1",
    FailureReason.NOT_AT_SOURCE: "move stove_1; heat_object_with_source apple_1 stove_1",
    FailureReason.NOT_HOT_ENOUGH: "move apple_1; pick_up apple_1; move warmer_1; place warmer_1 ontop; "
    "cook_object_with_tool apple_1 warmer_1",
    FailureReason.NOT_COLD_ENOUGH: "move apple_1; pick_up apple_1; move cooler_1; place cooler_1 inside; "
    "froze_object_with_source apple_1 cooler_1",
}
ELSEWHERE = {
    FailureReason.NO_PATH,
    FailureReason.NO_STANDING_POSE,
    FailureReason.NO_LINE_OF_APPROACH,
    FailureReason.TOO_LARGE,
    FailureReason.DOOR_BLOCKED,
    FailureReason.NO_FREE_POSE,
}
"""Reasons that the tests below this table meet in scenes of their own."""


@pytest.mark.parametrize("reason", list(REACHED))
def test_a_plan_meets_the_reason(awkward, reason):
    trace = run(awkward, REACHED[reason])
    assert failures(trace) == [reason], trace.steps[-1].message
    assert trace.steps[-1].failure in reasons_of(trace.steps[-1].call.skill)


def test_every_reason_is_met_by_some_test():
    assert set(REACHED) | ELSEWHERE == set(FailureReason)
    assert not set(REACHED) & ELSEWHERE


def test_no_path_leads_into_a_room_without_a_door():
    trace = run_alone(replace(kitchen_scene(), doorways=()), "move apple_2")
    assert trace.failure is FailureReason.NO_PATH
    assert trace.steps[0].message == "the robot can't get to apple_2: no free path leads there"


def test_a_room_without_a_door_can_not_be_entered():
    trace = run_alone(replace(kitchen_scene(), doorways=()), "go_to_room living_room_0")
    assert trace.failure is FailureReason.NO_PATH


def test_what_lies_in_the_middle_of_a_huge_table_can_not_be_reached():
    island, apple = make.block("island", "island.n.01", (2.6, 2.6, 0.5), {}), make.apple()
    scene = scene_of(
        "island",
        [
            (placed("island_1", island, "kitchen_0", upright(2.5, 2.0, 0, island), fixed=True), island),
            (placed("apple_1", apple, "kitchen_0", upright(2.5, 2.0, 0.5, apple)), apple),
        ],
    )
    trace = run_alone(replace(scene, robot=RobotStart(0.5, 0.5, 0.0, "kitchen_0")), "move apple_1")
    assert trace.failure is FailureReason.NO_STANDING_POSE


def test_the_arm_does_not_reach_through_a_wall():
    low, apple = make.coffee_table(), make.apple()
    scene = scene_of(
        "wall",
        [
            (placed("table_1", low, "living_room_0", upright(5.5, 0.7, 0, low), fixed=True), low),
            (placed("apple_1", apple, "living_room_0", upright(5.4, 0.7, 0.45, apple)), apple),
        ],
    )
    trace = run_alone(replace(scene, robot=RobotStart(4.7, 0.7, 0.0, "kitchen_0")), "pick_up apple_1")
    assert trace.failure is FailureReason.NO_LINE_OF_APPROACH


def test_a_chest_is_too_large_for_the_gripper():
    chest = replace(make.block("chest", "chest.n.01", (0.5, 0.5, 0.5), {}), mass_kg=3.0)
    scene = scene_of("chest", [(placed("chest_1", chest, "kitchen_0", upright(1.5, 1.5, 0, chest)), chest)])
    trace = run_alone(scene, "move chest_1; pick_up chest_1")
    assert trace.failure is FailureReason.TOO_LARGE
    assert trace.steps[-1].message == "chest_1 measures 0.50 m and the gripper takes at most 0.30 m"


def in_front_of_the_microwave():
    counter, microwave, mug = make.counter(), make.microwave(), make.mug()
    south = -1.5707963267948966
    return scene_of(
        "door",
        [
            (
                placed("counter_1", counter, "kitchen_0", upright(2.2, 3.7, 0, counter, south), fixed=True),
                counter,
            ),
            (
                placed(
                    "microwave_1",
                    microwave,
                    "kitchen_0",
                    upright(2.6, 3.79, 0.9, microwave, south),
                    fixed=True,
                ),
                microwave,
            ),
            (placed("mug_1", mug, "kitchen_0", upright(2.6, 3.47, 0.9, mug)), mug),
        ],
    )


def test_a_mug_in_front_of_the_microwave_keeps_its_door_shut():
    trace = run_alone(in_front_of_the_microwave(), "move microwave_1; open microwave_1")
    assert trace.failure is FailureReason.DOOR_BLOCKED
    assert trace.steps[-1].message == "mug_1 is in the way of the door of microwave_1"


def test_a_door_that_is_blocked_stays_as_it_was():
    simulator = Simulator(Bundle(in_front_of_the_microwave(), {}))
    run(simulator, "move microwave_1; open microwave_1")
    assert not simulator.facts.holds("open", ("microwave_1",))
    simulator.close()


def test_a_full_bowl_takes_nothing_more(flat):
    trace = run(
        flat,
        "move apple_1; pick_up apple_1; move bowl_1; place bowl_1 inside; move mug_1; pick_up mug_1; "
        "move bowl_1; place bowl_1 inside; move apple_2; pick_up apple_2; move bowl_1; place bowl_1 inside; "
        "move table_lamp_1; pick_up table_lamp_1; move bowl_1; place bowl_1 inside",
    )
    assert trace.failure is FailureReason.NO_FREE_POSE


# The rules of the household, as sentences.


def test_a_failed_step_stops_the_plan_and_changes_nothing(flat):
    trace = run(flat, "move apple_1; pick_up fridge_1; pick_up apple_1")
    assert len(trace.steps) == 2
    assert trace.touched == {"apple_1"}
    assert flat.facts.holds("ontop", ("apple_1", "breakfast_table_1"))


def test_one_arm_holds_one_object(flat):
    trace = run(flat, "move apple_1; pick_up apple_1; move bowl_1; pick_up bowl_1")
    assert trace.steps[-1].message == "the hand holds apple_1: place it first"


@pytest.mark.parametrize("skill", ["open fridge_1", "toggle_on stove_1"])
def test_doors_and_switches_need_a_free_hand(flat, skill):
    trace = run(flat, f"move apple_1; pick_up apple_1; move {skill.split()[1]}; {skill}")
    assert trace.failure is FailureReason.HAND_FULL


def test_what_is_in_the_hand_stands_in_no_relation(flat):
    run(flat, "move apple_1; pick_up apple_1")
    assert not flat.facts.holds("ontop", ("apple_1", "breakfast_table_1"))
    assert not flat.facts.holds("inroom", ("apple_1", "kitchen_0"))


def test_what_lies_in_a_bowl_goes_where_the_bowl_goes(flat):
    trace = run(
        flat,
        "move apple_1; pick_up apple_1; move bowl_1; place bowl_1 inside; pick_up bowl_1; "
        "move coffee_table_1; place coffee_table_1 ontop",
    )
    assert trace.failure is None
    assert "holds bowl_1 with apple_1 in it" in trace.steps[4].message
    assert flat.facts.holds("inside", ("apple_1", "bowl_1"))
    assert flat.facts.holds("inroom", ("apple_1", "living_room_0"))


def test_what_lies_in_the_bowl_in_the_hand_is_no_place_for_the_bowl(flat):
    trace = run(
        flat,
        "move apple_1; pick_up apple_1; move bowl_1; place bowl_1 inside; pick_up bowl_1; place apple_1 ontop",
    )
    assert trace.failure is FailureReason.PLACE_ON_ITSELF


def test_the_robot_can_not_drive_to_what_it_holds(flat):
    trace = run(flat, "move apple_1; pick_up apple_1; move apple_1")
    assert trace.failure is FailureReason.HAND_FULL


def test_nothing_is_placed_on_what_stands_in_a_closed_container(flat):
    trace = run(flat, "move apple_1; pick_up apple_1; move chicken_leg_1; place chicken_leg_1 ontop")
    assert trace.failure is FailureReason.CONTAINER_CLOSED


def test_a_bowl_needs_no_opening(flat):
    assert run(flat, "move apple_1; pick_up apple_1; move bowl_1; place bowl_1 inside").failure is None


def test_going_to_the_room_one_is_in_changes_nothing(flat):
    trace = run(flat, "go_to_room kitchen_0")
    assert trace.failure is None
    assert flat.world.robot == flat.world.navigator.start


def test_going_to_another_room_leads_through_its_door(flat):
    assert run(flat, "go_to_room living_room_0").failure is None
    assert flat.world.robot_room == "living_room_0"


def test_turning_adds_to_the_heading(flat):
    run(flat, "turn 1.5; turn 1.5; turn 1.5")
    assert flat.world.robot.yaw == pytest.approx(4.5 - 2 * 3.141592653589793)


def test_driving_turns_first_and_goes_straight_on(flat):
    before = flat.world.navigator.start
    run(flat, "move_forward 0.5 1.5707963267948966")
    assert flat.world.robot.x_m == pytest.approx(before.x_m)
    assert flat.world.robot.y_m == pytest.approx(before.y_m + 0.5)
    assert flat.world.robot.yaw == pytest.approx(before.yaw + 1.5707963267948966)


def test_a_negative_distance_drives_backwards_and_keeps_the_heading(flat):
    before = flat.world.navigator.start
    run(flat, "move_forward -0.3 0")
    assert flat.world.robot.x_m == pytest.approx(before.x_m - 0.3)
    assert flat.world.robot.yaw == before.yaw


def test_a_switch_can_be_thrown_back(flat):
    run(flat, "move table_lamp_1; toggle_on table_lamp_1; toggle_off table_lamp_1")
    assert not flat.facts.holds("toggled_on", ("table_lamp_1",))


@pytest.mark.parametrize("relation", ["ontop", "under"])
def test_placing_makes_the_relation_true(flat, relation):
    run(flat, f"move mug_1; pick_up mug_1; move breakfast_table_1; place breakfast_table_1 {relation}")
    assert flat.facts.holds(relation, ("mug_1", "breakfast_table_1"))
    assert flat.world.carried == ()


def test_every_skill_can_succeed(flat):
    plans = [
        f"{STOCK}; close microwave_1; toggle_on microwave_1; heat_object_with_source chicken_leg_1 microwave_1; "
        "cook_object_with_tool chicken_leg_1 microwave_1; toggle_off microwave_1",
        "move fridge_1; froze_object_with_source chicken_leg_1 fridge_1; turn 1; go_to_room living_room_0; "
        "move_forward 0.05 0",
    ]
    traces = [run(flat, text) for text in plans]
    assert [trace.failure for trace in traces] == [None, None]
    assert {step.call.skill for trace in traces for step in trace.steps} == set(Skill) == set(LIBRARY)


# Traces.


def test_equal_plans_and_seeds_give_equal_traces_to_the_bit(flat):
    first = run(flat, f"{STOCK}; close microwave_1", seed=7)
    run(flat, "move mug_1; pick_up mug_1", seed=3)
    second = run(flat, f"{STOCK}; close microwave_1", seed=7)
    assert first == second
    assert first.digest.startswith("sha256:")


def test_a_simulator_of_its_own_gives_the_same_trace(flat):
    assert run_alone(kitchen_scene(), STOCK) == run(flat, STOCK)


def test_another_seed_places_elsewhere_and_means_the_same(flat):
    text = "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop"
    traces = [run(flat, text, seed=seed) for seed in range(4)]
    assert len({trace.digest for trace in traces}) > 1
    assert len({trace.steps for trace in traces}) == 1


def test_plans_that_differ_have_different_digests(flat):
    assert run(flat, "turn 1").digest != run(flat, "turn 2").digest


def test_an_empty_plan_is_executed_and_fails_nowhere(flat):
    task = task_over(flat.world.scene)
    trace = flat.execute(task, (), 0)
    assert trace.failure is None
    assert trace.touched == frozenset()


def test_touched_are_the_objects_of_calls_that_succeeded_and_their_sources(flat):
    trace = run(flat, "move fridge_1; froze_object_with_source chicken_leg_1 fridge_1; pick_up stove_1")
    assert trace.touched == {"fridge_1", "chicken_leg_1"}


def test_the_final_state_is_told_in_words(flat):
    trace = run(flat, f"{STOCK}; close microwave_1; toggle_on microwave_1", HEATED)
    assert "chicken_leg_1: inside microwave_1 in kitchen_0, cooked, hot" in trace.final
    assert "microwave_1: on countertop_1 in kitchen_0, closed, on" in trace.final


def test_the_final_state_tells_what_the_hand_holds(flat):
    trace = run(flat, "move apple_1; pick_up apple_1", And((Atom("hot", ("apple_1",)),)))
    assert trace.final[-1] == "apple_1: in the robot's hand"


def test_a_step_at_a_time_goes_on_after_a_failure(flat):
    task = task_over(flat.world.scene)
    flat.reset(task, 0)
    failed, moved = (flat.run_step(call) for call in plan_of(task, "pick_up apple_1; move apple_1"))
    assert failed.failure is FailureReason.OUT_OF_REACH
    assert moved.ok


def test_relations_of_the_goal_are_asked_by_their_own_names(flat):
    run(flat, "turn 0")
    assert flat.facts.holds(Relation.ONTOP.value, ("bowl_1", "breakfast_table_1"))
