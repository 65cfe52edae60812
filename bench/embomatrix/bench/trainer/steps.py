"""GRPO steps on one load for two trainers: the same prompts, the same model shape, the same groups, one thread.

Our steps run in this process; TRL's run in an environment with its own pins, as the program ``trl_steps``.
"""

import json
import os
import time
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from embomatrix.bench.cluster.processes import output_of
from embomatrix.bench.report.figures import BenchError
from embomatrix.bench.trainer.trl_steps import model_of, tokenizer_of
from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.skills.prompt import Codec, limited, prompt_for
from embomatrix.skills.syntax import PROFILES, PlaceRelation
from embomatrix.trainer.cluster.gateway import PlanGroup, PlanOutcome
from embomatrix.trainer.config.settings import GrpoSettings
from embomatrix.trainer.data.tasks import TrainingTask
from embomatrix.trainer.data.variation import Variation
from embomatrix.trainer.grpo.sampling import Sampler
from embomatrix.trainer.grpo.update import StepPlan, Updater
from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
from embomatrix.trainer.learning.learner import Learner
from embomatrix.trainer.lifecycle.stopwatch import Stopwatch
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.prompts import PromptBuilder
from embomatrix.world.task import Profile

END: Final = "<end>"
UNKNOWN: Final = "<unknown>"
ROWS: Final = 16


@dataclass(frozen=True, slots=True)
class Load:
    """A step samples ``group`` plans of ``new`` tokens for each of ``tasks`` prompts and learns from all of them.

    ``words`` are the vocabulary. ``steps`` are measured after ``unmeasured`` ones, in which libraries warm up. TRL
    back-propagates ``microbatch`` plans at once, 0 for all.
    """

    prompts: tuple[str, ...]
    words: tuple[str, ...]
    tasks: int = 4
    group: int = 8
    new: int = 48
    steps: int = 5
    unmeasured: int = 1
    layers: int = 4
    width: int = 256
    heads: int = 4
    key_value_heads: int = 4
    inner: int = 672
    microbatch: int = 0
    device: str = "cpu"
    seed: int = 0


def load_of(tasks: Sequence[TrainingTask]) -> Load:
    """The load of these tasks' prompts in lines."""
    prompts = [prompt_for(limited(task.situation, ROWS), Codec.LINES) for task in tasks]
    texts = tuple(f"{prompt.system}\n\n{prompt.user}\nPlan:\n" for prompt in prompts)
    skills = [skill.value for skill in PROFILES[Profile.PAPER]]
    words = dict.fromkeys(word for text in texts for word in text.split())
    words |= dict.fromkeys([*skills, *(relation.value for relation in PlaceRelation)])
    return Load(texts, (UNKNOWN, END, *words))


class LengthScore:
    """Stand-in for the cluster: an immediate reward by the text's length, so that groups carry a signal."""

    def submit(
        self, batch_id: str, step: int, groups: Sequence[PlanGroup], codec: Codec
    ) -> list[Future[tuple[PlanOutcome, ...]]]:
        return [_scored(group.texts) for group in groups]


def _scored(texts: Sequence[str]) -> Future[tuple[PlanOutcome, ...]]:
    done: Future[tuple[PlanOutcome, ...]] = Future()
    rewards = (RewardBreakdown(float(len(text)), 0.0, 0.0, (), False) for text in texts)
    done.set_result(tuple(map(PlanOutcome, texts, rewards)))
    return done


def own_step_s(load: Load, tasks: Sequence[TrainingTask]) -> list[float]:
    """CPU seconds of each of our measured steps."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.manual_seed(load.seed)
    policy = policy_of(load)
    settings = GrpoSettings(
        tasks_per_step=load.tasks, group=load.group, chunk=load.tasks, max_new=load.new, kl_coef=0.0
    )
    prompt_builder = PromptBuilder(policy, ROWS, Variation({}, rename=0.0, drop=0.0))
    workers = DataParallelWorkers(Learner(policy, policy, settings))
    sampler = Sampler(workers, policy.codec, prompt_builder, LengthScore(), settings)
    updater = Updater(policy, workers, sampler, settings, Stopwatch())
    generator = torch.Generator().manual_seed(load.seed)
    spent_s = []
    for step in range(load.unmeasured + load.steps):
        chosen = [tasks[(step * load.tasks + at) % len(tasks)] for at in range(load.tasks)]
        began_s = time.process_time()
        updater.take_step(step_of(step, chosen, generator))
        spent_s.append(time.process_time() - began_s)
    torch.set_num_threads(threads)
    return spent_s[load.unmeasured :]


def step_of(number: int, tasks: Sequence[TrainingTask], generator: torch.Generator) -> StepPlan:
    """Return a step on these tasks alone, at the full learning rate."""
    return StepPlan(
        step=number,
        tasks=tasks,
        upcoming=(),
        reserve=(),
        rng=np.random.default_rng,
        generator=generator,
        order=np.random.default_rng,
        seed_of=lambda *_: 0,
        rate_factor=1.0,
    )


def policy_of(load: Load) -> HfPolicy:
    """Random Llama of the load's shape over its words, the same as TRL's."""
    values = asdict(load)
    return HfPolicy(model_of(values), tokenizer_of(values["words"]), Codec.LINES, "a random Llama")


def trl_step_s(load: Load, python: Path, folder: Path) -> list[float]:
    """CPU seconds of each of TRL's measured steps, on a GPU wall seconds. Raise BenchError.

    ``python`` is the interpreter of its environment.
    """
    path = folder / "load.json"
    path.write_text(json.dumps(asdict(load)), encoding="utf-8")
    spec = find_spec("embomatrix.bench.trainer.trl_steps")
    # An environment with its own pins must not import our packages.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return parse_step_s(
        output_of(str(python), str(spec.origin if spec else ""), str(path), environment=environment)
    )


def parse_step_s(output: str) -> list[float]:
    """CPU seconds of the steps, from the last line of a program's output. Raise BenchError."""
    last = (output.strip().splitlines() or [""])[-1]
    try:
        value: Any = json.loads(last)
        return [float(each) for each in value["step_s"]]
    except (ValueError, KeyError, TypeError) as error:
        raise BenchError(
            f"a program printed no step times ({last[:100]!r}): expected JSON with step_s"
        ) from error
