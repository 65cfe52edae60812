"""The warm-up of the simulator's root executes a whole plan."""

import contextlib

from embomatrix.sim.simulation import load_simulator
from embomatrix.worker.slots.warm_up import PLAN, WARM_UP, warm_up_bundle
from embomatrix.world.bundle import decode_bundle, encode_bundle


def test_every_step_of_the_warm_up_succeeds():
    bundle = decode_bundle(encode_bundle(warm_up_bundle()))
    with contextlib.closing(load_simulator(bundle)) as simulator:
        steps = simulator.execute(bundle.tasks[WARM_UP], PLAN, 0).steps
        assert [step.ok for step in steps] == [True] * len(PLAN)
