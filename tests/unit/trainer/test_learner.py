"""Learner: gradient of one microbatch."""

import torch
from tests.fakes.symbolic_household import make_tasks

from embomatrix.skills.prompt import Codec, prompt_for
from embomatrix.trainer.config.settings import GrpoSettings
from embomatrix.trainer.learning.learner import Learner, Microbatch, SamplingParams
from embomatrix.trainer.learning.objective import LossTotals
from embomatrix.trainer.policy.decoder import DecoderShape
from embomatrix.trainer.policy.tiny import TinyPolicy
from embomatrix.trainer.policy.vocabulary import build_vocabulary

TASKS = make_tasks(2, 0, objects=8)
WORDS = build_vocabulary(
    [task.situation for task in TASKS.train], [task.task.instruction for task in TASKS.train]
)
SHAPE = DecoderShape(len(WORDS), layers=1, width=16, heads=2, inner=32)
PLANS = 6


class RecordingPolicy(TinyPolicy):
    """Policy that keeps its last scores."""

    def logprobs(self, *arguments, **options):
        self.scores = super().logprobs(*arguments, **options)
        return self.scores


def learnt(entropy_coef):
    """Learn from one microbatch. Return the policy with its gradient, and the metrics."""
    policy = RecordingPolicy(WORDS, SHAPE, seed=0)
    settings = GrpoSettings(group=PLANS // 2, max_new=6, kl_coef=0.0, entropy_coef=entropy_coef)
    learner = Learner(policy, policy.frozen_copy(), settings)
    prompts = [policy.encode(prompt_for(task.situation, Codec.NAMES)) for task in TASKS.train]
    samples = learner.sample(prompts, 0, SamplingParams.of(settings))
    microbatch = Microbatch(
        prompts=prompts,
        tokens=samples.tokens,
        mask=samples.mask,
        old_logprobs=samples.logprobs,
        sampler_logprobs=samples.logprobs,
        reference=None,
        advantages=torch.linspace(-1, 1, PLANS)[:, None],
        totals=LossTotals(PLANS, int(samples.mask.sum()), 6),
    )
    return policy, learner.learn(microbatch)


def gradient(policy):
    return torch.cat([each.grad.flatten() for each in policy.parameters() if each.grad is not None])


def test_entropy_with_coefficient_0_is_logged_without_a_graph():
    policy, metrics = learnt(entropy_coef=0.0)
    assert not policy.scores.entropy.requires_grad
    assert metrics.entropy > 0


def test_entropy_with_a_coefficient_changes_the_gradient():
    policy, metrics = learnt(entropy_coef=0.5)
    plain, plain_metrics = learnt(entropy_coef=0.0)
    assert policy.scores.entropy.requires_grad
    assert metrics == plain_metrics
    assert not torch.allclose(gradient(policy), gradient(plain))
