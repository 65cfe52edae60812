"""Episodes on a cluster of real processes with the real engine equal episodes in this process, whatever dies in between."""

import asyncio
import contextlib
import random
import re
from pathlib import Path

import pytest
from tests.fakes.plans import plan_of
from tests.fakes.real_cluster import RealCluster, connected
from tests.fakes.scenes import kitchen_scene, kitchen_tasks

from embomatrix.envs import EpisodeEnd, make
from embomatrix.envs.turns import LocalEpisodes
from embomatrix.reward.turns import Turn
from embomatrix.rpc.episodes import Episodes
from embomatrix.rpc.status import InvalidRequestError
from embomatrix.rpc.wire.values import Rollout
from embomatrix.skills.syntax import Skill, SkillCall
from embomatrix.skills.turns import Advice, EpisodePrefix, PrefixMismatchError
from embomatrix.world.bundle import Bundle, decode_bundle, encode_bundle
from embomatrix.world.inflation import bundle_digest

pytestmark = pytest.mark.timeout(180)

SCENE = kitchen_scene()
TASKS = {task.task_id: task for task in kitchen_tasks(SCENE)}
DATA = encode_bundle(Bundle(SCENE, TASKS))
DIGEST = bundle_digest(DATA)
TASK = next(iter(TASKS.values()))
WORDS = (
    "move apple_1; pick_up apple_1; pick_up mug_1; move fridge_1; pick_up fridge_1; open fridge_1; place fridge_1 inside; "
    "close fridge_1; move countertop_1; place countertop_1 ontop; move mug_1; open microwave_1; move microwave_1; turn 0.5"
)
CALLS = plan_of(TASK, WORDS)


@contextlib.asynccontextmanager
async def real_cluster(folder, *names):
    with RealCluster(folder) as cluster:
        cluster.start_manager()
        for name in names:
            cluster.start_real_worker(name)
        async with cluster.client() as client:
            await connected(client, *names)
            await client.open_run("episodes", "r1")
            await client.put_bundles({DIGEST: DATA})
            async with Episodes(client, "r1") as episodes:
                yield cluster, client, episodes


def local_episodes():
    return LocalEpisodes(lambda digest: decode_bundle(DATA, digest=digest))


async def played(episodes, seed, calls=20, *, asks=True):
    """Play an episode of random parts of the script, of which many calls fail, in turns of one to three calls.

    Every second one has sight, and every third one asks for advice after its turns.
    """
    draw = random.Random(seed)
    episode = episodes.begin(DIGEST, TASK.task_id, seed % 3, sight=seed % 2 == 1)
    turns = [await episode.look()] if episode.start.sight else []
    while len(episode.calls) < calls:
        at = draw.randrange(len(CALLS))
        turns.append(await episode.act(CALLS[at : at + draw.randint(1, 3)]))
        if asks and seed % 3 == 0:
            turns.append(await episode.advise())
    return turns, episode.calls, episode.prefix


async def test_episodes_of_a_cluster_equal_local_ones(tmp_path):
    async with real_cluster(tmp_path, "w1") as (_, _, episodes):
        far = await asyncio.gather(*(played(episodes, seed) for seed in range(12)))
    with local_episodes() as local:
        near = [await played(local, seed) for seed in range(12)]
    assert far == near
    assert sum(len(prefix.failed) for _, _, prefix in near) > 40
    told = [turn for turns, _, _ in near for turn in turns]
    assert any(turn.observation.held for turn in told if isinstance(turn, Turn))
    advised = [turn for turn in told if isinstance(turn, Advice)]
    assert any(advice.plan for advice in advised)


async def test_asking_for_advice_changes_nothing_of_what_happens():
    with local_episodes() as local:
        for seed in (0, 3, 6):
            asking, silent = await played(local, seed), await played(local, seed, asks=False)
            assert [turn for turn in asking[0] if isinstance(turn, Turn)] == silent[0]
            assert asking[1:] == silent[1:]


async def test_worker_killed_between_two_turns_changes_nothing(tmp_path):
    async with real_cluster(tmp_path, "w1") as (cluster, client, episodes):
        episode = episodes.begin(DIGEST, TASK.task_id, 1)
        turns = []
        for number, call in enumerate(CALLS):
            if number == 6:
                cluster.signal("w1")
                cluster.start_real_worker("w2")
                await connected(client, "w2")
            turns.append(await episode.act([call]))
    with local_episodes() as local:
        same = local.begin(DIGEST, TASK.task_id, 1)
        assert turns == [await same.act([call]) for call in CALLS]
        assert episode.prefix == same.prefix


async def test_bad_prefixes_are_named_and_cost_nobody_else_a_turn(tmp_path):
    async with real_cluster(tmp_path, "w1") as (_, client, episodes):
        episode = episodes.begin(DIGEST, TASK.task_id)
        for call in CALLS[:4]:
            await episode.act([call])
        assert episode.prefix.failed == (2,)
        sound = episode.prefix
        wrong = {
            r"the digest after 4 calls .*expected 'sha256:0', found 'sha256:": EpisodePrefix(
                4, (2,), "sha256:0"
            ),
            r"call 1 of the prefix, pick_up: expected to fail .* succeeds": EpisodePrefix(4, (1, 2)),
            r"call 2 of the prefix, pick_up: expected to succeed .* it fails \(": EpisodePrefix(4, ()),
        }
        for words, prefix in wrong.items():
            liar, honest = (
                episode_at(episodes, episode.calls, prefix),
                episode_at(episodes, episode.calls, sound),
            )
            found = await asyncio.gather(liar.act([CALLS[4]]), honest.act([CALLS[4]]), return_exceptions=True)
            with pytest.raises(PrefixMismatchError, match=words):
                raise found[0]
            assert len(found[1].steps) == 1
        await check_refused(client, episodes)


async def check_refused(client, episodes):
    with pytest.raises(InvalidRequestError, match="has no task 'absent'"):
        await episodes.begin(DIGEST, "absent").act([CALLS[0]])
    long = Rollout("t", "t", DIGEST, TASK.task_id, CALLS[:1] * 65, 0, prefix=EpisodePrefix(64))
    with pytest.raises(InvalidRequestError, match="found 65 elements: expected at most 64"):
        await client.step("r1", [long])
    with pytest.raises(InvalidRequestError, match="has no skill"):
        await episodes.begin(DIGEST, TASK.task_id).act(
            [SkillCall(Skill.SOAK, object_index=1, source_index=2)]
        )


def episode_at(episodes, calls, prefix):
    """Return an episode of the same task that believes in this prefix."""
    episode = episodes.begin(DIGEST, TASK.task_id)
    episode.calls, episode.prefix = calls, prefix
    return episode


async def test_prefix_of_another_task_is_named(tmp_path):
    *_, other = TASKS.values()
    async with real_cluster(tmp_path, "w1") as (_, _, episodes):
        episode = episodes.begin(DIGEST, TASK.task_id)
        for call in CALLS[:2]:
            await episode.act([call])
        strange = episodes.begin(DIGEST, other.task_id)
        strange.calls, strange.prefix = episode.calls, episode.prefix
        with pytest.raises(PrefixMismatchError, match="the digest after 2 calls of the prefix"):
            await strange.act([CALLS[3]])


async def test_local_episode_checks_its_prefix_too():
    with local_episodes() as local:
        episode = local.begin(DIGEST, TASK.task_id)
        await episode.act([CALLS[0]])
        episode.prefix = EpisodePrefix(1, (), "sha256:0")
        with pytest.raises(PrefixMismatchError, match="the digest after 1 calls"):
            await episode.act([CALLS[1]])


PAGE = (Path(__file__).parents[2] / "docs" / "episodes.md").read_text(encoding="utf-8")


def names_of_the_page():
    """Execute the blocks of Python and return what they define."""
    names = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(compile(block, "docs/episodes.md", "exec"), names)
    return names


def test_first_example_of_the_page_plays_the_printed_episode():
    [printed] = re.findall(r"```text\n(Rooms: .*?)```", PAGE, re.DOTALL)
    answers = re.findall(r"^> (.+)$", printed, re.MULTILINE)
    [(task_id, seed)] = re.findall(r"the shipped task `([^`]+)` .* with seed (\d+)", PAGE)
    with make("starter", visibility="seen") as environment:
        said = [environment.reset(task_id, seed=int(seed)).user]
        observations = [environment.step(answer) for answer in answers]
    said += [f"\n> {answer}\n{each.text}" for answer, each in zip(answers, observations, strict=True)]
    assert "\n".join(said) == printed.rstrip("\n")
    assert observations[-1].end is EpisodeEnd.DONE
    assert observations[-1].reward.tiers.success
    end, reward, conversation = names_of_the_page()["play"](lambda conversation: "done")
    assert (end, reward, len(conversation)) == (EpisodeEnd.DONE, -1.0, 4)


def test_example_of_advice_is_a_plan_that_reaches_the_goal():
    [(task_id, seed)] = re.findall(r"the shipped task `([^`]+)` .* with seed (\d+)", PAGE)
    advised = names_of_the_page()["advised_after"]
    before = ["go_to_room bedroom_0", "move 3", "pick_up 3"]
    calls = advised(before, task_id).splitlines()
    assert 0 < len(calls) < len(advised([], task_id).splitlines())
    with make("starter") as environment:
        environment.reset(task_id, seed=int(seed))
        ends = [environment.step(answer) for answer in (*before, *calls)]
    assert ends[-1].reward.tiers.success
    assert advised([*before, *calls], task_id) == ""


def test_example_of_the_readme_tells_of_the_kitchen(capsys):
    readme = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    block, _ = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)  # the other one is for TRL
    exec(compile(block, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "Task: " in printed
    assert "go_to_room kitchen_0: " in printed


async def test_examples_of_the_page_run_and_agree(tmp_path):
    names = names_of_the_page()
    async with real_cluster(tmp_path, "w1") as (cluster, _, _):
        far = await names["play_on_a_cluster"](cluster.address, DATA, TASK.task_id)
    near = await names["play_here"](DATA, TASK.task_id)
    assert far == near
    assert len(far) == 3
