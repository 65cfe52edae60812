"""Our steps of GRPO on a load, as a program: processor seconds of each step, as JSON on standard output.

python -m embomatrix.bench.trainer.own_steps LOAD DATASET
"""

from __future__ import annotations

import json
import sys
import time
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from embomatrix.bench.trainer.load import END, ROWS, UNKNOWN, Load, read_load
from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.skills.prompt import Codec
from embomatrix.trainer.cluster.gateway import PlanOutcome
from embomatrix.trainer.config.settings import GrpoSettings
from embomatrix.trainer.data.tasks import load_tasks
from embomatrix.trainer.data.variation import Variation
from embomatrix.trainer.grpo.data_parallel import DataParallelWorkers
from embomatrix.trainer.grpo.learner import Learner
from embomatrix.trainer.grpo.update import StepPlan, Updater
from embomatrix.trainer.lifecycle.stopwatch import Stopwatch
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.prompts import PromptBuilder

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.skills.prompt import Situation
    from embomatrix.trainer.data.tasks import TrainingTask


class LengthScore:
    """Stands for the cluster: a reward at once, of the text's length, so that groups carry a signal."""

    def submit(
        self,
        batch_id: str,
        step: int,
        task: TrainingTask,
        situation: Situation,
        texts: Sequence[str],
        codec: Codec,
    ) -> Future[tuple[PlanOutcome, ...]]:
        done: Future[tuple[PlanOutcome, ...]] = Future()
        done.set_result(
            tuple(PlanOutcome(text, RewardBreakdown(float(len(text)), 0.0, 0.0, (), False)) for text in texts)
        )
        return done


def measure(load: Load, tasks: Sequence[TrainingTask]) -> list[float]:
    """Processor seconds of each measured step."""
    torch.set_num_threads(1)
    torch.manual_seed(load.seed)
    policy = policy_of(load)
    settings = GrpoSettings(
        tasks_per_step=load.tasks, group=load.group, chunk=load.tasks, max_new=load.new, kl_coef=0.0
    )
    prompt_builder = PromptBuilder(policy, ROWS, Variation({}, rename=0.0, drop=0.0))
    crew = DataParallelWorkers(Learner(policy, policy, settings))
    updater = Updater(policy, crew, prompt_builder, LengthScore(), settings, Stopwatch())
    generator = torch.Generator().manual_seed(load.seed)
    spent_s = []
    for step in range(load.unmeasured + load.steps):
        chosen = [tasks[(step * load.tasks + at) % len(tasks)] for at in range(load.tasks)]
        began_s = time.process_time()
        updater.take_step(StepPlan(step, chosen, (), (), np.random.default_rng, generator, rate_factor=1.0))
        spent_s.append(time.process_time() - began_s)
    return spent_s[load.unmeasured :]


def policy_of(load: Load) -> HfPolicy:
    """A random Llama of the load's shape, over its words."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerFast

    model = models.WordLevel({word: at for at, word in enumerate(load.words)}, unk_token=UNKNOWN)
    inner = Tokenizer(model)
    inner.pre_tokenizer = pre_tokenizers.WhitespaceSplit()
    words: Any = PreTrainedTokenizerFast  # transformers leaves it untyped
    tokenizer = words(tokenizer_object=inner, unk_token=UNKNOWN, eos_token=END)
    config = LlamaConfig(
        vocab_size=len(load.words),
        hidden_size=load.width,
        intermediate_size=load.inner,
        num_hidden_layers=load.layers,
        num_attention_heads=load.heads,
        num_key_value_heads=load.heads,
        max_position_embeddings=2048,
        tie_word_embeddings=True,
        eos_token_id=load.words.index(END),
    )
    return HfPolicy(LlamaForCausalLM(config), tokenizer, Codec.LINES, "a random Llama")


def main() -> None:
    """Two arguments: the load's file, and the dataset that it was made of."""
    load = read_load(Path(sys.argv[1]))
    tasks = load_tasks(Path(sys.argv[2])).train[: len(load.prompts)]
    sys.stdout.write(json.dumps({"step_s": measure(load, tasks)}) + "\n")


if __name__ == "__main__":
    main()
