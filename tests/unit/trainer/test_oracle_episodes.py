"""Episodes of the oracle: what ends them is told in one sentence."""

import asyncio
import threading
from types import SimpleNamespace

import pytest
from tests.fakes.symbolic_household import make_tasks

from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.rpc.status import UnavailableError
from embomatrix.rpc.wire.values import InfraCode, InfraFailure
from embomatrix.skills.prompt import Prompt
from embomatrix.trainer.cluster.gateway import PlanOutcome, PlayedTurn
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.episodes.client import PlannedEpisode
from embomatrix.trainer.episodes.oracle import oracle_episodes, successful

TASKS = make_tasks(3, 1)


class LostEpisode:
    is_over = True
    opening = None
    player = SimpleNamespace(steps=[])
    lost = InfraFailure(InfraCode.NO_CAPACITY, "no worker is connected: start one")

    def outcome(self):
        return PlanOutcome("", None, self.lost)


class SolvedEpisode:
    opening = Prompt("", "Open the fridge.")
    answers = ("open 2", "done")
    turns = (PlayedTurn("open 2", "open 2: opened fridge 2", 1), PlayedTurn("done", "", 0))

    def outcome(self):
        return PlanOutcome("", RewardBreakdown(1.0, 0.2, 30.0, (), success=True), None)


def test_success_of_the_policy_alone_teaches_nothing():
    assert successful(SolvedEpisode(), policy_answers=1).policy_answers == 1
    assert successful(SolvedEpisode(), policy_answers=2) is None


class Client:
    """Client whose episodes are lost, or whose manager is away."""

    def __init__(self, error=None):
        self._error = error
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()

    def run(self, work):
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    async def begin_all(self, planned):
        if self._error is not None:
            raise self._error
        return [LostEpisode() for _ in planned]


@pytest.mark.parametrize(
    ("client", "words"),
    [
        (Client(), "no worker is connected"),
        (Client(UnavailableError("no manager answers")), "no manager answers"),
    ],
)
def test_cluster_that_can_t_play_gives_one_sentence(tmp_path, client, words):
    planned = [PlannedEpisode(task, 0) for task in TASKS.train]
    with pytest.raises(TrainerError, match=words):
        oracle_episodes(tmp_path, {}, planned, client, lambda *_: None)
    assert not list(tmp_path.iterdir())
