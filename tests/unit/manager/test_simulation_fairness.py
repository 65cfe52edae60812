"""Fair sharing of a simulated cluster between runs."""

from dataclasses import replace

import pytest

from embomatrix.manager.simulation.run import simulate
from embomatrix.manager.simulation.scenario import LOCAL, Scenes, SimulationScenario, Trainer
from embomatrix.rpc.wire.values import RunTerms

CLUSTER = SimulationScenario(
    workers=4,
    kinds=(replace(LOCAL, slots=4),),
    execute_s=0.5,
    execute_spread=0.2,
    scenes=Scenes(count=40, load_s=0.3),
)
LARGE = Trainer(name="large", steps=1, groups=60, group_size=16, write_s=0.0, update_s=0.0)
"""960 rollouts at once: thirty seconds of all slots."""
SMALL = Trainer(name="small", steps=4, groups=1, group_size=16, write_s=0.1, update_s=0.5, start_s=7.0)


def beside(other, **changes):
    return simulate(replace(CLUSTER, trainers=(LARGE, other), **changes))


def rival(weight=1.0, length=1.0, priority=0, groups=40):
    terms = RunTerms(weight=weight, priority=priority)
    return replace(LARGE, name="rival", terms=terms, length=length, groups=groups)


def test_slot_time_follows_weights_not_rollout_lengths():
    report = beside(rival(weight=3.0, length=4.0, groups=12))
    assert report.shares["rival"] == pytest.approx(0.75, abs=0.05)
    assert report.pressed_utilisation >= 0.95


def test_higher_priority_is_served_first():
    report = beside(rival(priority=1, groups=20))
    assert report.shares["rival"] >= 0.9


@pytest.mark.parametrize("memory_mb", [2048, 100])
def test_small_run_does_not_wait_for_a_large_batch(memory_mb):
    """The smaller memory holds only a few of the forty scenes, so runs share residents too."""
    kinds = (replace(CLUSTER.kinds[0], memory_mb=memory_mb),)
    report = beside(SMALL, kinds=kinds)
    assert max(report.groups_s["large"]) >= 25.0
    assert max(report.groups_s["small"]) <= 5.0
    assert report.pressed_utilisation >= 0.95


@pytest.mark.slow
def test_sharing_moves_no_scenes():
    alone = [simulate(replace(CLUSTER, trainers=(run,))).loads for run in (LARGE, rival())]
    for weight, length in ((1.0, 1.0), (3.0, 1.0), (1.0, 4.0), (3.0, 4.0)):
        report = beside(rival(weight, length))
        print(
            f"weight {weight:g}, length {length:g}: {report.shares['rival']:.1%} of the slots, "
            f"{report.loads} loads, alone {sum(alone)}"
        )
        assert report.shares["rival"] == pytest.approx(weight / (weight + 1.0), abs=0.05)
        assert report.loads <= 1.25 * sum(alone)
