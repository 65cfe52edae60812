"""TRL's adapter for episodes on a real cluster, used as TRL's loop does: tools of an object, then the reward."""

import asyncio

import pytest
from tests.fakes import waiting
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.real_cluster import one_real_worker

from embomatrix.envs.rules import EpisodeRules
from embomatrix.rpc.status import UnavailableError
from embomatrix.trainer.adapters.trl_episodes import LOST, ClusterEpisodes
from embomatrix.trainer.config.errors import TrainerError

pytestmark = pytest.mark.timeout(180)
TASK = "apple_to_counter"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_kitchen_dataset(tmp_path_factory.mktemp("dataset"))


@pytest.fixture
def episodes(dataset, cluster):
    opened = ClusterEpisodes.at(
        dataset, cluster.address, visibility="seen", rules=EpisodeRules(failure_cost=0.5)
    )
    yield opened
    opened.close()


def begun(episodes, task_id=TASK, split="train"):
    """Return tools of the task at its start, and the text that opens it."""
    (row,) = [row for row in episodes.rows(split) if row["task_id"] == task_id]
    tools = episodes.factories[row["environment"]]()
    return tools, tools.reset(**{name: value for name, value in row.items() if name != "environment"})


def called(episodes, tools):
    """Make the calls of the task's oracle plan as tools, and return what they answer."""
    record = episodes.environment.dataset.find(TASK)
    calls = [dict(call) for call in record.oracle]
    return [getattr(tools, call.pop("action"))(**call) for call in calls]


def test_tools_play_a_task_to_its_goal(episodes):
    tools, text = begun(episodes)
    assert "Put the apple from the kitchen table on the counter" in text
    assert called(episodes, tools)[-1].startswith("place 0 ontop: put apple")
    idle, _ = begun(episodes)
    metrics, columns = {}, {}
    rewards = episodes(
        ["p"] * 2,
        ["c"] * 2,
        environments=[tools, idle],
        log_metric=metrics.__setitem__,
        log_extra=columns.__setitem__,
    )
    assert rewards[0] > 30
    assert rewards[1] == -1.0, "an episode without a call is like text without a plan"
    assert metrics["embomatrix/success"] == 0.5
    assert metrics["embomatrix/calls"] == len(tools.episode.player.steps) / 2
    assert metrics["embomatrix/lost"] == 0
    assert columns["task"] == [TASK, TASK]
    assert columns["outcome"][1] == "no call"


def test_wrong_arguments_are_answered_in_words_and_count_as_failed_calls(episodes):
    tools, _ = begun(episodes)
    assert "object_index is 'apple'" in tools.move("apple")
    assert "relation is 'in; open 2'" in tools.place(0, "in; open 2")
    assert "among those that you have seen" in tools.move(59)
    (reward,) = episodes(["p"], ["c"], environments=[tools])
    assert reward == -1.0 - 3 * 0.5


def test_calls_after_the_end_are_refused(dataset, cluster):
    rules = EpisodeRules(calls=1)
    opened = ClusterEpisodes.at(dataset, cluster.address, rules=rules)
    try:
        tools, _ = begun(opened)
        tools.turn(1.0)
        assert "The episode is over" in tools.turn(1.0)
        assert tools.reset(TASK), "the same object plays the next episode"
        assert "turn 1: turned" in tools.turn(1.0)
    finally:
        opened.close()


def test_rows_of_a_split_have_seeds_that_no_other_split_has(episodes):
    train, heldout = episodes.rows(), episodes.rows("heldout")
    assert len(train) == 3
    assert [row["task_id"] for row in heldout] == ["tidy_up"]
    assert all(row["seed"] >= 2**31 for row in train)
    assert all(row["seed"] < 2**31 for row in heldout)
    assert all(row["prompt"][1] == {"role": "user", "content": ""} for row in train)


def test_lost_episode_has_no_reward_and_an_error_of_the_cluster_stops_the_trainer(episodes, monkeypatch):
    tools, _ = begun(episodes)
    monkeypatch.setattr(episodes.environment, "answer", _raising(UnavailableError("no manager answers")))
    assert tools.turn(1.0) == LOST
    assert tools.turn(1.0) == LOST
    with pytest.raises(TrainerError, match="no manager answers"):
        episodes(["p"], ["c"], environments=[tools])
    tools.error = None
    metrics = {}
    assert episodes(["p"], ["c"], environments=[tools], log_metric=metrics.__setitem__) == [None]
    assert metrics == {"embomatrix/lost": 1.0}


def _raising(error):
    def answer(*_):
        raise error

    return answer


def test_scenes_of_announced_tasks_are_loaded_before_their_first_turn(dataset, tmp_path):
    with one_real_worker(tmp_path) as fresh:
        opened = ClusterEpisodes.at(dataset, fresh.address)
        opened.announce([[TASK]], 2)
        asyncio.run(waiting.until(lambda: "scene warm" in fresh.log("w1"), 60))
        opened.close()


def test_missing_dataset_gives_one_sentence(tmp_path, cluster):
    with pytest.raises(TrainerError, match="nowhere"):
        ClusterEpisodes.at(tmp_path / "nowhere", cluster.address)
