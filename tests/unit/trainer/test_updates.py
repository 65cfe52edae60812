"""Several updates per batch, and plans that were cut off, in one GRPO step without a cluster."""

from collections import Counter
from concurrent.futures import Future
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from rich.console import Console
from tests.fakes.symbolic_household import make_tasks
from tests.unit.trainer.test_zero_variance import breakdown, weights

from embomatrix.trainer.cluster.gateway import PlanOutcome
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import GrpoSettings, LossKind, Overlong
from embomatrix.trainer.data.variation import Variation
from embomatrix.trainer.grpo.batch import minibatches_of
from embomatrix.trainer.grpo.sampling import Sampler
from embomatrix.trainer.grpo.update import StepPlan, Updater
from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
from embomatrix.trainer.learning.learner import Learner
from embomatrix.trainer.lifecycle.stopwatch import Stopwatch
from embomatrix.trainer.logging.display import LineDisplay
from embomatrix.trainer.policy.decoder import DecoderShape
from embomatrix.trainer.policy.prompts import PromptBuilder
from embomatrix.trainer.policy.tiny import TinyPolicy
from embomatrix.trainer.policy.vocabulary import build_vocabulary

TASKS = make_tasks(5, 0, objects=8)
WORDS = build_vocabulary(
    [task.situation for task in TASKS.train], [task.task.instruction for task in TASKS.train]
)
SHAPE = DecoderShape(len(WORDS), layers=1, width=16, heads=2, inner=32)
REWARDS = ((0.0, 1.0, 2.0), (1.0, 1.0, 1.0), (0.0, 0.0, 3.0), (2.0, 1.0, 0.0), (5.0, 0.0, 1.0))
PLANS = 15
FAILING_UPDATE = 3


class TaskRewards:
    """Gateway that answers at once with the rewards of each task's plans."""

    def submit(self, batch_id, step, groups, codec):
        return [self._answer(group) for group in groups]

    def _answer(self, group):
        rewards = REWARDS[TASKS.train.index(group.task)]
        future = Future()
        future.set_result(
            tuple(PlanOutcome(text, breakdown(r)) for text, r in zip(group.texts, rewards, strict=True))
        )
        return future


class RecordingLearner(Learner):
    """Learner that keeps its microbatches, and fails at the one with the number ``fails_at``."""

    def __init__(self, *arguments, fails_at=None):
        super().__init__(*arguments)
        self.learnt = []
        self.fails_at = fails_at

    def learn(self, microbatch):
        self.learnt.append(microbatch)
        if len(self.learnt) == self.fails_at:
            raise TrainerError("the process ended")
        return super().learn(microbatch)


class Trial:
    """One step on five tasks, of which the second has equal rewards."""

    def __init__(self, order=0, fails_at=None, **changes):
        values = {"group": 3, "max_new": 6, "tasks_per_step": 5, "chunk": 5, "kl_coef": 0.1}
        self.settings = GrpoSettings(**{**values, "zero_variance": "keep", "learning_rate": 0.01, **changes})
        self.policy = TinyPolicy(WORDS, SHAPE, seed=0)
        reference = TinyPolicy(WORDS, SHAPE, seed=1).frozen_copy()
        self.learner = RecordingLearner(self.policy, reference, self.settings, fails_at=fails_at)
        builder = PromptBuilder(self.policy, 16, Variation(TASKS.kinds, 0.0, 0.0))
        workers = DataParallelWorkers(self.learner)
        sampler = Sampler(workers, self.policy.codec, builder, TaskRewards(), self.settings)
        self.updater = Updater(self.policy, workers, sampler, self.settings, Stopwatch())
        self.plan = StepPlan(
            step=1,
            tasks=TASKS.train,
            upcoming=(),
            reserve=(),
            rng=np.random.default_rng,
            generator=torch.Generator().manual_seed(0),
            order=lambda step: np.random.default_rng((order, step)),
            seed_of=lambda step, task_id: 0,
            rate_factor=1.0,
        )

    def take(self):
        self.record, self.logs = self.updater.take_step(self.plan)
        return self

    @property
    def learnt(self):
        return self.learner.learnt


def plans_of(microbatch):
    """Count the plans of a microbatch by prompt, tokens and advantage."""
    rows = zip(microbatch.tokens, microbatch.mask, microbatch.advantages[:, 0].tolist(), strict=True)
    group = len(microbatch.tokens) // len(microbatch.prompts)
    return Counter(
        (microbatch.prompts[row // group], tuple(tokens[mask].tolist()), advantage)
        for row, (tokens, mask, advantage) in enumerate(rows)
    )


def passes_of(trial):
    """Counts of the plans of each pass."""
    passes = [Counter()]
    for microbatch in trial.learnt:
        if passes[-1].total() == PLANS:
            passes.append(Counter())
        passes[-1] += plans_of(microbatch)
    return passes


@given(st.integers(1, 5), st.integers(1, 5))
@hypothesis_settings(max_examples=10)
def test_every_pass_covers_every_plan_exactly_once(minibatches, chunk):
    trial = Trial(updates_per_batch=2, minibatches=minibatches, chunk=chunk).take()
    single = Trial(chunk=chunk).take()
    assert passes_of(trial) == passes_of(single) * 2
    assert passes_of(single)[0].total() == PLANS


@given(st.integers(0, 40), st.integers(1, 12), st.integers(0, 3))
def test_minibatches_divide_the_groups(count, minibatches, seed):
    groups = list(range(count))
    found = minibatches_of(groups, minibatches, np.random.default_rng(seed))
    assert sorted(group for minibatch in found for group in minibatch) == groups
    assert len(found) == min(count, minibatches)
    assert not found or max(map(len, found)) - min(map(len, found)) <= 1


@pytest.mark.parametrize(("updates", "minibatches"), [(1, 1), (3, 1), (1, 2), (2, 3)])
def test_updates_equal_a_plain_loop_to_the_bit(updates, minibatches):
    trial = Trial(updates_per_batch=updates, minibatches=minibatches).take()
    assert len(trial.learnt) == updates * minibatches
    plain = Trial()
    optimiser = torch.optim.AdamW(plain.policy.parameters(), lr=0.01, betas=(0.9, 0.95), weight_decay=0.0)
    norms = []
    for microbatch in trial.learnt:
        optimiser.zero_grad()
        plain.learner.learn(microbatch)
        norms.append(float(torch.nn.utils.clip_grad_norm_(plain.policy.parameters(), 1.0)))
        optimiser.step()
    assert torch.equal(weights(trial.policy), weights(plain.policy))
    assert trial.record.gradient_norm == pytest.approx(sum(norms) / len(norms))


def test_denominator_of_the_ratio_stays_the_sampling_policy():
    trial = Trial(updates_per_batch=3, minibatches=2).take()
    sampled = Trial().take().learnt[0]
    for microbatch in trial.learnt:
        found = microbatch.old_logprobs[microbatch.mask].tolist()
        assert set(found) <= set(sampled.old_logprobs[sampled.mask].tolist())
    assert trial.record.kl_to_old > 1e-6


@pytest.mark.parametrize("kind", LossKind)
def test_denominators_of_minibatches_add_up_to_the_step(kind):
    trial = Trial(loss=kind, minibatches=2, chunk=2).take()
    whole = Trial(loss=kind, chunk=2).take().learnt[0].totals
    parts = {}
    for microbatch in trial.learnt:
        parts.setdefault((microbatch.totals.plans, microbatch.totals.microbatches), []).append(microbatch)
    assert sum(plans for plans, _ in parts) == whole.plans
    if kind is LossKind.BNPO:  # each microbatch divides by its own tokens
        for each in trial.learnt:
            assert each.totals.tokens == each.mask.sum() * each.totals.microbatches
    else:
        assert sum(group[0].totals.tokens for group in parts.values()) == whole.tokens


def test_order_of_minibatches_follows_from_the_seed():
    one, same, other = (Trial(order=order, minibatches=4).take() for order in (0, 0, 1))
    assert torch.equal(weights(one.policy), weights(same.policy))
    assert not torch.equal(weights(one.policy), weights(other.policy))


def test_minibatches_without_a_signal_take_no_update():
    trial = Trial(minibatches=5, zero_variance="skip").take()
    assert len(trial.learnt) == 4
    assert trial.record.zero_variance_groups == pytest.approx(0.2)


def test_error_between_two_updates_is_visible():
    trial = Trial(updates_per_batch=4, fails_at=FAILING_UPDATE)
    with pytest.raises(TrainerError, match="the process ended"):
        trial.take()
    assert trial.updater.is_between_updates
    early = Trial(updates_per_batch=4, fails_at=1)
    with pytest.raises(TrainerError, match="the process ended"):
        early.take()
    assert not early.updater.is_between_updates
    assert not Trial(updates_per_batch=4).take().updater.is_between_updates


def test_cut_off_plans_are_masked_and_still_count_in_the_mean_of_their_group():
    kept, masked = (Trial(max_new=40, overlong=each).take() for each in Overlong)
    assert 0 < kept.record.cut_off < 1
    assert kept.record.cut_off == masked.record.cut_off
    before, after = kept.learnt[0], masked.learnt[0]
    lengths = before.mask.sum(dim=1)
    ended = after.mask.any(dim=1)
    assert torch.equal(after.mask, before.mask & ended[:, None])
    assert kept.record.cut_off == pytest.approx(1 - ended.float().mean().item())
    assert set(lengths[~ended].tolist()) == {40}
    assert torch.equal(before.advantages, after.advantages)
    assert after.totals.tokens == after.mask.sum()
    assert after.totals.plans == PLANS
    assert not torch.equal(weights(kept.policy), weights(masked.policy))


def test_step_with_cut_off_plans_only_learns_nothing_from_masked_ones():
    trial = Trial(max_new=1, overlong="mask", updates_per_batch=2)
    before = weights(trial.policy)
    trial.take()
    assert trial.record.cut_off == 1
    assert trial.record.entropy is None
    assert trial.learnt == []
    assert torch.equal(before, weights(trial.policy))


def test_progress_line_names_cut_off_plans_only_if_there_are_any():
    record = Trial(max_new=1).take().record
    lines = []
    for cut_off in (0.0, 0.25):
        seen = StringIO()
        LineDisplay(Console(file=seen, width=400)).stepped(replace(record, cut_off=cut_off), 0.5, 10.0)
        lines.append(seen.getvalue())
    assert "cut-off" not in lines[0]
    assert "cut-off plans 25.0%" in lines[1]
