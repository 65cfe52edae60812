"""Plans executed in the flat: rules of the skills, failure reasons, and bit-equal traces."""

from dataclasses import replace

import pytest
from tests.fakes.plans import executed, executed_alone, plan_of, task_over
from tests.fakes.scenes import kitchen_scene

from embomatrix.reward.hierarchy import score
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.parse import parse_plan
from embomatrix.skills.prompt import EXAMPLES, Codec
from embomatrix.skills.syntax import PROFILES
from embomatrix.world.bundle import Bundle
from embomatrix.world.goal import And, Atom
from embomatrix.world.state import Relation
from embomatrix.world.task import Profile

HEATED = And((Atom("hot", ("chicken_leg_1",)), Atom("inside", ("chicken_leg_1", "microwave_1"))))
FETCH = "move microwave_1; open microwave_1; move fridge_1; open fridge_1; pick_up chicken_leg_1; move microwave_1"
STOCK = f"{FETCH}; place microwave_1 inside"


@pytest.fixture(scope="module")
def flat():
    simulator = load_simulator(Bundle(kitchen_scene(), {}))
    yield simulator
    simulator.close()


# The paper's three plans for "Heat Chicken".


def test_gpt_4o_forgets_to_open_the_microwave_and_fails_at_placing(flat):
    plan = "move fridge_1; open fridge_1; pick_up chicken_leg_1; move microwave_1; place microwave_1 inside"
    plan += "; toggle_on microwave_1"
    trace = executed(flat, plan, HEATED)
    assert trace.failure is FailureReason.CONTAINER_CLOSED
    assert trace.steps[-1].message == "microwave_1 is closed: open it first"
    assert len(trace.steps) == 5
    assert score(task_over(flat.world.scene, HEATED), trace.touched, flat.facts).goal == 0.0


def test_deepseek_r1_never_switches_the_microwave_on_and_earns_half(flat):
    trace = executed(flat, f"{STOCK}; close microwave_1", HEATED)
    reward = score(task_over(flat.world.scene, HEATED), trace.touched, flat.facts)
    assert trace.failure is None
    assert reward.goal == 15.0
    assert not reward.success


def test_embobrain_opens_inserts_closes_switches_on_and_succeeds(flat):
    trace = executed(flat, f"{STOCK}; close microwave_1; toggle_on microwave_1", HEATED)
    reward = score(task_over(flat.world.scene, HEATED), trace.touched, flat.facts)
    assert reward.success
    assert reward.total == pytest.approx(0.5 + 2 * 0.2 + 30.0)
    assert "chicken_leg_1 is now hot and cooked" in trace.steps[-1].message


# The rules of the household, as sentences.


def test_failed_step_stops_the_plan_and_changes_nothing(flat):
    trace = executed(flat, "move apple_1; pick_up fridge_1; pick_up apple_1")
    assert len(trace.steps) == 2
    assert trace.touched == {"apple_1"}
    assert flat.facts.holds("ontop", ("apple_1", "breakfast_table_1"))


def test_one_arm_holds_one_object(flat):
    trace = executed(flat, "move apple_1; pick_up apple_1; move bowl_1; pick_up bowl_1")
    assert trace.steps[-1].message == "the hand holds apple_1: place it first"


@pytest.mark.parametrize("skill", ["open fridge_1", "toggle_on stove_1"])
def test_doors_and_switches_need_a_free_hand(flat, skill):
    trace = executed(flat, f"move apple_1; pick_up apple_1; move {skill.split()[1]}; {skill}")
    assert trace.failure is FailureReason.HAND_FULL


def test_held_object_has_no_relations(flat):
    executed(flat, "move apple_1; pick_up apple_1")
    assert not flat.facts.holds("ontop", ("apple_1", "breakfast_table_1"))
    assert not flat.facts.holds("inroom", ("apple_1", "kitchen_0"))


def test_contents_of_a_bowl_move_with_it(flat):
    trace = executed(
        flat,
        "move apple_1; pick_up apple_1; move bowl_1; place bowl_1 inside; pick_up bowl_1; "
        "move coffee_table_1; place coffee_table_1 ontop",
    )
    assert trace.failure is None
    assert "holds bowl_1 with apple_1 in it" in trace.steps[4].message
    assert flat.facts.holds("inside", ("apple_1", "bowl_1"))
    assert flat.facts.holds("inroom", ("apple_1", "living_room_0"))


def test_bowl_can_not_be_placed_on_its_own_contents(flat):
    trace = executed(
        flat,
        "move apple_1; pick_up apple_1; move bowl_1; place bowl_1 inside; pick_up bowl_1; place apple_1 ontop",
    )
    assert trace.failure is FailureReason.PLACE_ON_ITSELF


def test_robot_can_not_drive_to_a_held_object(flat):
    trace = executed(flat, "move apple_1; pick_up apple_1; move apple_1")
    assert trace.failure is FailureReason.HAND_FULL


def test_placing_on_an_object_in_a_closed_container_fails(flat):
    trace = executed(flat, "move apple_1; pick_up apple_1; move chicken_leg_1; place chicken_leg_1 ontop")
    assert trace.failure is FailureReason.CONTAINER_CLOSED


def test_bowl_needs_no_opening(flat):
    assert executed(flat, "move apple_1; pick_up apple_1; move bowl_1; place bowl_1 inside").failure is None


def test_going_to_the_current_room_changes_nothing(flat):
    trace = executed(flat, "go_to_room kitchen_0")
    assert trace.failure is None
    assert flat.world.robot == flat.world.navigator.start


def test_going_to_another_room_leads_through_its_door(flat):
    assert executed(flat, "go_to_room living_room_0").failure is None
    assert flat.world.robot_room == "living_room_0"


def test_turning_adds_to_the_heading(flat):
    executed(flat, "turn 1.5; turn 1.5; turn 1.5")
    assert flat.world.robot.yaw == pytest.approx(4.5 - 2 * 3.141592653589793)


def test_driving_turns_first_and_goes_straight_on(flat):
    before = flat.world.navigator.start
    executed(flat, "move_forward 0.5 1.5707963267948966")
    assert flat.world.robot.x_m == pytest.approx(before.x_m)
    assert flat.world.robot.y_m == pytest.approx(before.y_m + 0.5)
    assert flat.world.robot.yaw == pytest.approx(before.yaw + 1.5707963267948966)


def test_negative_distance_drives_backwards_and_keeps_the_heading(flat):
    before = flat.world.navigator.start
    executed(flat, "move_forward -0.3 0")
    assert flat.world.robot.x_m == pytest.approx(before.x_m - 0.3)
    assert flat.world.robot.yaw == before.yaw


def test_switch_can_be_toggled_back(flat):
    executed(flat, "move table_lamp_1; toggle_on table_lamp_1; toggle_off table_lamp_1")
    assert not flat.facts.holds("toggled_on", ("table_lamp_1",))


@pytest.mark.parametrize("relation", ["ontop", "under"])
def test_placing_makes_the_relation_true(flat, relation):
    executed(flat, f"move mug_1; pick_up mug_1; move breakfast_table_1; place breakfast_table_1 {relation}")
    assert flat.facts.holds(relation, ("mug_1", "breakfast_table_1"))
    assert flat.world.carried == ()


def test_every_skill_can_succeed(flat):
    plans = [
        f"{STOCK}; close microwave_1; toggle_on microwave_1; heat_object_with_source chicken_leg_1 microwave_1; "
        "cook_object_with_tool chicken_leg_1 microwave_1; toggle_off microwave_1",
        "move fridge_1; froze_object_with_source chicken_leg_1 fridge_1; turn 1; go_to_room living_room_0; "
        "move_forward 0.05 0",
    ]
    traces = [executed(flat, text) for text in plans]
    assert [trace.failure for trace in traces] == [None, None]
    assert {step.call.skill for trace in traces for step in trace.steps} == set(PROFILES[Profile.PAPER])


# Traces.


def test_equal_plans_and_seeds_give_equal_traces_to_the_bit(flat):
    first = executed(flat, f"{STOCK}; close microwave_1", seed=7)
    executed(flat, "move mug_1; pick_up mug_1", seed=3)
    second = executed(flat, f"{STOCK}; close microwave_1", seed=7)
    assert first == second
    assert first.digest.startswith("sha256:")


def test_dedicated_simulator_gives_the_same_trace(flat):
    assert executed_alone(kitchen_scene(), STOCK) == executed(flat, STOCK)


def test_another_seed_changes_poses_but_not_outcomes(flat):
    text = "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop"
    traces = [executed(flat, text, seed=seed) for seed in range(4)]
    assert len({trace.digest for trace in traces}) > 1
    assert len({trace.steps for trace in traces}) == 1


def test_plans_that_differ_have_different_digests(flat):
    assert executed(flat, "turn 1").digest != executed(flat, "turn 2").digest


def test_empty_plan_executes_without_failure(flat):
    task = task_over(flat.world.scene)
    trace = flat.execute(task, (), 0)
    assert trace.failure is None
    assert trace.touched == frozenset()


def test_touched_objects_are_targets_and_sources_of_successful_calls(flat):
    trace = executed(flat, "move fridge_1; froze_object_with_source chicken_leg_1 fridge_1; pick_up stove_1")
    assert trace.touched == {"fridge_1", "chicken_leg_1"}


def test_final_state_is_described_in_words(flat):
    trace = executed(flat, f"{STOCK}; close microwave_1; toggle_on microwave_1", HEATED)
    assert "chicken_leg_1: inside microwave_1 in kitchen_0, cooked, hot" in trace.final
    assert "microwave_1: on countertop_1 in kitchen_0, closed, on" in trace.final


def test_final_state_describes_the_held_object(flat):
    trace = executed(flat, "move apple_1; pick_up apple_1", And((Atom("hot", ("apple_1",)),)))
    assert trace.final[-1] == "apple_1: in the robot's hand"


def test_single_steps_continue_after_a_failure(flat):
    task = task_over(flat.world.scene)
    flat.reset(task, 0)
    failed, moved = (flat.run_step(call) for call in plan_of(task, "pick_up apple_1; move apple_1"))
    assert failed.failure is FailureReason.OUT_OF_REACH
    assert moved.ok


def test_goal_relations_are_queried_by_their_own_names(flat):
    executed(flat, "turn 0")
    assert flat.facts.holds(Relation.ONTOP.value, ("bowl_1", "breakfast_table_1"))


def test_prompt_example_executes_as_described(flat):
    names = ["countertop_1", "stove_1", "fridge_1", "sink_1", "apple_1"]
    task = replace(task_over(flat.world.scene), table=tuple(names))
    trace = flat.execute(task, parse_plan(EXAMPLES[Codec.JSON]), 0)
    assert trace.failure is None
    assert flat.facts.holds("inside", ("apple_1", "fridge_1"))
