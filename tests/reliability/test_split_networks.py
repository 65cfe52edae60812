"""A6 with real packets: manager, workers and trainer on machines of their own, whose links lose packets without a word.

Unlike a closed connection, a lost packet tells nobody anything. The machines are network namespaces, which only root makes.
"""

import asyncio
import collections
import contextlib
import functools
import random
import time

import pytest
from tests.fakes.network import MANAGER, OTHER, TRAINER, WORKER, Network, SplitCluster, why_not
from tests.fakes.waiting import until

pytestmark = pytest.mark.timeout(400)

QUICK = {"heartbeat_s": 0.2, "lost_after_s": 1.0, "lease_ttl_s": 4.0}
REWARD = 30.5
HEALED_S = 90.0
"""Time for the rest of a batch after the last cut. A sender of lost packets waits ever longer before it tries again."""


@functools.cache
def reason():
    return why_not()


@pytest.fixture
def network():
    if reason():
        pytest.skip(reason())
    with Network() as network:
        yield network


async def finished(cluster, count, besides=frozenset()):
    """Wait for the trainer and check that it got one outcome of each rollout: the right one, or one of ``besides``."""
    await until(lambda: cluster.trainer_status() is not None, limit_s=HEALED_S)
    assert cluster.trainer_status() == 0, cluster.log(TRAINER)
    assert collections.Counter(rollout for rollout, _ in cluster.received()) == {
        f"b1-{number}": 1 for number in range(count)
    }
    assert {got for _, got in cluster.received()} <= {REWARD} | besides


async def test_rollouts_of_an_unplugged_worker_get_one_outcome_each(network, tmp_path):
    with SplitCluster(tmp_path, network, **QUICK) as cluster:
        cluster.start_manager()
        cluster.start_worker(WORKER)
        cluster.start_far_trainer(2, "first slow")
        await until(lambda: len(cluster.executed()) == 2, limit_s=30.0)
        network.unplug(WORKER)
        cluster.start_worker(OTHER)
        await finished(cluster, 2)
        network.plug(WORKER)
    assert set(cluster.executed().values()) == {2}


WAYS = {
    "worker to manager": [(WORKER, MANAGER)],
    "manager to worker": [(MANAGER, WORKER)],
    "worker and manager": [(WORKER, MANAGER), (MANAGER, WORKER)],
    "trainer to manager": [(TRAINER, MANAGER)],
    "manager to trainer": [(MANAGER, TRAINER)],
    "trainer and manager": [(TRAINER, MANAGER), (MANAGER, TRAINER)],
    "all to manager": [(name, MANAGER) for name in (WORKER, OTHER, TRAINER)],
    "manager to all": [(MANAGER, name) for name in (WORKER, OTHER, TRAINER)],
}


@contextlib.asynccontextmanager
async def busy_cluster(network, folder, rollouts):
    """Run a cluster of two workers whose trainer has received the first of its results."""
    with SplitCluster(folder, network, **QUICK) as cluster:
        cluster.start_manager()
        for name in (WORKER, OTHER):
            cluster.start_worker(name)
        cluster.start_far_trainer(rollouts, "brief")
        await until(lambda: len(cluster.received()) >= 20, limit_s=30.0)
        yield cluster


async def cut(network, ways, for_s):
    """Lose all packets of these directions for a time."""
    for way in ways:
        network.lose(*way)
    await asyncio.sleep(for_s)
    for way in ways:
        network.pass_again(*way)


@pytest.mark.slow
@pytest.mark.parametrize("cut_s", [3.0, 20.0])
@pytest.mark.parametrize("ways", WAYS.values(), ids=WAYS)
async def test_lost_packets_of_one_direction_change_no_outcome(network, tmp_path, ways, cut_s):
    async with busy_cluster(network, tmp_path, 200) as cluster:
        await cut(network, ways, cut_s)
        healed_s = time.monotonic()
        await finished(cluster, 200)
        print(
            f"\n{cut_s:g} s: done {time.monotonic() - healed_s:.1f} s later, {cluster.log(TRAINER).strip()}"
        )


@pytest.mark.slow
async def test_any_order_of_cuts_gives_each_rollout_one_outcome_and_no_other_reward(network, tmp_path):
    seed = random.randrange(2**32)
    print(f"\nseed {seed}")
    rng = random.Random(seed)
    ends = [(name, MANAGER) for name in (WORKER, OTHER, TRAINER)]
    ways = [*ends, *((receiver, sender) for sender, receiver in ends)]
    async with busy_cluster(network, tmp_path, 1_500) as cluster:
        cuts, ends_s = 0, time.monotonic() + 60.0
        while time.monotonic() < ends_s and cluster.trainer_status() is None:
            await cut(network, rng.sample(ways, rng.randint(1, 4)), rng.choice((0.1, 0.5, 1.5, 4.0)))
            cuts += 1
            await asyncio.sleep(rng.uniform(0.0, 3.0))
        # A rollout that was lost three times ends as a failure of the infrastructure, and its group with it.
        await finished(cluster, 1_500, besides={"InfraFailure", "Cancelled"})
        right = sum(got == REWARD for _, got in cluster.received())
        print(f"{cuts} cuts, {right} of 1,500 with a reward, {cluster.log(TRAINER).strip()}")
        assert right > 300
