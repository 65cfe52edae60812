"""Peak memory of real GRPO steps on a CPU, beside the plan of `embomatrix train --plan-memory`."""

import gc
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from embomatrix.bench.trainer.steps import ROWS, LengthScore, Load, policy_of, step_of
from embomatrix.trainer.config.settings import LANGUAGE_MODEL_DEFAULTS, TrainSettings, read_settings
from embomatrix.trainer.data.tasks import TrainingTask
from embomatrix.trainer.data.variation import Variation
from embomatrix.trainer.grpo.sampling import Sampler
from embomatrix.trainer.grpo.update import Updater
from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
from embomatrix.trainer.learning.learner import Learner, SamplingParams
from embomatrix.trainer.lifecycle.stopwatch import Stopwatch
from embomatrix.trainer.policy.footprint import Footprint, LanguageModelFootprint, Precision
from embomatrix.trainer.policy.memory_plan import Lengths, Phase, plan_memory
from embomatrix.trainer.policy.model_shape import shape_of
from embomatrix.trainer.policy.prompts import PromptBuilder
from embomatrix.trainer.policy.protocol import Policy, Samples, Tokens


class LongPlanLearner(Learner):
    """Learner that gives all plans of a microbatch the tokens of its longest one, because the plan assumes long plans.

    It remembers the longest prompt and the longest plan.
    """

    longest_prompt = 0
    longest_plan = 0

    def sample(self, prompts: Sequence[Tokens], seed: int, rule: SamplingParams) -> Samples:
        drawn = super().sample(prompts, seed, rule)
        self.longest_prompt = max(self.longest_prompt, *map(len, prompts))
        self.longest_plan = max(self.longest_plan, drawn.tokens.shape[1])
        longest = int(drawn.mask.sum(dim=1).argmax())
        tokens, mask, logprobs = (
            each[longest].repeat(len(each), 1) for each in (drawn.tokens, drawn.mask, drawn.logprobs)
        )
        cut_off = drawn.cut_off[longest].repeat(len(tokens))
        return Samples(tokens, mask, logprobs, drawn.texts, cut_off)


def plan_error(
    policy: Policy, footprint: Footprint, settings: TrainSettings, tasks: Sequence[TrainingTask]
) -> float:
    """Relative error of the planned peak of a GRPO step: above 0 if the plan is higher than the tensors measured.

    The plan gets the longest prompt and the longest plan of the measured step. Two steps are taken on the policy: the first
    one creates the optimiser state.
    """
    reference = policy.frozen_copy()
    learner = LongPlanLearner(policy, reference, settings.grpo)
    builder = PromptBuilder(policy, settings.prompt.rows, Variation({}, rename=0.0, drop=0.0))
    workers = DataParallelWorkers(learner)
    sampler = Sampler(workers, policy.codec, builder, LengthScore(), settings.grpo)
    updater = Updater(policy, workers, sampler, settings.grpo, Stopwatch())
    generator = torch.Generator().manual_seed(settings.seed)
    chosen = [tasks[at % len(tasks)] for at in range(settings.grpo.tasks_per_step)]

    def take_step(step: int) -> None:
        updater.take_step(step_of(step, chosen, generator))

    take_step(1)
    learner.longest_prompt = learner.longest_plan = 0
    updater.optimiser.zero_grad()  # the profiler does not see the end of older tensors
    held = _held_bytes(policy, reference, updater.optimiser)
    measured = held + rise_of(lambda: take_step(2))
    grpo = settings.grpo.model_copy(update={"max_new": learner.longest_plan})
    lengths = Lengths(learner.longest_prompt, oracle=1)
    plan = plan_memory(settings.model_copy(update={"grpo": grpo}), footprint, lengths)
    planned = max(plan.total(phase) for phase in (Phase.SAMPLING, Phase.UPDATE, Phase.STEP))
    return planned / measured - 1


def _held_bytes(policy: Policy, reference: Policy, optimiser: torch.optim.Optimizer) -> int:
    """Bytes of weights, reference policy and optimiser state. Tensors that they share count once."""
    tensors: list[Any] = [*policy.module.parameters(), *reference.module.parameters()]
    tensors += [value for state in optimiser.state.values() for value in state.values()]
    held = {
        id(each): each.numel() * each.element_size() for each in tensors if isinstance(each, torch.Tensor)
    }
    return sum(held.values())


def rise_of(work: Callable[[], None]) -> int:
    """Bytes by which the memory of all tensors rises above its start while ``work`` runs, on a CPU."""
    gc.collect()
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        work()
    now = highest = 0
    # The public events leave out where memory changes between two operators: these are all changes in order.
    assert profiler.profiler is not None
    assert profiler.profiler.kineto_results is not None
    for event in profiler.profiler.kineto_results.events():
        if event.name() == "[memory]":
            now += event.nbytes()
            highest = max(highest, now)
    return highest


def random_llama_error(load: Load, tasks: Sequence[TrainingTask]) -> float:
    """Relative error of the plan for the model of the compared steps, with a KL term and a task in each microbatch."""
    policy = policy_of(load)
    changes = {
        "device": "cpu",
        "compute_dtype": "float32",
        "prompt.rows": ROWS,
        "grpo.tasks_per_step": load.tasks,
        "grpo.group": load.group,
        "grpo.max_new": load.new,
    }
    settings = read_settings(None, changes, LANGUAGE_MODEL_DEFAULTS)
    shape = shape_of(policy.module)
    footprint = LanguageModelFootprint(shape, Precision.FLOAT32, settings.lora, recomputes=False)
    return plan_error(policy, footprint, settings, tasks)
