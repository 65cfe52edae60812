"""Adapters to other trainers on a symbolic cluster: scores, retries, announcements."""

import asyncio
import pickle
import time

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.symbolic_household import SymbolicCluster, make_tasks

from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.reward_label import RewardLabel
from embomatrix.skills.prompt import Codec
from embomatrix.trainer.adapters import openrlhf, rows, verl
from embomatrix.trainer.adapters.scorer import PlanScorer, reward_named, scorer_for
from embomatrix.trainer.adapters.trl import AnnouncedSampler, ClusterLookahead, ClusterReward, text_of
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.data.tasks import load_tasks
from embomatrix.trainer.policy.prompts import plan_text
from embomatrix.world.task import Profile

TASKS = make_tasks(6, 1)
FIRST, SECOND = TASKS.train[:2]
IDS = [task.task.task_id for task in TASKS.train]


def oracle(task):
    return plan_text(task.oracle, task.situation, Codec.JSON)


def scorer(cluster, **options):
    return PlanScorer(lambda: TASKS, lambda: cluster, **options)


@pytest.fixture
def cluster():
    return SymbolicCluster(TASKS)


@pytest.fixture
def on_cluster(cluster):
    with scorer(cluster) as opened:
        yield opened


async def test_texts_of_several_tasks_are_scored_in_order_as_one_batch(cluster, on_cluster):
    texts = [oracle(FIRST), "no plan", oracle(SECOND), "toggle_on 0"]
    ids = [FIRST.task.task_id, SECOND.task.task_id, SECOND.task.task_id, FIRST.task.task_id]
    outcomes = await on_cluster.score(ids, texts)
    assert [outcome.text for outcome in outcomes] == texts
    assert [outcome.success for outcome in outcomes] == [True, False, True, False]
    assert outcomes[1].value == -1
    assert (len(cluster.batches), cluster.executed) == (1, 3)


async def test_scorer_serves_several_event_loops(on_cluster):
    def in_a_loop_of_its_own():
        return asyncio.run(on_cluster.score([FIRST.task.task_id], [oracle(FIRST)]))

    found = await asyncio.gather(*(asyncio.to_thread(in_a_loop_of_its_own) for _ in range(3)))
    assert all(outcome.success for (outcome,) in found)


async def test_single_texts_are_grouped_by_task(cluster, on_cluster):
    ids = [FIRST.task.task_id] * 5 + [SECOND.task.task_id] * 3
    outcomes = await asyncio.gather(
        *(on_cluster.score_one(task_id, f"toggle_on {index}") for index, task_id in enumerate(ids))
    )
    assert [outcome.text for outcome in outcomes] == [f"toggle_on {index}" for index in range(8)]
    assert len(cluster.batches) == 2


async def test_unknown_task_gives_a_one_sentence_error(on_cluster):
    with pytest.raises(TrainerError, match=r"no task 'elsewhere' among its 7"):
        await on_cluster.score(["elsewhere"], ["move 1"])


def given_tasks():
    return TASKS


def new_cluster():
    return SymbolicCluster(TASKS)


def test_pickled_copy_of_an_open_scorer_opens_its_own_run():
    with PlanScorer(given_tasks, new_cluster) as original:
        copy = pickle.loads(pickle.dumps(original))
        outcomes = asyncio.run(copy.score([FIRST.task.task_id], [oracle(FIRST)]))
        copy.close()
    assert outcomes[0].success


def test_closing_ends_the_run_and_the_next_score_opens_another(cluster, on_cluster):
    on_cluster.close()
    assert cluster.closed
    assert asyncio.run(on_cluster.score([FIRST.task.task_id], [oracle(FIRST)]))[0].success


def test_missing_token_file_gives_a_one_sentence_error(tmp_path):
    with pytest.raises(TrainerError, match="can't be read"):
        scorer_for(tmp_path, token=f"@{tmp_path / 'token'}")


async def test_trl_gets_a_reward_per_completion_and_none_for_a_lost_one():
    lossy = SymbolicCluster(TASKS, lost=frozenset({"score-0/0/1"}))
    metrics, columns = {}, {}
    with scorer(lossy) as opened:
        rewards = await ClusterReward(opened)(
            prompts=["p"] * 3,
            completions=[[{"role": "assistant", "content": oracle(FIRST)}], oracle(FIRST), "hm"],
            completion_ids=[[1], [2], [3]],
            task_id=[FIRST.task.task_id] * 3,
            trainer_state=None,
            log_metric=metrics.__setitem__,
            log_extra=columns.__setitem__,
        )
    assert rewards[0] > 30
    assert rewards[1:] == [None, -1.0]
    assert metrics["embomatrix/lost"] == pytest.approx(1 / 3)
    assert metrics["embomatrix/success"] == 0.5
    assert columns["task"] == [FIRST.task.task_id] * 3
    assert columns["outcome"][1] == "lost to the infrastructure"


@pytest.mark.parametrize("completion", [None, [], [{"role": "assistant"}], [{"content": None}], 3])
def test_completion_without_text_counts_as_empty(completion):
    assert text_of(completion) == ""


def test_sampler_announces_each_portion_before_its_first_index():
    windows = []
    sampler = AnnouncedSampler([4, 4, 1, 1, 0, 0, 2, 2, 3, 3], 4, 1, windows.append)
    drawn = []
    for index in sampler:
        drawn.append((index, len(windows)))
    assert [index for index, _ in drawn] == [4, 4, 1, 1, 0, 0, 2, 2, 3, 3]
    assert [count for _, count in drawn] == [1] * 4 + [2] * 4 + [3] * 2
    assert windows == [[[4, 1], [0, 2]], [[0, 2], [3]], [[3]]]
    assert len(sampler) == 10


class Arguments:
    generation_batch_size, steps_per_generation = 4, 2


class Accelerator:
    is_main_process = True


class TrainerOfTheirs:
    """Part of TRL's trainer that the mixin uses; tests/peers checks that TRL has it."""

    args, accelerator = Arguments, Accelerator
    num_generations, num_iterations = 2, 1

    def __init__(self, *rewards):
        self.train_dataset = {"task_id": IDS}
        self.reward_funcs = rewards

    def _get_train_sampler(self, dataset=None):
        return [
            index for pair in ((0, 1), (2, 3)) for _ in range(2) for index in (*pair[:1] * 2, *pair[1:] * 2)
        ]


class LookingAhead(ClusterLookahead, TrainerOfTheirs):
    lookahead_steps = 1


def test_mixin_announces_the_current_and_the_next_generation(cluster, on_cluster):
    sampler = LookingAhead(ClusterReward(on_cluster))._get_train_sampler()
    drawn = iter(sampler)
    next(drawn)
    until(lambda: cluster.announced)
    assert cluster.announced == [(1, [0, 0, 1, 1])]
    assert cluster.sent == {task.bundle_digest for task in TASKS.train[:4]}
    assert len([0, *drawn]) == len(sampler) == 16


def test_mixin_ignores_a_trainer_without_our_reward():
    assert isinstance(LookingAhead(len)._get_train_sampler(), list)


def until(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_coefficients_of_the_reward_come_from_a_text_or_the_variable(monkeypatch):
    assert reward_named() == PAPER
    assert reward_named(" goal=10, format=0 ") == RewardSettings(goal=10, format=0)
    monkeypatch.setenv("EMBOMATRIX_REWARD", "goal=5")
    assert reward_named() == RewardSettings(goal=5)
    assert reward_named("goal=10").goal == 10, "an argument comes before the variable"
    for wrong, sentence in (
        ("gaol=5", "found 'gaol=5': expected NAME=NUMBER with one of the names unparsable, format,"),
        ("goal", "found 'goal': expected NAME=NUMBER"),
        ("goal=much", "found 'goal=much': expected NAME=NUMBER"),
        ("goal=-1", r"goal: found -1: expected 0 or more"),
    ):
        with pytest.raises(TrainerError, match=sentence):
            reward_named(wrong)


async def test_scorer_counts_by_its_coefficients(cluster):
    with scorer(cluster, reward=RewardSettings(unparsable=-2)) as opened:
        assert (await opened.reward_of(FIRST.task.task_id, "hm")).total == -2


async def test_verl_gets_the_same_keys_for_valid_and_invalid_plans(on_cluster):
    good = verl.reward_payload(await on_cluster.reward_of(FIRST.task.task_id, oracle(FIRST)))
    none = verl.reward_payload(await on_cluster.reward_of(FIRST.task.task_id, "hm"))
    assert good.keys() == none.keys()
    assert (good["score"] > 30, good["success"], none["score"]) == (True, 1.0, -1.0)


async def test_lost_plan_is_retried_for_a_number_and_then_raises():
    with scorer(SymbolicCluster(TASKS, lost=frozenset({"score-0/"}))) as opened:
        assert (await opened.reward_of(FIRST.task.task_id, oracle(FIRST))).success
    with (
        scorer(SymbolicCluster(TASKS, lose_first=True)) as opened,
        pytest.raises(TrainerError, match="lost a plan of the task 'task-0' 3 times"),
    ):
        await opened.reward_of(FIRST.task.task_id, oracle(FIRST))


async def test_openrlhf_gets_tensors_and_lost_plans_are_retried():
    asked = [
        RewardLabel(task.task.task_id, task.bundle_digest, Profile.PAPER, seed)
        for task, seed in ((FIRST, 7), (SECOND, 8), (FIRST, 7))
    ]
    cluster = SymbolicCluster(TASKS, lost=frozenset({"score-0/"}))
    with scorer(cluster) as opened:
        rewards = await openrlhf.rewards_of(opened, asked, [oracle(FIRST), oracle(SECOND), "hm"])
    assert set(cluster.seeds) == {(FIRST.task.task_id, 7), (SECOND.task.task_id, 8)}
    payload = openrlhf.reward_payload(rewards)
    assert payload["scores"].tolist() == [1.0, 1.0, 0.0]
    assert payload["rewards"].tolist() == pytest.approx([reward.total for reward in rewards])
    assert sum(values[2].item() for values in payload["extra_logs"].values()) == -1
    with (
        scorer(SymbolicCluster(TASKS, lose_first=True)) as opened,
        pytest.raises(TrainerError, match="lost a plan of the task 'task-0' 3 times"),
    ):
        await openrlhf.rewards_of(opened, asked[:1], [oracle(FIRST)])


def test_openrlhf_errors_name_the_mismatched_query_and_the_missing_setting():
    label = RewardLabel("t", FIRST.bundle_digest, Profile.PAPER, 0).text()
    with pytest.raises(TrainerError, match="does not contain its prompt 'the prompt'"):
        openrlhf.reward_func(["move 1"], ["the prompt"], [label])
    with pytest.raises(TrainerError, match="EMBOMATRIX_DATASET is not set"):
        openrlhf.reward_func(["the prompt move 1"], ["the prompt"], [label])


async def test_rows_contain_the_key_of_the_task_for_each_trainer(tmp_path, cluster):
    folder = write_kitchen_dataset(tmp_path)
    ids = [task.task.task_id for task in load_tasks(folder).train]
    assert [row["task_id"] for row in rows.prompt_rows(folder)] == ids
    assert [row["reward_model"]["ground_truth"] for row in rows.verl_rows(folder)] == ids
    labelled = openrlhf.rows(folder)
    assert [RewardLabel.parse(row["label"]).task_id for row in labelled] == ids
    assert "Task: " in labelled[0]["input"][1]["content"]
    assert await openrlhf.give_bundles(folder, cluster) == 1
    with pytest.raises(TrainerError, match="no split 'test': expected train or heldout"):
        rows.prompt_rows(folder, "test")
