"""GRPO steps: overlap, replacement of zero-variance groups, weights of reward tiers."""

import math

import pytest
import torch
from tests.fakes.symbolic_household import SymbolicCluster, make_tasks
from tests.integration.trainer.test_loop import run, weights

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import Overlap
from embomatrix.trainer.learning.objective import LossKind
from embomatrix.trainer.logging.recorder import read_metrics

TASKS = make_tasks(10, 0, objects=10)


def trained(out, **changes):
    return run(out, changes.pop("cluster", SymbolicCluster(TASKS)), TASKS, **{"grpo__steps": 4, **changes})


def test_streaming_is_bit_identical_to_waiting(tmp_path):
    _, waited = trained(tmp_path / "none", grpo__overlap=Overlap.NONE, grpo__chunk=1)
    _, streamed = trained(tmp_path / "stream", grpo__chunk=1, cluster=SymbolicCluster(TASKS, delay_s=0.01))
    assert torch.equal(weights(waited), weights(streamed))


def test_step_ahead_is_sampled_from_weights_one_step_old(tmp_path):
    summary, policy = trained(tmp_path / "ahead", grpo__overlap=Overlap.AHEAD, grpo__learning_rate=1e-2)
    _, streamed = trained(tmp_path / "stream", grpo__learning_rate=1e-2)
    rows = read_metrics(tmp_path / "ahead")
    assert summary.outcome.steps == 4
    assert not torch.equal(weights(policy), weights(streamed))
    assert rows[0]["kl_to_old"] == pytest.approx(0, abs=1e-6)
    assert max(row["kl_to_old"] for row in rows[1:]) > 1e-6


def test_truncated_importance_sampling_changes_updates_on_old_plans_only(tmp_path):
    changes = {"grpo__overlap": Overlap.AHEAD, "grpo__learning_rate": 3e-2}
    _, plain = trained(tmp_path / "plain", **changes)
    _, truncated = trained(tmp_path / "truncated", grpo__truncate_ratio=1.0, **changes)
    rows, others = read_metrics(tmp_path / "truncated"), read_metrics(tmp_path / "plain")
    assert rows[0]["gradient_norm"] == others[0]["gradient_norm"]
    assert max(row["kl_to_old"] for row in rows[1:]) > 1e-6
    assert max(row["clipped"] for row in others[1:]) > 0
    assert [row["clipped"] for row in rows] == [0.0] * 4
    assert not torch.equal(weights(plain), weights(truncated))


def test_zero_variance_groups_are_replaced_from_the_reserve(tmp_path):
    cluster = SymbolicCluster(TASKS)
    trained(tmp_path / "a", cluster=cluster, grpo__reserve=6, imitation__steps=0)
    without = trained(tmp_path / "b", imitation__steps=0)[0]
    rows = read_metrics(tmp_path / "a")
    assert all(4 <= row["groups"] <= 10 for row in rows)
    assert any(row["groups"] > 4 for row in rows)
    assert sum(row["rollouts"] for row in rows) > without.outcome.rollouts


def test_step_without_a_signal_has_no_token_means(tmp_path):
    before = trained(tmp_path / "none", grpo__steps=0)[1]
    _, policy = trained(tmp_path / "all", grpo__temperature=1e-4)  # all plans of a group are equal
    rows = read_metrics(tmp_path / "all")
    assert [row["zero_variance_groups"] for row in rows] == [1.0] * 4
    assert [row[name] for row in rows for name in ("entropy", "kl", "kl_to_old", "clipped")] == [None] * 16
    assert torch.equal(weights(before), weights(policy))


@pytest.mark.parametrize("kind", [LossKind.DAPO, LossKind.BNPO, LossKind.GRPO])
def test_unused_reserve_changes_nothing(tmp_path, kind):
    changes = {
        "grpo__loss": kind,
        "grpo__tasks_per_step": 2,
        "grpo__chunk": 1,
        "grpo__steps": 2,
        "grpo__temperature": 1.5,
        "grpo__group": 10,  # this many plans of a task hardly ever earn equal rewards
        "seed": 3,
    }
    _, plain = trained(tmp_path / "plain", **changes)
    _, reserved = trained(tmp_path / "reserved", grpo__reserve=1, **changes)
    assert [row["zero_variance_groups"] for row in read_metrics(tmp_path / "plain")] == [0, 0]
    assert torch.equal(weights(plain), weights(reserved))


def test_update_without_the_relevance_tier_differs_but_the_log_keeps_it(tmp_path):
    _, whole = trained(tmp_path / "whole")
    _, without = trained(tmp_path / "without", grpo__relevance=0.0)
    assert not torch.equal(weights(whole), weights(without))
    row = read_metrics(tmp_path / "without")[0]
    tiers = row["reward_format"] + row["reward_relevance"] + row["reward_goal"]
    assert row["reward"] == pytest.approx(tiers)
    assert row["reward_relevance"] > 0


def test_repeated_non_finite_gradients_end_the_run_without_an_update(tmp_path):
    with pytest.raises(TrainerError, match=r"not finite .* lower grpo.learning_rate"):
        trained(tmp_path, grpo__kl_coef=math.inf, grpo__steps=30)
