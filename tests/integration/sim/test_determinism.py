"""Equal bundle, plan and seed give equal traces: in any order, in fresh loads, and in other processes."""

import contextlib
import os
import random
import subprocess
import sys

import pytest
from tests.fakes.plans import plan_of, task_over
from tests.fakes.scenes import kitchen_scene

from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.executor import Simulator, StepRandom
from embomatrix.sim.placing.pose_cache import PlacementLibrary, analyse_scene
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import Bundle, decode_bundle, encode_bundle

PLANS = (
    "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop",
    "move fridge_1; open fridge_1; pick_up chicken_leg_1; move microwave_1; open microwave_1",
    "move fridge_1; open fridge_1; move mug_1; pick_up mug_1; move fridge_1; place fridge_1 inside; close fridge_1",
    "move bowl_1; pick_up bowl_1; move coffee_table_1; place coffee_table_1 ontop; move apple_1; pick_up apple_1; "
    "move bowl_1; place bowl_1 inside; pick_up bowl_1",
    "move apple_2; pick_up apple_2; move breakfast_table_1; place breakfast_table_1 under; move bowl_1",
    "move mug_1; pick_up mug_1; move chicken_leg_1; place chicken_leg_1 ontop",
    "go_to_room kitchen_0; move_forward 0.3 0.4; turn 1.0; move stove_1; toggle_on stove_1",
)
SEEDS = (0, 7)


@pytest.fixture(scope="module")
def bundle():
    scene = kitchen_scene()
    with contextlib.closing(BulletEngine(scene)) as engine, contextlib.closing(PlacementLibrary()) as library:
        return decode_bundle(encode_bundle(Bundle(scene, {}, analyse_scene(engine, library, seed=1))))


def digests(bundle, order) -> dict[tuple[int, int], str]:
    """Return the digest of every plan with every seed, executed in this order in one simulator."""
    simulator = load_simulator(bundle)
    task = task_over(bundle.scene)
    found = {}
    for plan, seed in order:
        trace = simulator.execute(task, plan_of(task, PLANS[plan]), seed)
        found[plan, seed] = f"{trace.digest} {trace.final} {trace.failure}"
    simulator.close()
    return found


@pytest.mark.parametrize(
    ("seed", "step", "numbers"),
    [
        (0, 1, [3343061319433681400, 854139613077895453]),
        (7, 3, [4043451057506116768, 3455150974730563071]),
    ],
)
def test_random_numbers_of_a_step_are_pinned(seed: int, step: int, numbers: list[int]) -> None:
    draws = StepRandom()
    draws.go_to(seed, step)
    assert draws.generator.integers(2**62, size=2).tolist() == numbers


def test_traces_do_not_depend_on_earlier_executions(bundle) -> None:
    order = [(plan, seed) for plan in range(len(PLANS)) for seed in SEEDS]
    first = digests(bundle, order)
    for number in range(3):
        shuffled = order * 2
        random.Random(number).shuffle(shuffled)
        assert digests(bundle, shuffled) == first
    assert digests(bundle, order[::-1]) == first
    assert len(set(first.values())) > len(PLANS)


def test_traces_do_not_depend_on_the_warm_up(bundle) -> None:
    order = [(plan, seed) for plan in range(len(PLANS)) for seed in SEEDS]
    engine = BulletEngine(bundle.scene)
    simulator = Simulator(bundle, engine)
    steps = sum(1 for _ in (*engine.warm_up(), *simulator.warm_up()))
    assert steps > 3 * len(bundle.scene.objects)
    task = task_over(bundle.scene)
    found = {}
    for plan, seed in order:
        trace = simulator.execute(task, plan_of(task, PLANS[plan]), seed)
        found[plan, seed] = f"{trace.digest} {trace.final} {trace.failure}"
    simulator.close()
    assert found == digests(bundle, order)


def test_traces_do_not_depend_on_the_process(bundle, tmp_path) -> None:
    (tmp_path / "flat.bundle").write_bytes(encode_bundle(bundle))
    script = (
        "import sys; sys.path[:0] = sys.argv[2:]\n"
        "from pathlib import Path\n"
        "from tests.integration.sim.test_determinism import PLANS, SEEDS, digests\n"
        "from embomatrix.world.bundle import decode_bundle\n"
        "bundle = decode_bundle(Path(sys.argv[1]).read_bytes())\n"
        "order = [(plan, seed) for seed in SEEDS for plan in range(len(PLANS))]\n"
        "print(sorted(digests(bundle, order).items()))\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "flat.bundle"), *sys.path]
    there = subprocess.run(
        command, capture_output=True, text=True, check=True, env=os.environ | {"PYTHONHASHSEED": "12345"}
    )
    order = [(plan, seed) for plan in range(len(PLANS)) for seed in SEEDS]
    assert there.stdout.strip() == str(sorted(digests(bundle, order).items()))
