"""Prompt variation: irrelevant properties change, and the oracle plan stays valid."""

import numpy as np
import pytest
from tests.fakes.symbolic_household import make_tasks, run_plan

from embomatrix.skills.prompt import Codec, plan_in_names, prompt_for
from embomatrix.trainer.cluster.gateway import parse_policy_text
from embomatrix.trainer.data.variation import Variation, drop_bystanders, used_rows, vary

TASKS = make_tasks(40, 0)
VARIATION = Variation(TASKS.kinds, rename=1.0)


def names_it(instruction, row):
    return f" {row.category.replace('_', ' ')} " in f" {instruction} "


def rng(seed=0):
    return np.random.default_rng(seed)


@pytest.mark.parametrize("task", TASKS.train, ids=lambda task: task.task.task_id)
def test_oracle_succeeds_in_every_variation(task):
    for seed in range(5):
        situation = drop_bystanders(task.situation, used_rows(task.oracle), 0.5, rng(seed))
        varied = vary(situation, VARIATION, rng(seed))
        plan = parse_policy_text(plan_in_names(task.oracle, varied), varied, Codec.NAMES)
        assert plan == task.oracle
        assert run_plan(task, plan)[0].success


@pytest.mark.parametrize("task", TASKS.train, ids=lambda task: task.task.task_id)
def test_unnamed_categories_are_renamed_within_their_kind(task):
    varied = vary(task.situation, VARIATION, rng())
    before = {row.index: row for row in task.situation.rows}
    names = {row.name for row in varied.rows}
    assert len(names) == len(varied.rows)
    for row in varied.rows:
        old = before[row.index]
        named = names_it(task.situation.instruction, old)
        assert named or row.category in TASKS.kinds[old.category]
        assert (row.states, row.fixed, row.relation) == (old.states, old.fixed, old.relation)
        assert not row.host or row.host in names
        assert names_it(varied.instruction, row) == named


def test_named_categories_can_get_any_name():
    kinds = {
        (old.category, row.category)
        for task in TASKS.train
        for old, row in zip(task.situation.rows, varied_in_table_order(task), strict=True)
        if names_it(task.situation.instruction, old)
    }
    assert any(new not in TASKS.kinds[old] for old, new in kinds)


def varied_in_table_order(task):
    return sorted(vary(task.situation, VARIATION, rng()).rows, key=lambda row: row.index)


def test_variations_differ_and_repeat_with_the_seed():
    situation = TASKS.train[0].situation
    texts = [prompt_for(vary(situation, VARIATION, rng(seed)), Codec.NAMES).user for seed in (1, 1, 2)]
    assert texts[0] == texts[1] != texts[2]


def test_without_renaming_unique_names_only_change_order():
    situation = TASKS.train[0].situation
    varied = vary(situation, Variation(TASKS.kinds, rename=0.0), rng(3))
    assert sorted(varied.rows, key=lambda row: row.index) == list(situation.rows)
    assert varied.instruction == situation.instruction


def test_needed_rows_and_their_hosts_are_kept():
    task = TASKS.train[0]
    needed = used_rows(task.oracle)
    for seed in range(20):
        varied = drop_bystanders(task.situation, needed, 1.0, rng(seed))
        kept = {row.index for row in varied.rows}
        hosts = {row.host for row in task.situation.rows if row.index in needed and row.host}
        assert needed <= kept
        assert hosts <= {row.name for row in varied.rows}
