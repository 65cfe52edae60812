"""Zero-variance groups in one GRPO step, without a cluster."""

from concurrent.futures import Future

import numpy as np
import pytest
import torch
from tests.fakes.symbolic_household import make_tasks

from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.trainer.cluster.gateway import PlanOutcome
from embomatrix.trainer.config.settings import LANGUAGE_MODEL_DEFAULTS, GrpoSettings, OnLost, read_settings
from embomatrix.trainer.data.variation import Variation
from embomatrix.trainer.grpo.sampling import Sampler
from embomatrix.trainer.grpo.update import StepPlan, Updater
from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
from embomatrix.trainer.learning.learner import Learner
from embomatrix.trainer.lifecycle.stopwatch import Stopwatch
from embomatrix.trainer.policy.decoder import DecoderShape
from embomatrix.trainer.policy.prompts import PromptBuilder
from embomatrix.trainer.policy.tiny import TinyPolicy
from embomatrix.trainer.policy.vocabulary import build_vocabulary

TASKS = make_tasks(2, 0, objects=8)
WORDS = build_vocabulary(
    [task.situation for task in TASKS.train], [task.task.instruction for task in TASKS.train]
)
SHAPE = DecoderShape(len(WORDS), layers=1, width=16, heads=2, inner=32)


class RewardingGateway:
    """Gateway that answers at once with these rewards of each task's plans. None: the rollout was lost."""

    def __init__(self, *rewards):
        self.rewards = rewards

    def submit(self, batch_id, step, groups, codec):
        futures = []
        for group, rewards in zip(groups, self.rewards, strict=True):
            future = Future()
            future.set_result(
                tuple(
                    PlanOutcome(text, None if reward is None else breakdown(reward))
                    for text, reward in zip(group.texts, rewards, strict=True)
                )
            )
            futures.append(future)
        return futures


def breakdown(reward):
    return RewardBreakdown(format=reward, relevance=0.0, goal=0.0, atoms=(), success=False)


def step(*rewards, **changes):
    """Take one step from a policy that is far from its reference. Return its record and the change of the weights."""
    settings = GrpoSettings(**{"group": 3, "max_new": 6, "zero_variance": "keep", **changes})
    policy = TinyPolicy(WORDS, SHAPE, seed=0)
    reference = TinyPolicy(WORDS, SHAPE, seed=1).frozen_copy()
    workers = DataParallelWorkers(Learner(policy, reference, settings))
    builder = PromptBuilder(policy, 16, Variation(TASKS.kinds, 0.0, 0.0))
    sampler = Sampler(workers, policy.codec, builder, RewardingGateway(*rewards), settings)
    updater = Updater(policy, workers, sampler, settings, Stopwatch())
    before = weights(policy)
    record, _ = updater.take_step(
        StepPlan(
            step=1,
            tasks=TASKS.train,
            upcoming=(),
            reserve=(),
            rng=np.random.default_rng,
            generator=torch.Generator().manual_seed(0),
            order=np.random.default_rng,
            seed_of=lambda step, task_id: 0,
            rate_factor=1.0,
        )
    )
    return record, weights(policy) - before


def weights(policy):
    return torch.cat([parameter.detach().flatten() for parameter in policy.parameters()]).clone()


EQUAL, DIFFERENT, LOST = (1.0, 1.0, 1.0), (0.0, 1.0, 2.0), (None, None, None)


@pytest.mark.parametrize("coefficients", [(0.5, 0.0), (0.0, 0.5)])
def test_kept_zero_variance_groups_learn_their_kl_and_entropy_terms(coefficients):
    kl_coef, entropy_coef = coefficients
    record, change = step(EQUAL, EQUAL, kl_coef=kl_coef, entropy_coef=entropy_coef)
    assert record.zero_variance_groups == 1
    assert record.gradient_norm > 0
    assert record.entropy > 0
    assert change.abs().max() > 0


def test_kept_zero_variance_groups_count_beside_others():
    kept, change = step(EQUAL, DIFFERENT, kl_coef=0.5)
    skipped, change_without = step(EQUAL, DIFFERENT, kl_coef=0.5, zero_variance="skip")
    assert kept.zero_variance_groups == skipped.zero_variance_groups == 0.5
    assert kept.kl != skipped.kl
    assert not torch.equal(change, change_without)


@pytest.mark.parametrize(
    "changes",
    [
        {"kl_coef": 0.0},  # their gradient is 0
        {"kl_coef": 0.5, "zero_variance": "skip"},
        {"kl_coef": 0.5, "reserve": 1},  # other tasks would replace them
    ],
)
def test_zero_variance_groups_are_skipped_otherwise(changes):
    record, change = step(EQUAL, EQUAL, **changes)
    assert (record.gradient_norm, record.kl, record.entropy) == (0.0, None, None)
    assert change.abs().max() == 0


@pytest.mark.parametrize("on_lost", OnLost)
def test_groups_without_rollouts_are_always_skipped(on_lost):
    record, change = step(LOST, LOST, kl_coef=0.5, on_lost=on_lost)
    assert record.kl is None
    assert change.abs().max() == 0


def test_language_models_keep_zero_variance_groups_by_default_and_the_word_level_policy_skips_them():
    assert not read_settings(None, {}).grpo.keeps_zero_variance_groups
    assert read_settings(None, {}, LANGUAGE_MODEL_DEFAULTS).grpo.keeps_zero_variance_groups
