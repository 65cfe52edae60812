"""Oracle planner: a minimal working plan for every kind of goal, or the reason for its absence."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fakes import furniture as make
from tests.fakes.formulas import exists, forall, forn, forpairs
from tests.fakes.plans import awkward_scene, plan_of, task_over, with_objects, words_of
from tests.fakes.pose_caches import build_pose_cache
from tests.fakes.scenes import kitchen_scene, kitchen_tasks, placed, upright

from embomatrix.sim.planner.oracle import (
    PROOF_SEEDS,
    PlanNotFound,
    advice_from_here,
    find_plan,
    plan_from_here,
)
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.syntax import MAX_STEPS, Skill
from embomatrix.world.bundle import Bundle
from embomatrix.world.evaluate import evaluate
from embomatrix.world.goal import And, Atom, Imply, Not, Or
from embomatrix.world.state import Relation

FETCH_CHICKEN = "move microwave_1; open microwave_1; move fridge_1; open fridge_1; pick_up chicken_leg_1; "
HEAT_CHICKEN = (
    f"{FETCH_CHICKEN}move microwave_1; place microwave_1 inside; close microwave_1; toggle_on microwave_1"
)


def atom(predicate, *args):
    return Atom(predicate, args)


@pytest.fixture(scope="module")
def flat():
    scene = kitchen_scene()
    small = [item.name for item in scene.objects if not item.fixed]
    cache = build_pose_cache(scene, small, [item.name for item in scene.objects], seed=0)
    simulator = load_simulator(Bundle(scene, {}, cache))
    yield simulator
    simulator.close()


def oracle(simulator, goal):
    """Return the plan in words, verified with unseen seeds, or the reason."""
    task = task_over(simulator.world.scene, goal)
    found = find_plan(simulator, task)
    if isinstance(found, PlanNotFound):
        return found.reason
    for seed in (11, 12):
        assert simulator.execute(task, found, seed).failure is None
        assert evaluate(goal, simulator.facts, task.types)
    return words_of(found, task)


@pytest.mark.parametrize(
    ("goal", "plan"),
    [
        (
            atom("ontop", "apple_1", "countertop_1"),
            "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop",
        ),
        (
            atom("under", "mug_1", "breakfast_table_1"),
            "move mug_1; pick_up mug_1; move breakfast_table_1; place breakfast_table_1 under",
        ),
        (
            atom("hot", "apple_1", "stove_1"),
            "move apple_1; pick_up apple_1; move stove_1; place stove_1 ontop; toggle_on stove_1",
        ),
        (
            atom("hot", "apple_1", "microwave_1"),
            "move microwave_1; open microwave_1; move apple_1; pick_up apple_1; move microwave_1; "
            "place microwave_1 inside; close microwave_1; toggle_on microwave_1",
        ),
        (
            atom("inside", "apple_1", "cabinet_1"),
            "move cabinet_1; open cabinet_1; move apple_1; pick_up apple_1; move cabinet_1; place cabinet_1 inside",
        ),
        (atom("open", "fridge_1"), "move fridge_1; open fridge_1"),
        (atom("toggled_on", "table_lamp_1"), "move table_lamp_1; toggle_on table_lamp_1"),
        (
            And((atom("inside", "chicken_leg_1", "microwave_1"), atom("cooked", "chicken_leg_1"))),
            HEAT_CHICKEN,
        ),
        (
            And(
                (
                    atom("inside", "chicken_leg_1", "microwave_1"),
                    Not(atom("open", "microwave_1")),
                    atom("toggled_on", "microwave_1"),
                )
            ),
            HEAT_CHICKEN,
        ),
        (
            And((atom("inside", "apple_1", "fridge_1"), Not(atom("open", "fridge_1")))),
            "move fridge_1; open fridge_1; move apple_1; pick_up apple_1; move fridge_1; place fridge_1 inside; "
            "close fridge_1",
        ),
        (
            Not(atom("frozen", "chicken_leg_1")),
            "move fridge_1; open fridge_1; pick_up chicken_leg_1; move stove_1; place stove_1 ontop; toggle_on stove_1",
        ),
        (
            And((atom("frozen", "apple_1"), atom("ontop", "apple_1", "countertop_1"))),
            "move fridge_1; open fridge_1; move apple_1; pick_up apple_1; move fridge_1; place fridge_1 inside; "
            "close fridge_1; open fridge_1; pick_up apple_1; move countertop_1; place countertop_1 ontop",
        ),
        (
            And((atom("inside", "apple_1", "bowl_1"), atom("ontop", "bowl_1", "coffee_table_1"))),
            "move bowl_1; pick_up bowl_1; move coffee_table_1; place coffee_table_1 ontop; move apple_1; "
            "pick_up apple_1; move bowl_1; place bowl_1 inside",
        ),
        (
            And((atom("hot", "mug_1"), Not(atom("toggled_on", "stove_1")))),
            "move mug_1; pick_up mug_1; move stove_1; place stove_1 ontop; toggle_on stove_1; toggle_off stove_1",
        ),
        (
            Not(atom("ontop", "bowl_1", "breakfast_table_1")),
            "move bowl_1; pick_up bowl_1; move countertop_1; place countertop_1 ontop",
        ),
    ],
)
def test_plan_equals_the_shortest_sensible_plan(flat, goal, plan):
    assert oracle(flat, goal) == plan


def test_opened_container_is_closed_if_the_goal_requires_it(flat):
    goal = And((atom("ontop", "chicken_leg_1", "coffee_table_1"), Not(atom("open", "fridge_1"))))
    assert oracle(flat, goal) == (
        "move fridge_1; open fridge_1; pick_up chicken_leg_1; move coffee_table_1; place coffee_table_1 ontop; "
        "move fridge_1; close fridge_1"
    )


def test_cooked_food_is_served_elsewhere(flat):
    goal = And(
        (
            atom("cooked", "chicken_leg_1"),
            atom("inside", "chicken_leg_1", "bowl_1"),
            atom("ontop", "bowl_1", "coffee_table_1"),
        )
    )
    plan = oracle(flat, goal)
    assert (
        plan.index("toggle_on") < plan.index("place coffee_table_1 ontop") < plan.index("place bowl_1 inside")
    )


def test_microwave_is_switched_off_before_the_food_is_taken_out(flat):
    task = task_over(
        flat.world.scene, And((atom("hot", "apple_1"), atom("ontop", "apple_1", "coffee_table_1")))
    )
    without_stove = tuple(name for name in task.table if name != "stove_1")
    task = replace(task, table=without_stove)
    plan = words_of(find_plan(flat, task), task)
    assert plan.endswith(
        "close microwave_1; toggle_on microwave_1; toggle_off microwave_1; open microwave_1; pick_up apple_1; "
        "move coffee_table_1; place coffee_table_1 ontop"
    )


@pytest.mark.parametrize(
    "goal",
    [
        forall("?a", "apple.n.01", atom("inside", "?a", "fridge_1")),
        exists("?a", "apple.n.01", atom("inside", "?a", "bowl_1")),
        forn(1, "?a", "apple.n.01", atom("inside", "?a", "cabinet_1")),
        forpairs("?a", "apple.n.01", "?b", "bowl.n.01", atom("inside", "?a", "?b")),
        Or((atom("sliced", "apple_1"), atom("open", "cabinet_1"))),
        Imply(atom("inside", "chicken_leg_1", "fridge_1"), atom("open", "fridge_1")),
        atom("inroom", "apple_1", "living_room_0"),
        And((atom("hot", "apple_1"), atom("cooked", "chicken_leg_1"), atom("inside", "mug_1", "sink_1"))),
        And((atom("touching", "apple_1", "coffee_table_1"),)),
    ],
)
def test_oracle_finds_a_plan_for_the_goal(flat, goal):
    assert oracle(flat, goal).startswith("move")


def test_plans_for_the_flat_succeed_with_several_seeds(flat):
    for task in kitchen_tasks(flat.world.scene):
        plan = find_plan(flat, task)
        assert not isinstance(plan, PlanNotFound), plan
        assert len(plan) <= MAX_STEPS
        for seed in (*PROOF_SEEDS, 99):
            flat.execute(task, plan, seed)
            assert evaluate(task.goal, flat.facts, task.types)


def test_source_named_in_the_instruction_is_preferred(flat):
    task = task_over(flat.world.scene, atom("cooked", "apple_1"))
    by_stove = words_of(find_plan(flat, replace(task, instruction="Cook the apple.")), task)
    instructed = replace(task, instruction="Cook the apple in the microwave, please.")
    assert by_stove.endswith("place stove_1 ontop; toggle_on stove_1")
    assert words_of(find_plan(flat, instructed), task).endswith("close microwave_1; toggle_on microwave_1")


def test_object_in_the_named_room_is_preferred(flat):
    task = task_over(flat.world.scene, exists("?a", "apple.n.01", atom("inside", "?a", "bowl_1")))
    instructed = replace(task, instruction="Put the apple in the living room into the bowl.")
    assert words_of(find_plan(flat, task), task).startswith("move apple_1")
    assert words_of(find_plan(flat, instructed), task).startswith("move apple_2")


def test_every_call_of_a_plan_is_necessary(flat):
    for task in kitchen_tasks(flat.world.scene):
        plan = find_plan(flat, task)
        for number, call in enumerate(plan):
            if call.skill is Skill.MOVE:
                continue
            shorter = (*plan[:number], *plan[number + 1 :])
            trace = flat.execute(task, shorter, 0)
            done = trace.failure is None and evaluate(task.goal, flat.facts, task.types)
            assert not done, words_of(shorter, task)


@pytest.mark.parametrize(
    ("goal", "reason"),
    [
        (atom("ontop", "bowl_1", "breakfast_table_1"), "the goal holds at the start: there is nothing to do"),
        (atom("sliced", "apple_1"), "none of the skills can do this: apple_1 must be made sliced"),
        (And((atom("open", "sink_1"), Not(atom("open", "sink_1")))), "the goal contradicts itself"),
        (
            atom("ontop", "fridge_1", "countertop_1"),
            "fridge_1 is fixed and can't be picked up",
        ),
        (
            atom("cooked", "apple_1", "fridge_1"),
            "fridge_1 does not make apple_1 cooked",
        ),
        (
            atom("cooked", "mug_1"),
            "no object in the table makes mug_1 cooked: expected a heat or cold source",
        ),
    ],
)
def test_goal_without_a_plan_is_refused_with_a_reason(flat, goal, reason):
    assert oracle(flat, goal) == reason


def test_goal_with_an_object_outside_the_table_has_no_plan(flat):
    task = task_over(flat.world.scene, atom("ontop", "apple_1", "countertop_1"))
    task = replace(task, table=task.table[:5])
    assert find_plan(flat, task) == PlanNotFound("apple_1 is not in the object table: no plan can name it")


def test_object_without_an_allowed_place_stays_in_the_hand(flat):
    goal = And((Not(atom("inroom", "apple_1", "kitchen_0")), atom("open", "fridge_1")))
    task = replace(
        task_over(flat.world.scene, goal), table=("apple_1", "breakfast_table_1", "countertop_1", "fridge_1")
    )
    plan = find_plan(flat, task)
    assert not isinstance(plan, PlanNotFound)
    assert words_of(plan, task) == "move fridge_1; open fridge_1; move apple_1; pick_up apple_1"


def test_two_objects_without_an_allowed_place_exceed_one_hand(flat):
    goal = And(tuple(Not(atom("inroom", name, "kitchen_0")) for name in ("apple_1", "bowl_1")))
    task = replace(task_over(flat.world.scene, goal), table=("apple_1", "bowl_1", "breakfast_table_1"))
    found = find_plan(flat, task)
    assert isinstance(found, PlanNotFound)
    assert "there is no free surface in the object table to put bowl_1 on" in found.reason


def test_microwave_cannot_end_open_and_on(flat):
    goal = And((atom("open", "microwave_1"), atom("toggled_on", "microwave_1")))
    assert "goal does not hold" in oracle(flat, goal)


def test_stacked_objects_are_removed_first():
    simulator = load_simulator(Bundle(awkward_scene(), {}))
    plan = oracle(simulator, atom("ontop", "tray_1", "coffee_table_1"))
    simulator.close()
    assert plan == (
        "move apple_3; pick_up apple_3; move countertop_1; place countertop_1 ontop; "
        "move tray_1; pick_up tray_1; move coffee_table_1; place coffee_table_1 ontop"
    )


@pytest.mark.parametrize(
    ("goal", "plan"),
    [
        (
            atom("under", "apple_1", "mug_1"),
            "move mug_1; pick_up mug_1; move apple_1; place apple_1 ontop",
        ),
        (
            And(
                (
                    Not(atom("inroom", "apple_2", "living_room_0")),
                    Not(atom("ontop", "apple_2", "countertop_1")),
                )
            ),
            "move apple_2; pick_up apple_2; move breakfast_table_1; place breakfast_table_1 ontop",
        ),
        (
            Not(forpairs("?a", "bowl.n.01", "?b", "breakfast_table.n.01", atom("ontop", "?a", "?b"))),
            "move bowl_1; pick_up bowl_1; move countertop_1; place countertop_1 ontop",
        ),
    ],
)
def test_relation_without_a_skill_is_reached_by_an_equivalent_one(flat, goal, plan):
    assert oracle(flat, goal) == plan


@pytest.mark.parametrize(
    ("goal", "plan"),
    [
        (
            atom("nextto", "apple_1", "apple_2"),
            "move apple_1; pick_up apple_1; move apple_2; place apple_2 nextto",
        ),
        (
            atom("nextto", "apple_1", "cabinet_1"),
            "move apple_1; pick_up apple_1; move cabinet_1; place cabinet_1 nextto",
        ),
        (
            atom("nextto", "fridge_1", "mug_1"),
            "move mug_1; pick_up mug_1; move fridge_1; place fridge_1 nextto",
        ),
        (
            And(
                (
                    atom("ontop", "apple_1", "countertop_1"),
                    atom("ontop", "mug_1", "countertop_1"),
                    atom("nextto", "apple_1", "mug_1"),
                )
            ),
            "move mug_1; pick_up mug_1; move countertop_1; place countertop_1 ontop; "
            "move apple_1; pick_up apple_1; move mug_1; place mug_1 nextto",
        ),
    ],
)
def test_object_that_belongs_next_to_another_is_placed_there(flat, goal, plan):
    assert oracle(flat, goal) == plan


def test_too_long_plan_is_rewritten_without_moves_to_objects_in_reach(flat, monkeypatch):
    goal = atom("inside", "apple_1", "bowl_1")
    assert oracle(flat, goal) == "move apple_1; pick_up apple_1; move bowl_1; place bowl_1 inside"
    monkeypatch.setattr("embomatrix.sim.planner.calls.MAX_STEPS", 3)
    assert oracle(flat, goal) == "move apple_1; pick_up apple_1; place bowl_1 inside"


def test_object_is_placed_on_contents_of_a_full_box():
    brick = replace(make.block("brick", "brick.n.01", (0.12, 0.12, 0.05), {}), mass_kg=0.5)
    crate = make.tub("crate", "crate.n.01", (0.18, 0.18, 0.3), 0.01, 0.01, mass_kg=1.0, abilities={})
    table_m = 0.75
    scene = with_objects(
        kitchen_scene(),
        [
            (placed("crate_1", crate, "kitchen_0", upright(2.2, 1.7, table_m, crate)), crate),
            (placed("brick_1", brick, "kitchen_0", upright(2.2, 1.35, table_m, brick)), brick),
            (placed("brick_2", brick, "kitchen_0", upright(1.9, 1.6, table_m, brick)), brick),
        ],
    )
    simulator = load_simulator(Bundle(scene, {}, build_pose_cache(scene, (), (), seed=0)))
    plan = oracle(
        simulator, And((atom("inside", "brick_1", "crate_1"), atom("inside", "brick_2", "crate_1")))
    )
    simulator.close()
    assert plan.endswith(("place brick_1 ontop", "place brick_2 ontop")), plan
    assert "place crate_1 inside" in plan


def test_object_above_a_box_is_removed_until_there_is_room_inside():
    column = replace(make.block("column", "column.n.01", (0.12, 0.12, 0.27), {}), mass_kg=0.5)
    brick = replace(make.block("brick", "brick.n.01", (0.12, 0.12, 0.2), {}), mass_kg=0.5)
    crate = make.tub("crate", "crate.n.01", (0.18, 0.18, 0.3), 0.01, 0.01, mass_kg=1.0, abilities={})
    table_m = 0.75
    inside = {"host": "crate_1", "relation": Relation.INSIDE}
    scene = with_objects(
        kitchen_scene(),
        [
            (placed("crate_1", crate, "kitchen_0", upright(2.2, 1.6, table_m, crate)), crate),
            (
                placed("column_1", column, "kitchen_0", upright(2.2, 1.6, table_m + 0.01, column), **inside),
                column,
            ),
            (placed("brick_1", brick, "kitchen_0", upright(1.9, 1.4, table_m, brick)), brick),
        ],
    )
    simulator = load_simulator(Bundle(scene, {}, build_pose_cache(scene, (), (), seed=0)))
    plan = oracle(simulator, atom("inside", "brick_1", "crate_1"))
    simulator.close()
    assert plan.endswith("pick_up brick_1; move crate_1; place crate_1 inside"), plan


def test_portable_container_is_carried_to_a_place_where_it_opens():
    post = make.block("post", "post.n.01", (0.05, 0.3, 0.3), {})
    casket = replace(
        make.cupboard("casket", "casket.n.01", (0.2, 0.25, 0.2), boards=0, abilities={}), mass_kg=2.0
    )
    table_m = 0.75
    scene = with_objects(
        kitchen_scene(),
        [
            (placed("casket_1", casket, "kitchen_0", upright(2.1, 1.4, table_m, casket)), casket),
            (placed("post_1", post, "kitchen_0", upright(2.27, 1.4, table_m, post), fixed=True), post),
        ],
    )
    simulator = load_simulator(Bundle(scene, {}, build_pose_cache(scene, (), (), seed=0)))
    plan = oracle(simulator, atom("open", "casket_1"))
    simulator.close()
    assert plan.startswith("move casket_1; pick_up casket_1; move "), plan
    assert plan.endswith("open casket_1"), plan


def test_food_is_cooled_after_cooking_if_it_must_not_be_hot(flat):
    plan = oracle(flat, And((atom("cooked", "apple_1"), Not(atom("hot", "apple_1")))))
    assert (
        plan.index("toggle_on stove_1") < plan.index("place fridge_1 inside") < plan.index("close fridge_1")
    )


@pytest.mark.parametrize(
    ("goal", "reason"),
    [
        (atom("inside", "apple_1", "countertop_1"), "nothing can be inside countertop_1: it has no cavity"),
        (atom("toggled_on", "cabinet_1"), "cabinet_1 has no switch"),
        (atom("open", "sink_1"), "sink_1 has no door, drawer or lid that opens"),
        (atom("ontop", "apple_1", "apple_1"), "apple_1 can't be ontop itself"),
        (Not(atom("inroom", "sink_1", "kitchen_0")), "sink_1 is fixed and can't be picked up"),
    ],
)
def test_reason_names_the_obstacle_to_the_goal(flat, goal, reason):
    assert oracle(flat, goal) == reason


GOALS = [
    And((atom("inside", "apple_1", "fridge_1"), Not(atom("open", "fridge_1")))),
    And((atom("ontop", "chicken_leg_1", "countertop_1"), atom("toggled_on", "table_lamp_1"))),
    atom("hot", "apple_1", "microwave_1"),
    atom("ontop", "mug_1", "breakfast_table_1"),
]
MISSTEPS = st.lists(
    st.sampled_from(
        [
            "move apple_1",
            "pick_up apple_1",
            "move mug_1",
            "pick_up mug_1",
            "move fridge_1",
            "open fridge_1",
            "close fridge_1",
            "pick_up chicken_leg_1",
            "move microwave_1",
            "open microwave_1",
            "place microwave_1 inside",
            "toggle_on microwave_1",
            "move breakfast_table_1",
            "place breakfast_table_1 ontop",
            "toggle_on table_lamp_1",
        ]
    ),
    max_size=10,
)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(GOALS), MISSTEPS, st.integers(0, 3))
def test_plan_from_any_state_reaches_the_goal(flat, goal, calls, seed):
    task = task_over(flat.world.scene, goal)
    flat.reset(task, seed)
    for call in plan_of(task, "; ".join(calls)) if calls else ():
        flat.run_step(call)
    here, was_reached = flat.mark(), evaluate(goal, flat.facts, task.types)
    found = plan_from_here(flat, task, seed)
    assert isinstance(found, tuple), found
    assert (found == ()) is was_reached
    flat.return_to(here, seed)
    assert plan_from_here(flat, task, seed) == found
    flat.return_to(here, seed)
    assert all(flat.run_step(call).ok for call in found)
    assert evaluate(goal, flat.facts, task.types)


def test_plan_from_here_carries_what_is_in_the_hand_to_its_place(flat):
    task = task_over(flat.world.scene, atom("ontop", "apple_1", "countertop_1"))
    flat.reset(task, 0)
    for call in plan_of(task, "move apple_1; pick_up apple_1"):
        flat.run_step(call)
    assert words_of(plan_from_here(flat, task, 0), task) == "move countertop_1; place countertop_1 ontop"


def test_plan_from_here_puts_down_what_it_does_not_need(flat):
    task = task_over(flat.world.scene, atom("open", "fridge_1"))
    flat.reset(task, 0)
    for call in plan_of(task, "move apple_1; pick_up apple_1"):
        flat.run_step(call)
    found = words_of(plan_from_here(flat, task, 0), task)
    assert found.startswith("place ") or "; place " in found
    assert found.endswith("move fridge_1; open fridge_1")


def test_advice_says_why_there_is_no_plan(flat):
    task = task_over(flat.world.scene, atom("open", "apple_1"))
    flat.reset(task, 0)
    advice = advice_from_here(flat, task, 0)
    assert (advice.plan, advice.problem) == ((), "apple_1 has no door, drawer or lid that opens")
