"""GRPO steps of a language model with random weights on one GPU: seconds, memory beside its plan, weights that move.

Random weights cost as much memory and time as trained ones. Their plans seldom end early, so each has the full length.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Final

import numpy as np
import torch
from torch import Tensor

from embomatrix.bench.report.figures import BenchError
from embomatrix.bench.trainer.memory import LongPlanLearner
from embomatrix.bench.trainer.steps import ROWS, LengthScore, Load, load_of, step_of, trl_step_s
from embomatrix.bench.trainer.trl_steps import model_of, tokenizer_of
from embomatrix.pages.figures import Better, Figure
from embomatrix.skills.prompt import Codec
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import LANGUAGE_MODEL_DEFAULTS, GrpoSettings, read_settings
from embomatrix.trainer.data.tasks import TrainingTask, load_tasks
from embomatrix.trainer.data.variation import Variation
from embomatrix.trainer.grpo.sampling import Sampler
from embomatrix.trainer.grpo.update import Updater
from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
from embomatrix.trainer.learning.learner import Learner
from embomatrix.trainer.lifecycle.stopwatch import Stopwatch
from embomatrix.trainer.policy.footprint import LanguageModelFootprint, Precision
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.memory_plan import GB, Lengths, Phase, plan_memory
from embomatrix.trainer.policy.model_shape import shape_of
from embomatrix.trainer.policy.prompts import PromptBuilder

PROMPTS: Final = 24
LEARNING_RATE: Final = 1e-5
LEARNING_STEPS: Final = 6
"""Steps after which the changed weights are counted. The first one, in which the GPU warms up, is not timed."""
VOCABULARY: Final = 151_936


def bench_gpu(
    dataset: Path, trl: Path | None, folder: Path, on_step: Callable[[str], None]
) -> tuple[Figure, ...]:
    """Measure full fine-tuning of a model of 1.5 billion weights on one GPU, and TRL's steps on the same load.

    ``trl`` is the interpreter of an environment with TRL. Raise BenchError.
    """
    if not torch.cuda.is_available():
        raise BenchError("torch finds no GPU here: run this part on a machine with one, or leave --gpu out")
    try:
        tasks = load_tasks(dataset).train[:PROMPTS]
    except TrainerError as error:
        raise BenchError(str(error)) from error
    load = gpu_load(tasks)
    on_step("our steps")
    found = own_gpu_figures(load, tasks)
    if trl is None:
        return found
    on_step("TRL's steps")
    torch.cuda.empty_cache()
    theirs = trl_step_s(load, trl, folder)
    own_s = next(figure.value for figure in found if figure.name == "gpu_step_s")
    return (
        *found,
        Figure("trl_gpu_step_s", float(np.median(theirs)), "s", Better.NEITHER, len(theirs)),
        Figure("gpu_step_vs_trl", float(np.median(theirs)) / own_s, "×", Better.HIGHER, len(theirs)),
    )


def gpu_load(tasks: Sequence[TrainingTask]) -> Load:
    """The load of these tasks' prompts for a model with the shape of Qwen2.5-1.5B, from its published configuration.

    Words that stand for nothing fill its vocabulary.
    """
    load = load_of(tasks)
    fillers = (f"w{number}" for number in range(VOCABULARY - len(load.words)))
    return replace(
        load,
        words=(*load.words, *fillers),
        layers=28,
        width=1_536,
        heads=12,
        key_value_heads=2,
        inner=8_960,
        device="cuda",
        new=256,
        microbatch=8,
        steps=LEARNING_STEPS - 1,
    )


def own_gpu_figures(load: Load, tasks: Sequence[TrainingTask]) -> tuple[Figure, ...]:
    """Take steps at a learning rate of 1e-5, and return their seconds, memory and changed weights."""
    torch.manual_seed(load.seed)
    values = asdict(load)
    with torch.device(load.device):
        model = model_of(values)
    tokenizer = tokenizer_of(values["words"])
    policy = HfPolicy(model, tokenizer, Codec.LINES, "a random model", autocast=torch.bfloat16)
    settings = read_settings(
        None,
        {
            "device": load.device,
            "prompt.rows": ROWS,
            "grpo.tasks_per_step": load.tasks,
            "grpo.chunk": load.tasks,
            "grpo.group": load.group,
            "grpo.max_new": load.new,
            "grpo.learning_rate": LEARNING_RATE,
            "grpo.kl_coef": 0.0,
        },
        LANGUAGE_MODEL_DEFAULTS,
    )
    learner = LongPlanLearner(policy, policy, settings.grpo)
    before = [parameter.detach().cpu().clone() for parameter in policy.parameters()]
    torch.cuda.reset_peak_memory_stats()
    spent_s = _take_steps(load, tasks, learner, settings.grpo)
    peak = torch.cuda.max_memory_allocated()
    footprint = LanguageModelFootprint(shape_of(model), Precision.MIXED, settings.lora, recomputes=False)
    plan = plan_memory(settings, footprint, Lengths(learner.longest_prompt, oracle=1))
    planned = max(plan.total(phase) for phase in (Phase.SAMPLING, Phase.UPDATE, Phase.STEP))
    step_s, count = float(np.median(spent_s)), len(spent_s)
    tokens = load.tasks * load.group * load.new
    return (
        Figure("gpu_step_s", step_s, "s", Better.LOWER, count),
        Figure("gpu_plan_tokens_per_s", tokens / step_s, "1/s", Better.HIGHER, count),
        Figure("gpu_peak_gb", peak / GB, "GB", Better.LOWER, 1),
        Figure("gpu_memory_plan_error", abs(planned / peak - 1), "", Better.LOWER, 1, 0.15),
        Figure("gpu_weights_changed_share", changed_share(before, policy), "", Better.HIGHER, 1, 0.99),
    )


def _take_steps(
    load: Load, tasks: Sequence[TrainingTask], learner: Learner, settings: GrpoSettings
) -> list[float]:
    """Take the steps of a load, and return the wall seconds of the measured ones."""
    builder = PromptBuilder(learner.policy, ROWS, Variation({}, rename=0.0, drop=0.0))
    workers = DataParallelWorkers(learner)
    sampler = Sampler(workers, learner.policy.codec, builder, LengthScore(), settings)
    updater = Updater(learner.policy, workers, sampler, settings, Stopwatch())
    generator = torch.Generator().manual_seed(load.seed)
    spent_s = []
    for step in range(load.unmeasured + load.steps):
        chosen = [tasks[(step * load.tasks + at) % len(tasks)] for at in range(load.tasks)]
        torch.cuda.synchronize()
        began_s = time.perf_counter()
        updater.take_step(step_of(step, chosen, generator))
        torch.cuda.synchronize()
        spent_s.append(time.perf_counter() - began_s)
    return spent_s[load.unmeasured :]


def changed_share(before: Sequence[Tensor], policy: HfPolicy) -> float:
    """Share of the weights that differ from those before."""
    changed = sum(
        int((now.detach().cpu() != then).sum()) for now, then in zip(policy.parameters(), before, strict=True)
    )
    return changed / sum(map(torch.numel, before))
