"""Every failure reason, reached by the shortest plan that leads to it."""

from dataclasses import replace

import pytest
from tests.fakes import furniture as make
from tests.fakes.household import household_scene
from tests.fakes.plans import awkward_scene, executed, executed_alone, with_objects
from tests.fakes.scenes import kitchen_scene, placed, scene_of, upright
from tests.fakes.skill_reasons import MISHAPS, reasons_of

from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.failure import FailureReason
from embomatrix.world.bundle import Bundle
from embomatrix.world.scene import RobotStart


@pytest.fixture(scope="module")
def flat():
    simulator = load_simulator(Bundle(kitchen_scene(), {}))
    yield simulator
    simulator.close()


@pytest.fixture(scope="module")
def home():
    simulator = load_simulator(Bundle(household_scene(), {}))
    yield simulator
    simulator.close()


@pytest.fixture(scope="module")
def awkward():
    simulator = load_simulator(Bundle(awkward_scene(), {}))
    yield simulator
    simulator.close()


REACHED = {
    FailureReason.UNKNOWN_INDEX: "pick_up 99",
    FailureReason.UNKNOWN_ROOM: "go_to_room attic_0",
    FailureReason.BLOCKED: "move_forward 4.9 0",
    FailureReason.STEP_TOO_LONG: "move_forward 6 0",
    FailureReason.OUT_OF_REACH: "pick_up mug_1",
    FailureReason.TOO_HIGH: "pick_up apple_4",
    FailureReason.HAND_FULL: "move apple_1; pick_up apple_1; move fridge_1; open fridge_1",
    FailureReason.PLACES_OUT_OF_REACH: "move apple_1; pick_up apple_1; move tower_1; place tower_1 ontop",
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
AT_HOME = {
    FailureReason.NOT_THERE: "move half_melon_1",
    FailureReason.TOOL_NOT_HELD: "move melon_1; slice_object_with_tool melon_1 table_knife_1",
    FailureReason.NOT_A_SLICER: "move rag_1; pick_up rag_1; slice_object_with_tool melon_1 rag_1",
    FailureReason.NOT_SLICEABLE: "slice_object_with_tool apple_1 table_knife_1",
    FailureReason.ALREADY_SLICED: "move table_knife_1; pick_up table_knife_1; move loaf_1; "
    "slice_object_with_tool loaf_1 table_knife_1; slice_object_with_tool loaf_1 table_knife_1",
    FailureReason.NOT_A_CLEANER: "clean_object_with_tool plate_1 table_knife_1",
    FailureReason.NEEDS_SOAKING: "move rag_1; pick_up rag_1; move plate_2; clean_object_with_tool plate_2 rag_1",
    FailureReason.STAYS_ON: "move rag_1; pick_up rag_1; move vacuum_1; clean_object_with_tool vacuum_1 rag_1",
    FailureReason.GIVES_NO_LIQUID: "soak_object_in_source rag_1 plate_1",
    FailureReason.NOT_SOAKABLE: "soak_object_in_source plate_1 sink_1",
}
"""Plans that fail with the reasons of cutting, cleaning and soaking."""
ELSEWHERE = {
    FailureReason.NO_PATH,
    FailureReason.NO_STANDING_POSE,
    FailureReason.NO_LINE_OF_APPROACH,
    FailureReason.TOO_LARGE,
    FailureReason.DOOR_BLOCKED,
    FailureReason.NO_FREE_POSE,
    FailureReason.PLACES_BEHIND_DOOR,
}
"""Reasons that the tests below reach in dedicated scenes."""


@pytest.mark.parametrize("reason", list(REACHED))
def test_plan_fails_with_the_expected_reason(awkward, reason):
    trace = executed(awkward, REACHED[reason])
    assert trace.failure is reason, trace.steps[-1].message
    assert trace.steps[-1].failure in reasons_of(trace.steps[-1].call.skill)


@pytest.mark.parametrize("reason", list(AT_HOME))
def test_household_plan_fails_with_the_expected_reason(home, reason):
    trace = executed(home, AT_HOME[reason])
    assert trace.failure is reason, trace.steps[-1].message
    assert trace.steps[-1].failure in reasons_of(trace.steps[-1].call.skill)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            "move rag_1; pick_up rag_1; move sink_1; soak_object_in_source rag_1 sink_1",
            FailureReason.SOURCE_OFF,
        ),
        ("move sink_1; soak_object_in_source rag_1 sink_1", FailureReason.NOT_AT_SOURCE),
        ("move sink_1; clean_object_with_tool plate_1 sink_1", FailureReason.NOT_AT_SOURCE),
        ("move rag_1; pick_up rag_1; clean_object_with_tool mug_1 rag_1", FailureReason.OUT_OF_REACH),
        (
            "move vacuum_1; pick_up vacuum_1; move plate_1; clean_object_with_tool plate_1 vacuum_1",
            FailureReason.SOURCE_OFF,
        ),
    ],
)
def test_unready_tool_or_tap_is_reported(home, text, reason):
    trace = executed(home, text)
    assert trace.failure is reason, trace.steps[-1].message


def test_tests_cover_every_failure_reason():
    mishaps = frozenset().union(*MISHAPS.values())
    assert {*REACHED, *AT_HOME} | ELSEWHERE | mishaps == set(FailureReason)
    assert not mishaps & {*REACHED, *AT_HOME, *ELSEWHERE}
    assert not {*REACHED, *AT_HOME} & ELSEWHERE


def test_no_path_leads_into_a_room_without_a_door():
    trace = executed_alone(replace(kitchen_scene(), doorways=()), "move apple_2")
    assert trace.failure is FailureReason.NO_PATH
    assert (
        trace.steps[0].message
        == "the robot can't get to apple_2: a wall blocks the way; clear the way or choose another object"
    )


def test_room_without_a_door_cannot_be_entered():
    trace = executed_alone(replace(kitchen_scene(), doorways=()), "go_to_room living_room_0")
    assert trace.failure is FailureReason.NO_PATH


def test_middle_of_a_huge_table_is_out_of_reach():
    island, apple = make.block("island", "island.n.01", (2.6, 2.6, 0.5), {}), make.apple()
    scene = scene_of(
        "island",
        [
            (placed("island_1", island, "kitchen_0", upright(2.5, 2.0, 0, island), fixed=True), island),
            (placed("apple_1", apple, "kitchen_0", upright(2.5, 2.0, 0.5, apple)), apple),
        ],
    )
    trace = executed_alone(replace(scene, robot=RobotStart(0.5, 0.5, 0.0, "kitchen_0")), "move apple_1")
    assert trace.failure is FailureReason.NO_STANDING_POSE
    assert trace.steps[0].message.endswith(
        "within reach of apple_1: island_1 is in the way; clear the way or choose another object"
    )


@pytest.mark.parametrize("text", ["move apple_2", "go_to_room living_room_0"])
def test_blocker_in_the_doorway_is_named(text):
    chest = make.block("chest", "chest.n.02", (0.5, 0.9, 0.6), {})
    scene = with_objects(
        kitchen_scene(),
        [(placed("chest_1", chest, "kitchen_0", upright(4.7, 2.0, 0, chest), fixed=True), chest)],
    )
    trace = executed_alone(scene, text)
    assert trace.failure is FailureReason.NO_PATH
    assert trace.steps[0].message.endswith(": chest_1 blocks the way; clear the way or choose another object")


def test_arm_does_not_reach_through_a_wall():
    low, apple = make.coffee_table(), make.apple()
    scene = scene_of(
        "wall",
        [
            (placed("table_1", low, "living_room_0", upright(5.5, 0.7, 0, low), fixed=True), low),
            (placed("apple_1", apple, "living_room_0", upright(5.4, 0.7, 0.45, apple)), apple),
        ],
    )
    trace = executed_alone(replace(scene, robot=RobotStart(4.7, 0.7, 0.0, "kitchen_0")), "pick_up apple_1")
    assert trace.failure is FailureReason.NO_LINE_OF_APPROACH


def test_chest_is_too_large_for_the_gripper():
    chest = replace(make.block("chest", "chest.n.01", (0.5, 0.5, 0.5), {}), mass_kg=3.0)
    scene = scene_of("chest", [(placed("chest_1", chest, "kitchen_0", upright(1.5, 1.5, 0, chest)), chest)])
    trace = executed_alone(scene, "move chest_1; pick_up chest_1")
    assert trace.failure is FailureReason.TOO_LARGE
    assert (
        trace.steps[-1].message
        == "chest_1 measures 0.50 m and the gripper takes at most 0.30 m: choose a smaller object"
    )


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


def test_mug_in_front_of_the_microwave_blocks_its_door():
    trace = executed_alone(in_front_of_the_microwave(), "move microwave_1; open microwave_1")
    assert trace.failure is FailureReason.DOOR_BLOCKED
    assert trace.steps[-1].message == "mug_1 is in the way of the door of microwave_1: clear the way first"


def test_blocked_door_stays_in_place():
    simulator = load_simulator(Bundle(in_front_of_the_microwave(), {}))
    executed(simulator, "move microwave_1; open microwave_1")
    assert not simulator.facts.holds("open", ("microwave_1",))
    simulator.close()


def test_full_bowl_accepts_no_further_object(flat):
    trace = executed(
        flat,
        "move apple_1; pick_up apple_1; move bowl_1; place bowl_1 inside; move mug_1; pick_up mug_1; "
        "move bowl_1; place bowl_1 inside; move apple_2; pick_up apple_2; move bowl_1; place bowl_1 inside; "
        "move table_lamp_1; pick_up table_lamp_1; move bowl_1; place bowl_1 inside",
    )
    assert trace.failure is FailureReason.NO_FREE_POSE
    assert trace.steps[-1].blocker in {"apple_1", "mug_1", "apple_2"}
    assert f": {trace.steps[-1].blocker} is in the way" in trace.steps[-1].message


FILL_THE_FRIDGE = (
    "move fridge_1; open fridge_1; move apple_1; pick_up apple_1; move fridge_1; place fridge_1 inside"
)


def beside_a_fridge(width_m, *blocks):
    """Return the flat with a fridge, an apple on a stool, and blocks of furniture: their x, y and extents."""
    fridge = make.cupboard("fridge", "electric_refrigerator.n.01", (0.7, width_m, 1.6), abilities={})
    stool, apple = make.block("stool", "stool.n.01", (0.4, 0.4, 0.5), {}), make.apple()
    objects = [
        (placed("fridge_1", fridge, "kitchen_0", upright(0.36, 2.0, 0.0, fridge), fixed=True), fridge),
        (placed("stool_1", stool, "kitchen_0", upright(3.0, 3.4, 0.0, stool), fixed=True), stool),
        (placed("apple_1", apple, "kitchen_0", upright(3.0, 3.4, 0.5, apple)), apple),
    ]
    for number, (x, y, depth, width) in enumerate(blocks):
        block = make.block(f"block{number}", "block.n.01", (depth, width, 0.9), {})
        objects.append(
            (placed(f"block{number}_1", block, "kitchen_0", upright(x, y, 0.0, block), fixed=True), block)
        )
    return replace(scene_of("fridge", objects), robot=RobotStart(1.2, 3.2, 0.0, "kitchen_0"))


def test_robot_returns_to_an_open_fridge_on_the_side_that_its_door_leaves_free():
    # The nearest free places from before the door was opened are all behind it now.
    trace = executed_alone(beside_a_fridge(0.6, (1.4, 1.8, 0.5, 0.6)), FILL_THE_FRIDGE)
    assert trace.failure is None, trace.steps[-1].message


def test_door_that_cuts_off_the_floor_in_front_of_its_fridge_is_named():
    trace = executed_alone(beside_a_fridge(0.7, (2.0, 1.5, 1.0, 1.6), (1.0, 0.9, 1.9, 0.3)), FILL_THE_FRIDGE)
    assert trace.failure is FailureReason.PLACES_BEHIND_DOOR
    assert trace.steps[-1].message == (
        "the open door of fridge_1 is between the arm and every place for apple_1: choose another object"
    )
