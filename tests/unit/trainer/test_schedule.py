"""Task schedule: known arbitrarily far ahead, with and without a curriculum."""

import dataclasses
from collections import Counter
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st
from tests.fakes.symbolic_household import make_tasks

from embomatrix.trainer.data.tasks import SCENES_AT_ONCE, Curriculum, Schedule

TASKS = make_tasks(12, 0, objects=10).train
SIX = make_tasks(6, 2).train


def ids(tasks):
    return [task.task.task_id for task in tasks]


@given(st.integers(0, 60), st.integers(0, 20), st.integers(0, 30))
def test_peek_equals_take_with_a_curriculum(cursor, count, curriculum_tasks):
    curriculum = Curriculum(curriculum_tasks, 0.25)
    schedule = Schedule(TASKS, seed=3, cursor=cursor, curriculum=curriculum)
    ahead = ids(schedule.peek(count, skip=5))
    schedule.take(5)
    assert ids(schedule.take(count)) == ahead
    again = Schedule(TASKS, seed=3, cursor=schedule.cursor, curriculum=curriculum)
    assert ids(again.peek(7)) == ids(schedule.peek(7))


def test_epoch_contains_every_task_once():
    assert Counter(ids(Schedule(TASKS, seed=1).take(len(TASKS)))) == Counter(ids(TASKS))


def test_streams_of_one_seed_differ():
    assert ids(Schedule(TASKS, seed=1).peek(12)) != ids(Schedule(TASKS, seed=1, stream=1).peek(12))


def test_curriculum_starts_with_the_shortest_plans_and_ends_with_all():
    schedule = Schedule(TASKS, seed=1, curriculum=Curriculum(400, 0.25))
    by_length = sorted(TASKS, key=lambda task: (len(task.oracle), task.task.task_id))
    first, last = set(ids(schedule.peek(40))), set(ids(schedule.peek(200, skip=300)))
    assert first <= set(ids(by_length[:4]))
    assert last == set(ids(TASKS))


def test_peek_equals_the_next_take():
    schedule = Schedule(SIX, seed=3)
    schedule.take(4)
    ahead = schedule.peek(5, skip=2)
    assert schedule.take(7)[2:] == ahead


def test_every_epoch_is_a_new_permutation():
    schedule = Schedule(SIX, seed=3)
    first, second = schedule.take(6), schedule.take(6)
    assert {task.task.task_id for task in first} == {task.task.task_id for task in second}
    assert first != second


def test_schedule_continues_from_its_cursor():
    whole = Schedule(SIX, seed=3)
    whole.take(4)
    assert Schedule(SIX, seed=3, cursor=4).take(9) == whole.take(9)


def test_tasks_of_few_scenes_are_shuffled_together():
    scenes = 3 * SCENES_AT_ONCE
    tasks = [
        dataclasses.replace(task, bundle_digest=f"{number % scenes}")
        for number, task in enumerate(make_tasks(2 * scenes, 0, objects=10).train)
    ]
    schedule = Schedule(tasks, seed=5)
    for _ in range(2):
        taken = schedule.take(len(tasks))
        assert Counter(ids(taken)) == Counter(ids(tasks))
        windows = [
            {task.bundle_digest for task in taken[begin : begin + 2 * SCENES_AT_ONCE]}
            for begin in range(0, len(tasks), 2 * SCENES_AT_ONCE)
        ]
        assert [len(window) for window in windows] == [SCENES_AT_ONCE] * 3
        neighbours = [first.bundle_digest == second.bundle_digest for first, second in pairwise(taken)]
        assert sum(neighbours) < len(tasks) // 8
