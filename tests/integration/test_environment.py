"""The front door to episodes: the same answers have the same observations in this process and on a cluster."""

import asyncio
import dataclasses
from pathlib import Path

import pytest
from tests.fakes.real_cluster import RealCluster, connected
from tests.fakes.scenes import kitchen_scene, kitchen_tasks

from embomatrix.envs import EpisodeEnd, EpisodeRules, Visibility, make, simulation
from embomatrix.reward.settings import RewardSettings
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.status import ClusterError
from embomatrix.skills.episode_text import FORMAT
from embomatrix.world.bundle import Bundle, encode_bundle
from embomatrix.world.dataset import Dataset, DatasetError, TaskRecord, write_dataset
from embomatrix.world.inflation import bundle_digest

pytestmark = pytest.mark.timeout(180)
ANSWERS = (
    "open fridge",
    "go_to_room living_room_0",
    "move 4",
    "I look around.",
    "open 4\nmove 1",
    "pick_up 2",
    "open 4",
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dataset")
    scene = kitchen_scene()
    tasks = {task.task_id: task for task in kitchen_tasks(scene)}
    data = encode_bundle(Bundle(scene, tasks))
    digest = bundle_digest(data)
    records = [
        TaskRecord(task, digest, "heldout", ({"action": "open", "object_index": 1},), ("kitchen_0",), "s")
        for task in tasks.values()
    ]
    write_dataset(folder, records, {digest: data})
    return folder


async def ready(cluster):
    async with cluster.client() as client:
        await connected(client, "w1")


def played(environment):
    prompt = environment.reset(environment.task_ids[0], seed=3)
    return prompt, [environment.step(text) for text in ANSWERS]


@pytest.mark.parametrize("visibility", Visibility)
def test_cluster_and_process_tell_the_same(dataset, tmp_path, visibility):
    with make(dataset, visibility=visibility) as environment:
        near = played(environment)
    with RealCluster(tmp_path) as cluster:
        cluster.start_manager()
        cluster.start_real_worker("w1")
        asyncio.run(ready(cluster))
        with make(dataset, visibility=visibility, manager=cluster.address) as environment:
            far = played(environment)
    assert far == near


def test_environment_outlives_a_run_that_the_manager_closed_because_it_was_idle(
    dataset, tmp_path, monkeypatch
):
    async def close_runs():
        async with AdminClient(cluster.address) as client:
            for run in await client.list_runs():
                await client.close_run(run.run_id)

    with RealCluster(tmp_path) as cluster:
        cluster.start_manager()
        cluster.start_real_worker("w1")
        asyncio.run(ready(cluster))
        with make(dataset, manager=cluster.address) as environment:
            first = played(environment)
            asyncio.run(close_runs())
            environment.reset(environment.task_ids[0], seed=3)
            with pytest.raises(ClusterError):  # an operator closed a run that is in use
                environment.step("move 1")
            monkeypatch.setattr(simulation, "QUIET_S", -1.0)
            assert played(environment) == first


def test_closed_container_shows_its_contents_once_it_is_open(dataset):
    with make(dataset, visibility="seen") as environment:
        task = environment.records[0].task
        fridge, leg = (task.table.index(name) for name in ("fridge_1", "chicken_leg_1"))
        prompt = environment.reset(task.task_id, seed=0)
        assert f"chicken leg {leg}" not in prompt.user
        environment.step(f"move {fridge}")
        opened = environment.step(f"open {fridge}")
        assert f"New: chicken leg {leg}" in opened.text
        assert environment.step(f"close {fridge}").end is None
        assert environment.step("done").end is EpisodeEnd.DONE


def test_coefficients_of_the_reward_may_be_chosen(dataset):
    with make(dataset, reward=RewardSettings(unparsable=-3, format=2)) as environment:
        environment.reset(environment.task_ids[0], seed=0)
        assert environment.step("hm").reward.total == -3
        assert environment.step("turn 1").reward.total == 2


def test_many_episodes_are_played_side_by_side(dataset):
    with make(dataset, rules=EpisodeRules(calls=2)) as environment:
        tasks = [(task_id, seed) for task_id in environment.task_ids[:2] for seed in range(3)]
        episodes = environment.begin(tasks)
        assert [episode.task_id for episode in episodes] == [task_id for task_id, _ in tasks]
        for end in (None, EpisodeEnd.CALLS):
            observations = environment.answer(episodes, ["move 1"] * len(episodes))
            assert {observation.end for observation in observations} == {end}
        with pytest.raises(RuntimeError, match="the episode is over"):
            environment.answer(episodes[:1], ["move 1"])


def test_visibility_and_rules_go_together(dataset):
    rules = EpisodeRules(calls=5)
    with make(dataset, visibility="seen", rules=rules) as environment:
        assert (environment.rules.visibility, environment.rules.calls) == (Visibility.SEEN, 5)
    with make(dataset, rules=EpisodeRules(Visibility.SEEN)) as environment:
        assert environment.rules.visibility is Visibility.SEEN


def test_misuse_is_named(dataset):
    with make(dataset) as environment:
        with pytest.raises(RuntimeError, match="call reset first"):
            environment.step("move 1")
        with pytest.raises(ValueError, match="found 2 answers for 1 episodes"):
            environment.answer(environment.begin([(environment.task_ids[0], 0)]), ["move 1", "move 2"])
        environment.reset()
        with pytest.raises(ValueError, match="an answer is NoneType: expected a text"):
            environment.step(None)
        with pytest.raises(DatasetError, match="there is no task 'absent'"):
            environment.reset("absent")
    with pytest.raises(DatasetError, match="no task of the split 'train'"):
        make(dataset, split="train")
    with pytest.raises(ValueError, match="visibility is 'some': expected one of full, seen"):
        make(dataset, visibility="some")


def test_tasks_of_another_split_are_not_played(dataset, tmp_path):
    records = [
        dataclasses.replace(record, split="train" if number == 0 else "heldout")
        for number, record in enumerate(Dataset.load(dataset).records)
    ]
    write_dataset(
        tmp_path,
        records,
        {records[0].bundle_digest: Dataset.load(dataset).bundle_bytes(records[0].bundle_digest)},
    )
    with make(tmp_path, split="train") as environment:
        held_out = records[1].task.task_id
        with pytest.raises(
            DatasetError, match=f"{held_out} is of the split heldout, and this environment plays train"
        ):
            environment.reset(held_out)


def test_observations_of_others_are_kept_if_a_turn_fails(dataset):
    with make(dataset) as environment:
        first, second = environment.begin([(environment.task_ids[0], seed) for seed in (0, 1)])
        first.player.stop()
        with pytest.raises(RuntimeError, match="the episode is over"):
            environment.answer((first, second), ["move 1", "move 1"])
        assert second.player.observation.text.startswith("move 1: stands at ")
        assert first.player.observation is None


def test_format_of_the_texts_is_the_documented_one():
    page = (Path(__file__).parents[2] / "docs" / "episodes.md").read_text()
    assert f"at present format {FORMAT} " in page


def test_a_word_level_policy_is_told_the_rooms_that_it_may_go_to(dataset):
    with make(dataset, visibility="seen", codec="names") as environment:
        rooms = environment.reset().user.splitlines()[0].split()
        assert rooms[0] == "rooms"
        assert all(environment.step(f"go_to_room {room}").steps[0].ok for room in rooms[1:])
