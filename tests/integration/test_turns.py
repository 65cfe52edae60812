"""Turns of episodes through a manager on loopback, with fake workers that speak the protocol."""

import asyncio
import contextlib
import dataclasses
import functools

import pytest
from tests.fakes import waiting
from tests.fakes.living import alive
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import BUNDLES, KITCHEN, manager

from embomatrix.manager.control.dispatch.batches import FINISHED_KEPT
from embomatrix.manager.control.dispatch.leases import ENDED_KEPT
from embomatrix.manager.control.dispatch.records import BatchRecord, LeaseRecord, RolloutRecord
from embomatrix.manager.runtime.results import BatchLog
from embomatrix.manager.store.sqlite import SqliteStore
from embomatrix.rpc.client import ClientLimits, ClusterClient
from embomatrix.rpc.episodes import Episodes, TurnFailedError
from embomatrix.rpc.status import (
    DeadlineError,
    InvalidRequestError,
    NotFoundError,
    PreconditionError,
)
from embomatrix.rpc.wire.bounds import TURNS
from embomatrix.rpc.wire.values import (
    Batch,
    Cancelled,
    Completed,
    GroupPolicy,
    InfraCode,
    InfraFailure,
    Rollout,
    RunTerms,
)
from embomatrix.skills.syntax import Skill, SkillCall
from embomatrix.skills.turns import Advice, EpisodePrefix, PrefixMismatchError

pytestmark = pytest.mark.timeout(90)

CALL = SkillCall(Skill.MOVE, object_index=1)
until = functools.partial(waiting.until, limit_s=10.0)


def turns(count, *, task="t", scene=KITCHEN, length=1, digest="", first=0):
    return [
        Rollout(
            f"t{n}", f"t{n}", scene, task, (CALL,) * (length + 1), n, prefix=EpisodePrefix(length, (), digest)
        )
        for n in range(first, first + count)
    ]


@contextlib.asynccontextmanager
async def trainer(address, policy=GroupPolicy.PARTIAL, **limits):
    async with ClusterClient(address, limits=ClientLimits(**limits)) as client:
        await client.open_run("test", "r1", RunTerms(policy))
        await client.put_bundles(BUNDLES)
        yield client


async def settled(client):
    """Wait until the manager has forgotten every turn."""

    for _ in range(200):
        if not any(run.pending for run in await client.list_runs()):
            return
        await asyncio.sleep(0.05)
    raise TimeoutError("turns are pending after 10 s")


async def test_each_turn_has_one_result_in_order(tmp_path):
    async with manager(tmp_path) as at, trainer(at.address) as client, FakeWorker(at.address, slots=2):
        asked = turns(TURNS)
        results = await client.step("r1", asked)
        assert [result.rollout_id for result in results] == [turn.rollout_id for turn in asked]
        assert {len(result.outcome.steps) for result in results} == {1}
        assert {result.outcome.observation.changes for result in results} == {("2 calls",)}


async def test_nothing_of_a_turn_is_kept(tmp_path):
    state = f"sqlite:{tmp_path / 'state.sqlite'}"
    before = {kind: alive(kind) for kind in (BatchLog, BatchRecord)}
    async with (
        manager(tmp_path, state=state) as at,
        trainer(at.address) as client,
        FakeWorker(at.address) as worker,
    ):
        for _ in range(5):
            await client.step("r1", turns(TURNS))
        await until(lambda: len(worker.acknowledged) == 5 * TURNS)
        assert alive(BatchLog) <= before[BatchLog]
        assert alive(BatchRecord) <= before[BatchRecord] + FINISHED_KEPT + 2
        events = await client.all_events("r1")
        assert len(events) < 10
        store = SqliteStore(str(tmp_path / "state.sqlite"))
        assert await store.batches("r1") == []
        await store.close()


async def test_ten_thousand_abandoned_episodes_leave_nothing(tmp_path):
    before = {kind: alive(kind) for kind in (BatchRecord, LeaseRecord, RolloutRecord)}
    async with (
        manager(tmp_path) as at,
        trainer(at.address) as client,
        FakeWorker(at.address, slots=2, stuck={"endless"}) as worker,
    ):
        await client.step("r1", turns(1))
        for number in range(40):
            call = asyncio.create_task(client.step("r1", turns(TURNS, task="endless", first=number * TURNS)))
            await until(lambda: worker.leases)
            await asyncio.sleep(0.02)
            call.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await call
            await until(lambda: not worker.leases)
        await settled(client)
        assert alive(BatchRecord) - before[BatchRecord] <= FINISHED_KEPT + 2
        assert alive(LeaseRecord) - before[LeaseRecord] <= ENDED_KEPT + 8
        assert alive(RolloutRecord) - before[RolloutRecord] <= FINISHED_KEPT + ENDED_KEPT + 8
        (run,) = await client.list_runs()
        assert run.stats.delivered == 40 * TURNS + 1


async def test_deadline_of_the_client_cancels_its_turns(tmp_path):
    async with (
        manager(tmp_path) as at,
        trainer(at.address, turn_s=0.5) as client,
        FakeWorker(at.address, slots=2, stuck={"endless"}) as worker,
    ):
        with pytest.raises(DeadlineError):
            await client.step("r1", turns(1, task="endless"))
        await settled(client)
        await until(lambda: not worker.leases)
        await client.step("r1", turns(1))


@pytest.mark.parametrize("policy", GroupPolicy)
async def test_failed_turn_takes_no_other_with_it(tmp_path, policy):
    async with (
        manager(tmp_path) as at,
        trainer(at.address, policy) as client,
        FakeWorker(at.address, poison={"bad"}),
    ):
        results = await client.step("r1", [*turns(1, task="bad"), *turns(8, first=1)])
        assert isinstance(results[0].outcome, InfraFailure)
        assert {type(result.outcome) for result in results[1:]} == {Completed}


async def test_mismatch_is_tried_on_another_worker(tmp_path):
    async with (
        manager(tmp_path) as at,
        trainer(at.address) as client,
        FakeWorker(at.address, "strange", strange=True) as strange,
    ):
        first = await client.step("r1", turns(1, digest="a"))
        assert first[0].outcome.code is InfraCode.PREFIX_MISMATCH
        assert first[0].attempt == 1  # the only worker would find the same again
        async with FakeWorker(at.address, "sound", slots=1):
            results = await client.step("r1", turns(16, digest="a"))
        assert {type(result.outcome) for result in results} == {Completed}
        assert {result.outcome.worker_id for result in results} == {"sound"}
        assert strange.executed


async def test_worker_that_does_not_know_sight_is_passed_over(tmp_path):
    (blind,) = turns(1)
    (looking,) = [dataclasses.replace(turn, sight=True, plan=turn.plan[:1]) for turn in turns(1, first=1)]
    async with (
        manager(tmp_path) as at,
        trainer(at.address) as client,
        FakeWorker(at.address, "old", blind=True),
    ):
        results = await client.step("r1", [blind, looking])
        assert isinstance(results[0].outcome, Completed)
        assert results[1].outcome.code is InfraCode.VERSION_SKEW
        assert "old does not know sight in episodes: upgrade it" in results[1].outcome.message
        async with FakeWorker(at.address, "new"):
            (result,) = await client.step("r1", [looking])
        assert (result.outcome.worker_id, result.outcome.observation.sees) == ("new", (0, 2))
        assert result.outcome.steps == ()


async def test_worker_that_does_not_know_advice_is_passed_over(tmp_path):
    (asking,) = [dataclasses.replace(turn, advise=True) for turn in turns(1)]
    async with (
        manager(tmp_path) as at,
        trainer(at.address) as client,
        FakeWorker(at.address, "old", blind=True),
    ):
        (result,) = await client.step("r1", [asking])
        assert result.outcome.code is InfraCode.VERSION_SKEW
        assert "old does not know the oracle's advice in episodes: upgrade it" in result.outcome.message
        async with FakeWorker(at.address, "new"):
            (result,) = await client.step("r1", [asking])
        assert result.outcome.worker_id == "new"
        assert result.outcome.observation.advice == Advice(asking.plan[:1])


async def test_worker_that_does_not_know_turns_is_passed_over(tmp_path):
    async with (
        manager(tmp_path) as at,
        trainer(at.address) as client,
        FakeWorker(at.address, "old", old=True),
    ):
        (result,) = await client.step("r1", turns(1))
        assert result.outcome.code is InfraCode.VERSION_SKEW
        assert "old does not know turns of episodes: upgrade it" in result.outcome.message
        async with FakeWorker(at.address, "new"):
            results = await client.step("r1", turns(8))
        assert {result.outcome.worker_id for result in results} == {"new"}
        workers = {worker.worker_id: worker.state for worker in await client.list_workers()}
        assert workers["old"] == "ready"  # and not in quarantine


@pytest.mark.parametrize(
    ("wrong", "error", "words"),
    [
        ({"scene": "sha256:" + "0" * 64}, PreconditionError, "lacks 1 bundles of this call"),
        ({"length": 64}, InvalidRequestError, r"turns\[0\].plan: found 65 elements: expected at most 64"),
    ],
)
async def test_refused_turns_are_named(tmp_path, wrong, error, words):
    async with manager(tmp_path) as at, trainer(at.address) as client, FakeWorker(at.address) as worker:
        with pytest.raises(error, match=words):
            await client.step("r1", turns(1, **wrong))
        assert worker.executed == []


async def test_call_with_no_turn_or_too_many_is_refused(tmp_path):
    async with manager(tmp_path) as at, trainer(at.address) as client:
        with pytest.raises(InvalidRequestError, match="turns: found none: expected 1 to 256"):
            await client.step("r1", [])
        with pytest.raises(InvalidRequestError, match="turns: found 257 elements: expected at most 256"):
            await client.step("r1", turns(TURNS + 1))
        with pytest.raises(NotFoundError, match="run 'r2' is not open"):
            await client.step("r2", turns(1))


async def test_turns_belong_to_step_and_other_rollouts_to_execute(tmp_path):
    async with manager(tmp_path) as at, trainer(at.address) as client:
        with pytest.raises(InvalidRequestError, match="turns of episodes: send them with Step"):
            _ = [
                result async for result in client.execute(Batch("r1", "b", 0, tuple(turns(1))), deadline_s=5)
            ]
        with pytest.raises(InvalidRequestError, match=r"turns\[0\].prefix: found no value"):
            await client.step("r1", [Rollout("x", "x", KITCHEN, "t", (CALL,), 0)])


async def test_closed_run_cancels_its_turns(tmp_path):
    async with (
        manager(tmp_path) as at,
        trainer(at.address) as client,
        FakeWorker(at.address, stuck={"endless"}) as worker,
    ):
        call = asyncio.create_task(client.step("r1", turns(2, task="endless")))
        await until(lambda: worker.leases)
        await client.close_run("r1")
        assert {type(result.outcome) for result in await call} == {Cancelled}


async def test_episode_goes_on_after_its_worker_died_between_two_turns(tmp_path):
    async with (
        manager(tmp_path) as at,
        trainer(at.address) as client,
        Episodes(client, "r1") as episodes,
    ):
        episode = episodes.begin(KITCHEN, "t")
        async with FakeWorker(at.address, "w1"):
            await episode.act([CALL])
        async with FakeWorker(at.address, "w2") as second:
            await episode.act([CALL])
            assert len(second.executed) == 1
        assert episode.prefix == EpisodePrefix(2, (), "sha256:2")


async def test_episodes_go_on_after_a_restart_of_the_manager(tmp_path):
    state = f"sqlite:{tmp_path / 'state.sqlite'}"
    async with manager(tmp_path, state=state) as at, trainer(at.address) as client:
        port = int(at.address.rpartition(":")[2])
        async with Episodes(client, "r1") as episodes:
            episode = episodes.begin(KITCHEN, "t")
            async with FakeWorker(at.address):
                await episode.act([CALL])
    async with (
        manager(tmp_path, state=state, port=port) as at,
        ClusterClient(at.address) as client,
        Episodes(client, "r1") as episodes,
        FakeWorker(at.address),
    ):
        again = episodes.begin(KITCHEN, "t")
        again.calls, again.prefix = episode.calls, episode.prefix
        assert (await again.act([CALL])).digest == "sha256:2"


async def test_mismatch_names_itself_to_the_episode(tmp_path):
    async with (
        manager(tmp_path) as at,
        trainer(at.address) as client,
        Episodes(client, "r1") as episodes,
        FakeWorker(at.address, strange=True, poison={"bad"}),
    ):
        episode = episodes.begin(KITCHEN, "t")
        await episode.act([CALL])
        with pytest.raises(PrefixMismatchError, match="expected a, found b"):
            await episode.act([CALL])
        with pytest.raises(TurnFailedError, match="slot_crashed"):
            await episodes.begin(KITCHEN, "bad").act([CALL])
