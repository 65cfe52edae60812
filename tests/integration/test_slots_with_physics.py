"""Slots of a worker with the real engine: results are independent of the slot, and a fault costs one rollout."""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from tests.fakes import waiting
from tests.fakes.plans import plan_of
from tests.fakes.pose_caches import build_pose_cache
from tests.fakes.scenes import kitchen_scene, kitchen_tasks

from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.wire.leases import Lease, LeaseRef
from embomatrix.rpc.wire.values import (
    Completed,
    InfraCode,
    ResidentState,
    Rollout,
)
from embomatrix.sim.live_world import prepare
from embomatrix.sim.simulation import load_simulator
from embomatrix.sim.zygote import private_mb
from embomatrix.skills.syntax import MAX_STEPS
from embomatrix.skills.turns import EpisodePrefix
from embomatrix.worker.slots.pool import SlotPool
from embomatrix.worker.slots.residents import SlotLimits
from embomatrix.world.bundle import Bundle, encode_bundle
from embomatrix.world.inflation import bundle_digest

PLANS = (
    "move apple_1; pick_up apple_1; move countertop_1; place countertop_1 ontop",
    "move microwave_1; open microwave_1; move fridge_1; open fridge_1; pick_up chicken_leg_1; "
    "move microwave_1; place microwave_1 inside",
    "move bowl_1; pick_up bowl_1; move shelf_1; place shelf_1 ontop; move mug_1; pick_up mug_1; "
    "move coffee_table_1; place coffee_table_1 ontop",
    "move fridge_1; pick_up fridge_1",
)

pytestmark = pytest.mark.timeout(120)


@pytest.fixture(scope="module")
def kitchen():
    """Bundle from the factory: the flat, its tasks, verified poses and the prepared arrays."""
    scene = kitchen_scene()
    tasks = {task.task_id: task for task in kitchen_tasks(scene)}
    movable, supports = ("apple_1", "bowl_1", "mug_1"), ("countertop_1", "shelf_1", "coffee_table_1")
    bundle = Bundle(scene, tasks, build_pose_cache(scene, movable, supports, seed=0))
    with contextlib.closing(load_simulator(bundle)) as simulator:
        return prepare(bundle, simulator.world)


class Harness:
    """Pool over a folder of bundles."""

    def __init__(self, folder, bundle, slots, sharing=True):
        self.folder = folder
        data = encode_bundle(bundle)
        self.digest = bundle_digest(data)
        self.bundle = bundle
        self.results = {}
        (folder / "kitchen.bundle").write_bytes(data)
        self.paths = {self.digest: folder / "kitchen.bundle"}
        self.pool = SlotPool(
            SlotLimits(slots, 1000.0, slot_memory_mb=512, fork_s=1.0, sharing=sharing),
            bundle_path=self._path,
            on_result=self._take,
            on_change=lambda: None,
            log=folder / "simulator.log",
        )

    async def _path(self, digest):
        return self.paths[digest]

    def _take(self, result):
        self.results[result.ref.lease_id] = result.outcome

    def submit(self, lease_id, plan=(), *, seed=1, digest="", deadline_s=30.0, reward=PAPER, prefix=None):
        task = next(iter(self.bundle.tasks))
        rollout = Rollout(lease_id, "g", digest or self.digest, task, plan, seed, prefix=prefix)
        self.pool.submit(Lease(LeaseRef(lease_id, 1), rollout, deadline_s, reward=reward))

    def plan(self, text):
        return plan_of(next(iter(self.bundle.tasks.values())), text)

    async def outcome(self, lease_id):
        await self.until(lambda: lease_id in self.results)
        return self.results[lease_id]

    async def until(self, condition, limit_s=60.0):
        await waiting.until(condition, limit_s)

    def slots(self):
        """Return the slot processes: children of the scene process, grandchildren of the root process."""
        return [
            slot
            for root in psutil.Process().children()
            for scene in root.children()
            for slot in scene.children()
            if slot.status() != psutil.STATUS_ZOMBIE
        ]


@contextlib.asynccontextmanager
async def running(folder, bundle, slots=1, sharing=True):
    harness = Harness(folder, bundle, slots, sharing)
    await harness.pool.start()
    task = asyncio.create_task(harness.pool.run())
    try:
        yield harness
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


FRESH = """
import sys
from pathlib import Path
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import parse_plan
from embomatrix.world.bundle import read_bundle
bundle = read_bundle(Path(sys.argv[1]))
simulator = load_simulator(bundle)
task = next(iter(bundle.tasks.values()))
for text in sys.argv[2:]:
    print(simulator.execute(task, parse_plan(text), 1).digest)
"""


@pytest.mark.parametrize("sharing", [True, False])
async def test_equal_plans_have_equal_digests_in_every_slot(tmp_path, kitchen, sharing):
    async with running(tmp_path, kitchen, slots=2, sharing=sharing) as harness:
        rounds = [list(enumerate(PLANS)), list(enumerate(PLANS))[::-1], list(enumerate(PLANS)) * 2]
        for number, plans in enumerate(rounds):
            for order, (index, text) in enumerate(plans):
                harness.submit(f"{index}/{number}.{order}", harness.plan(text))
        await harness.until(lambda: len(harness.results) == 16)
        words = [
            "; ".join(" ".join(_words(call)) for call in harness.plan(text)) for text in PLANS
        ]  # by number, as a trainer writes them
    digests = [
        {outcome.trace_digest for lease, outcome in harness.results.items() if lease.startswith(f"{index}/")}
        for index in range(len(PLANS))
    ]
    assert [len(found) for found in digests] == [1] * len(PLANS)
    for order in (words, words[::-1]):
        command = (sys.executable, "-c", FRESH, str(harness.paths[harness.digest]), *order)
        answer = await asyncio.to_thread(subprocess.run, command, capture_output=True, text=True, check=True)
        found = answer.stdout.split()
        expected = [digest for [digest] in digests]
        assert found == (expected if order is words else expected[::-1])


@pytest.mark.parametrize("sharing", [True, False])
async def test_mismatch_of_a_prefix_costs_no_slot_and_no_other_turn(tmp_path, kitchen, sharing):
    async with running(tmp_path, kitchen, sharing=sharing) as harness:
        plan = harness.plan(PLANS[3])
        harness.submit("first", plan[:1], prefix=EpisodePrefix())
        first = await harness.outcome("first")
        (slot,) = harness.slots()
        harness.submit("wrong", plan, prefix=EpisodePrefix(1, (), "sha256:0"))
        harness.submit("again", plan, prefix=EpisodePrefix(1, (), first.trace_digest))
        harness.submit("plain", plan)
        wrong, again, plain = [await harness.outcome(name) for name in ("wrong", "again", "plain")]
        assert harness.slots() == [slot]
    assert wrong.code is InfraCode.PREFIX_MISMATCH
    assert f"expected 'sha256:0', found '{first.trace_digest}'" in wrong.message
    assert again.steps == plain.steps[1:]
    assert again.reward == plain.reward
    assert (again.observation is None, plain.observation is None) == (False, True)


def _words(call):
    values = (call.object_index, call.relation.value if call.relation else None)
    return [call.skill.value, *(str(value) for value in values if value is not None)]


async def test_run_coefficients_change_the_score_and_not_the_execution(tmp_path, kitchen):
    own = RewardSettings(format=2.0, relevance_per_object=1.0, relevance_limit=9.0, goal=3.0)
    async with running(tmp_path, kitchen) as harness:
        harness.submit("own", harness.plan(PLANS[0]), reward=own)
        harness.submit("paper's", harness.plan(PLANS[0]))
        mine, usual = await harness.outcome("own"), await harness.outcome("paper's")
    assert mine.trace_digest == usual.trace_digest
    assert mine.reward.atoms == usual.reward.atoms
    assert (usual.reward.format, mine.reward.format) == (0.5, 2.0)
    assert usual.reward.relevance > 0
    assert mine.reward.relevance == pytest.approx(5 * usual.reward.relevance)
    assert mine.reward.goal == pytest.approx(usual.reward.goal / 10)


async def test_stopped_slot_is_killed_at_its_deadline_and_replaced(tmp_path, kitchen):
    async with running(tmp_path, kitchen) as harness:
        harness.submit("first", harness.plan(PLANS[0]))
        first = await harness.outcome("first")
        [slot] = harness.slots()
        os.kill(slot.pid, signal.SIGSTOP)
        harness.submit("stopped", harness.plan(PLANS[0]), deadline_s=0.5)
        stopped = await harness.outcome("stopped")
        assert stopped.code is InfraCode.SLOT_TIMEOUT
        harness.submit("next", harness.plan(PLANS[0]))
        assert (await harness.outcome("next")).trace_digest == first.trace_digest
        await harness.until(lambda: not psutil.pid_exists(slot.pid))


async def test_stopped_resident_is_replaced_and_its_slots_finish(tmp_path, kitchen):
    async with running(tmp_path, kitchen, slots=2) as harness:
        harness.submit("first", harness.plan(PLANS[0]))
        first = await harness.outcome("first")
        [slot] = harness.slots()
        scene = slot.parent()
        os.kill(scene.pid, signal.SIGSTOP)
        await harness.until(
            lambda: not harness.pool.load
        )  # then both begin at once, and one needs a new slot
        for name in ("in the old slot", "in a new one"):
            harness.submit(name, harness.plan(PLANS[0]))
        outcomes = [await harness.outcome(name) for name in ("in the old slot", "in a new one")]
        assert [outcome.trace_digest for outcome in outcomes] == [first.trace_digest] * 2
        await harness.until(lambda: not psutil.pid_exists(scene.pid))
        assert scene.pid not in {other.parent().pid for other in harness.slots()}
        assert [resident.state for resident in harness.pool.residents()] == [ResidentState.WARM]


async def test_killed_slot_costs_only_its_rollout(tmp_path, kitchen):
    async with running(tmp_path, kitchen, slots=2) as harness:
        harness.submit("first", harness.plan(PLANS[0]))
        await harness.outcome("first")
        for slot in harness.slots():
            slot.kill()
        for number in range(6):
            harness.submit(f"next-{number}", harness.plan(PLANS[0]))
        await harness.until(lambda: len(harness.results) == 7)
        lost = [outcome for outcome in harness.results.values() if not isinstance(outcome, Completed)]
        assert [outcome.code for outcome in lost] in ([], [InfraCode.SLOT_CRASHED])
        digests = {
            outcome.trace_digest for outcome in harness.results.values() if isinstance(outcome, Completed)
        }
        assert len(digests) == 1


async def test_circular_plan_ends_with_its_last_step(tmp_path, kitchen):
    async with running(tmp_path, kitchen) as harness:
        circle = harness.plan("; ".join(["move apple_1; move fridge_1"] * (MAX_STEPS // 2)))
        assert len(circle) == MAX_STEPS
        started_s = time.monotonic()
        harness.submit("circle", circle)
        outcome = await harness.outcome("circle")
        assert [step.ok for step in outcome.steps] == [True] * MAX_STEPS
        assert time.monotonic() - started_s < 30.0
        harness.submit("longer", circle * 2)
        longer = await harness.outcome("longer")
        assert f"expected at most {MAX_STEPS}" in longer.message
        harness.submit("next", harness.plan(PLANS[0]))
        assert isinstance(await harness.outcome("next"), Completed)


async def test_invalid_bundle_fails_only_its_own_leases(tmp_path, kitchen):
    async with running(tmp_path, kitchen) as harness:
        huge, other = "sha256:" + "1" * 64, "sha256:" + "2" * 64
        harness.paths[huge] = tmp_path / "huge.bundle"
        with harness.paths[huge].open("wb") as file:
            file.truncate(1 << 30)
        harness.paths[other] = harness.paths[harness.digest]
        harness.submit("huge", digest=huge)
        harness.submit("other", digest=other)
        harness.submit("first", harness.plan(PLANS[0]))
        first, refused, foreign = [await harness.outcome(name) for name in ("first", "huge", "other")]
        assert isinstance(first, Completed)
        assert (refused.code, foreign.code) == (InfraCode.BUNDLE_CORRUPT, InfraCode.BUNDLE_CORRUPT)
        assert "over 8,388,608 bytes" in refused.message
        assert "expected sha256:2222" in foreign.message


def takes_small_pages(pid):
    return "THP_enabled:\t0" in Path(f"/proc/{pid}/status").read_text()


async def test_slot_memory_stays_constant_over_many_rollouts(tmp_path, kitchen):
    async with running(tmp_path, kitchen) as harness:
        sizes_mb = []
        for stretch in range(4):
            for number in range(60):
                harness.submit(f"{stretch}.{number}", harness.plan(PLANS[number % len(PLANS)]), seed=number)
            expected = 60 * (stretch + 1)
            await harness.until(lambda expected=expected: len(harness.results) == expected)
            [slot] = harness.slots()
            sizes_mb.append(private_mb(slot.pid))
            assert takes_small_pages(slot.pid)
        assert all(isinstance(outcome, Completed) for outcome in harness.results.values())
        assert sizes_mb[-1] - sizes_mb[1] < 4.0, sizes_mb
        assert harness.pool.residents()[0].state is ResidentState.WARM
