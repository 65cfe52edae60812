"""Episodes of a client: turns that are awaited together travel together, and errors reach the turn that they belong to."""

import asyncio
import dataclasses

import pytest
from tests.fakes.worker import completed_turn

from embomatrix.rpc.client import ClientLimits
from embomatrix.rpc.episodes import CALLS, Episodes, TurnFailedError
from embomatrix.rpc.status import InvalidRequestError, NotFoundError, OverloadedError, UnavailableError
from embomatrix.rpc.wire.bounds import TURNS
from embomatrix.rpc.wire.values import Cancelled, InfraCode, InfraFailure, RolloutResult
from embomatrix.skills.syntax import MAX_STEPS, Skill, SkillCall
from embomatrix.skills.turns import Advice, EpisodeOverError, EpisodePrefix, PrefixMismatchError

CALL = SkillCall(Skill.MOVE, object_index=1)
LIMITS = ClientLimits(turn_s=5.0, retry_first_s=0.01, retry_longest_s=0.02)


class FakeClient:
    """Client whose calls are answered by ``answer``, all at once after ``go`` is set."""

    def __init__(self, answer=completed_turn, limits=LIMITS):
        self.limits = limits
        self.answer = answer
        self.go = asyncio.Event()
        self.go.set()
        self.calls = []
        self.cancelled = 0

    async def step(self, run_id, turns, *, timeout_s=None):
        assert run_id == "run-1"
        assert 0 < timeout_s <= self.limits.turn_s
        self.calls.append(tuple(turns))
        try:
            await self.go.wait()
        except asyncio.CancelledError:
            self.cancelled += 1
            raise
        outcomes = [self.answer(turn) for turn in turns]
        return tuple(
            RolloutResult(turn.rollout_id, turn.group_id, 0, 1, outcome)
            for turn, outcome in zip(turns, outcomes, strict=True)
        )

    @property
    def sizes(self):
        return list(map(len, self.calls))


def failing(*errors):
    """Return an answer that raises these errors first."""
    left = list(errors)

    def answer(turn):
        if left:
            raise left.pop(0)
        return completed_turn(turn)

    return answer


async def test_episode_sends_all_its_calls_and_the_digest_after_them():
    client = FakeClient()
    async with Episodes(client, "run-1") as episodes:
        episode = episodes.begin("sha256:0", "task", seed=7)
        first = await episode.act([CALL, CALL])
        await episode.act([CALL])
    assert len(first.steps) == 2
    assert first.observation.changes == ("2 calls",)
    (one,), (two,) = client.calls
    assert (one.plan, one.prefix) == ((CALL, CALL), EpisodePrefix())
    assert (two.plan, two.prefix) == ((CALL,) * 3, EpisodePrefix(2, (), "sha256:2"))
    assert (two.bundle_digest, two.task_id, two.seed) == ("sha256:0", "task", 7)


async def test_episode_with_sight_looks_without_a_call():
    client = FakeClient()
    async with Episodes(client, "run-1") as episodes:
        episode = episodes.begin("sha256:0", "task", sight=True)
        first = await episode.look()
        await episode.act([CALL])
        with pytest.raises(EpisodeOverError, match="a turn has no call"):
            await episode.act([])
        with pytest.raises(EpisodeOverError, match="a turn has no call"):
            await episodes.begin("sha256:0", "task").look()
    assert (first.steps, first.observation.sees) == ((), (0, 2))
    (look,), (act,) = client.calls
    assert (look.plan, look.prefix, look.sight) == ((), EpisodePrefix(), True)
    assert (act.plan, act.prefix, act.sight) == ((CALL,), EpisodePrefix(0, (), "sha256:0"), True)


async def test_advice_takes_no_call_and_leaves_the_episode_as_it_was():
    client = FakeClient()
    async with Episodes(client, "run-1") as episodes:
        episode = episodes.begin("sha256:0", "task")
        await episode.act([CALL])
        before = (episode.calls, episode.prefix)
        assert await episode.advise() == Advice((CALL,))
        assert (episode.calls, episode.prefix) == before
    _, (asked,) = client.calls
    assert (asked.plan, asked.prefix.length, asked.advise, asked.sight) == ((CALL,), 1, True, False)


async def test_turn_that_is_answered_without_advice_is_an_error():
    client = FakeClient(lambda turn: completed_turn(dataclasses.replace(turn, advise=False)))
    async with Episodes(client, "run-1") as episodes:
        with pytest.raises(TurnFailedError, match="without the oracle's advice: upgrade"):
            await episodes.begin("sha256:0", "task").advise()


async def test_turns_that_are_awaited_together_share_calls():
    client = FakeClient()
    async with Episodes(client, "run-1") as episodes:
        await asyncio.gather(*(episodes.begin("s", "t", n).act([CALL]) for n in range(64)))
    assert client.sizes == [16] * CALLS


async def test_turns_gather_while_all_calls_are_in_flight():
    client = FakeClient()
    client.go.clear()
    async with Episodes(client, "run-1", calls=1) as episodes:
        acts = [asyncio.create_task(episodes.begin("s", "t", n).act([CALL])) for n in range(3 * TURNS)]
        await asyncio.sleep(0.01)
        assert client.sizes == [TURNS]
        client.go.set()
        await asyncio.gather(*acts)
    assert client.sizes == [TURNS] * 3


async def test_turn_is_sent_again_after_a_transient_error():
    client = FakeClient(failing(UnavailableError("gone"), OverloadedError("full")))
    async with Episodes(client, "run-1") as episodes:
        turn = await episodes.begin("s", "t").act([CALL])
    assert len(turn.steps) == 1
    assert client.sizes == [1, 1, 1]
    assert client.calls[0] == client.calls[2]


async def test_manager_that_stays_away_is_named_after_the_time_limit():
    client = FakeClient(failing(*[UnavailableError("no manager answers")] * 99), ClientLimits(turn_s=0.05))
    async with Episodes(client, "run-1") as episodes:
        with pytest.raises(UnavailableError, match="no manager answers"):
            await episodes.begin("s", "t").act([CALL])


async def test_refused_turn_costs_no_other_turn_its_result():
    def answer(turn):
        if turn.task_id == "unknown":
            raise InvalidRequestError("turn 7: no such task")
        return completed_turn(turn)

    client = FakeClient(answer)
    async with Episodes(client, "run-1") as episodes:
        tasks = ["unknown" if number == 7 else "t" for number in range(20)]
        results = await asyncio.gather(
            *(episodes.begin("s", task).act([CALL]) for task in tasks), return_exceptions=True
        )
    assert [number for number, result in enumerate(results) if isinstance(result, Exception)] == [7]
    assert isinstance(results[7], InvalidRequestError)


@pytest.mark.parametrize(
    ("outcome", "error", "words"),
    [
        (InfraFailure(InfraCode.PREFIX_MISMATCH, "expected a, found b"), PrefixMismatchError, "found b"),
        (InfraFailure(InfraCode.WORKER_LOST, "w1 is gone"), TurnFailedError, "worker_lost.*w1 is gone"),
        (Cancelled("the run was closed"), TurnFailedError, "run was closed"),
    ],
)
async def test_turn_without_a_result_leaves_the_episode_as_it_was(outcome, error, words):
    client = FakeClient()
    async with Episodes(client, "run-1") as episodes:
        episode = episodes.begin("s", "t")
        await episode.act([CALL])
        known = (episode.calls, episode.prefix)
        client.answer = lambda _: outcome
        with pytest.raises(error, match=words):
            await episode.act([CALL])
        assert (episode.calls, episode.prefix) == known
        client.answer = completed_turn
        await episode.act([CALL])
        assert episode.prefix.length == 2


async def test_run_that_is_not_open_is_named_for_every_turn():
    client = FakeClient(failing(*[NotFoundError("run 'run-1' is not open")] * 9))
    async with Episodes(client, "run-1") as episodes:
        results = await asyncio.gather(
            *(episodes.begin("s", "t", n).act([CALL]) for n in range(3)), return_exceptions=True
        )
    assert [type(result) for result in results] == [NotFoundError] * 3


async def test_call_is_cancelled_once_nobody_awaits_its_turns():
    client = FakeClient()
    client.go.clear()
    async with Episodes(client, "run-1", calls=1) as episodes:
        acts = [asyncio.create_task(episodes.begin("s", "t", n).act([CALL])) for n in range(2)]
        await asyncio.sleep(0.01)
        acts[0].cancel()
        await asyncio.sleep(0.01)
        assert client.cancelled == 0
        acts[1].cancel()
        await asyncio.sleep(0.01)
        assert client.cancelled == 1
        client.go.set()
        await episodes.begin("s", "t").act([CALL])


async def test_end_of_the_episodes_gives_up_their_turns():
    client = FakeClient()
    client.go.clear()
    async with Episodes(client, "run-1", calls=1) as episodes:
        acts = [asyncio.create_task(episodes.begin("s", "t", n).act([CALL])) for n in range(TURNS + 1)]
        await asyncio.sleep(0.01)
    results = await asyncio.gather(*acts, return_exceptions=True)
    assert {type(result) for result in results} == {asyncio.CancelledError}


async def test_more_calls_than_an_episode_may_have_are_not_sent():
    client = FakeClient()
    async with Episodes(client, "run-1") as episodes:
        episode = episodes.begin("s", "t")
        with pytest.raises(EpisodeOverError, match="no call"):
            await episode.act([])
        await episode.act([CALL] * MAX_STEPS)
        with pytest.raises(
            EpisodeOverError, match="has 64 calls, and 1 more are too many: expected at most 64"
        ):
            await episode.act([CALL])
    assert client.sizes == [1]


async def test_two_turns_of_one_episode_at_a_time_are_refused():
    async with Episodes(FakeClient(), "run-1") as episodes:
        episode = episodes.begin("s", "t")
        act = asyncio.create_task(episode.act([CALL]))
        await asyncio.sleep(0)
        with pytest.raises(RuntimeError, match="within a turn"):
            await episode.act([CALL])
        await act
