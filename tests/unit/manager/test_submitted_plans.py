"""Submissions that no worker could execute are refused by the manager, which knows the tasks of its bundles."""

import pytest
from tests.fakes.scenes import kitchen_scene, kitchen_tasks
from tests.fuzz.worst_bundle import bundle_with

from embomatrix.manager.runtime.bundles import TASKS_KEPT, BundleStore
from embomatrix.manager.runtime.runs import check_plans
from embomatrix.rpc.status import InvalidRequestError
from embomatrix.rpc.wire.values import Batch, Rollout
from embomatrix.skills.syntax import PROFILES, Skill, SkillCall
from embomatrix.world.bundle import Bundle, bundle_digest, encode_bundle

SCENE = kitchen_scene()
TASKS = {task.task_id: task for task in kitchen_tasks(SCENE)}
DATA = encode_bundle(Bundle(SCENE, TASKS))
DIGEST = bundle_digest(DATA)
TASK = next(iter(TASKS.values()))
MOVE = (SkillCall(Skill.MOVE, object_index=0),)
OUTSIDE = next(skill for skill in Skill if skill not in PROFILES[TASK.profile])


@pytest.fixture
async def store(tmp_path):
    async def chunks():
        yield DATA

    made = BundleStore(tmp_path, total_bytes=10**8)
    await made.put(DIGEST, chunks())
    return made


def batch(task_id, plan, digest=DIGEST):
    return Batch("r1", "b1", 1, (Rollout("x1", "g", digest, task_id, plan, 0),))


async def test_a_bundle_tells_the_tasks_and_profiles_that_it_was_encoded_with(store):
    expected = {task_id: task.profile for task_id, task in TASKS.items()}
    assert await store.profiles([DIGEST]) == {DIGEST: expected}


async def test_tasks_of_the_oldest_bundles_are_forgotten_for_newer_ones(store, tmp_path):
    names = [f"{number:064x}" for number in range(120)]
    bundles = bundle_with({"tasks": 900})
    for name in names:
        (tmp_path / f"{name}.bundle").write_bytes(bundles)
    for name in names:
        assert len((await store.profiles([f"sha256:{name}"]))[f"sha256:{name}"]) == 901
    assert sum(map(len, store._profiles.values())) <= TASKS_KEPT
    assert f"sha256:{names[-1]}" in store._profiles


@pytest.mark.parametrize(
    ("task_id", "plan", "words"),
    [
        ("no-such-task", MOVE, "has no task 'no-such-task'"),
        (TASK.task_id, (), "has an empty plan"),
        (TASK.task_id, (SkillCall(OUTSIDE),), f"has no skill {OUTSIDE}"),
    ],
)
async def test_rollout_that_no_worker_could_execute_is_refused(store, task_id, plan, words):
    with pytest.raises(InvalidRequestError, match=words):
        check_plans(batch(task_id, plan), await store.profiles([DIGEST]))


async def test_a_plan_of_a_known_task_passes_and_an_absent_bundle_is_left_to_its_own_check(store):
    check_plans(batch(TASK.task_id, MOVE), await store.profiles([DIGEST]))
    absent = f"sha256:{'0' * 64}"
    check_plans(batch("t", MOVE, absent), await store.profiles([absent]))
