"""Memory of a run that has not begun: its settings, the lengths of its texts, and the peak that follows from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import TrainSettings
from embomatrix.trainer.data.tasks import TaskSet, load_tasks
from embomatrix.trainer.policy.compute_dtype import torch_dtype
from embomatrix.trainer.policy.footprint import (
    Footprint,
    LanguageModelFootprint,
    WordLevelFootprint,
    precision_of,
)
from embomatrix.trainer.policy.limits import TokenCounter, plan_of, prompts_of, with_measured_limits
from embomatrix.trainer.policy.loading import is_word_level, word_level_shape
from embomatrix.trainer.policy.memory_plan import (
    GB,
    USABLE_SHARE,
    Advice,
    Lengths,
    MemoryPlan,
    Part,
    advice,
    plan_memory,
)
from embomatrix.trainer.policy.model_shape import language_model_shape
from embomatrix.trainer.run.starting import new_settings

GPU: Final = "cuda"
"""Device of a plan for which none is given."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """Peak memory of a run. ``advice`` is the change of one setting that lowers it most.

    ``lengths`` are exact for the word-level policy (``is_word_level``), else estimates.
    """

    settings: TrainSettings
    lengths: Lengths
    plan: MemoryPlan
    advice: Advice | None
    is_word_level: bool


def forecast(dataset: Path, model: str, settings_file: Path | None, changes: Mapping[str, Any]) -> Forecast:
    """Return the peak memory of a new run on a GPU, or on the device that is given. Weights are not read.

    Raises TrainerError.
    """
    settings = new_settings(model, settings_file, changes)
    if settings.episodes.visibility is not None:
        raise TrainerError(
            "the plan of memory is for whole plans: leave out episodes.visibility (--episodes), or --plan-memory"
        )
    if "device" not in settings.model_fields_set:
        settings = settings.model_copy(update={"device": GPU})
    word_level = is_word_level(model)
    tasks = load_tasks(dataset)
    footprint, counter = (_word_level if word_level else _language_model)(settings, tasks)
    settings = with_measured_limits(settings, counter, tasks)
    lengths = lengths_of(tasks, settings, counter)

    def plan(changed: TrainSettings) -> MemoryPlan:
        return plan_memory(changed, footprint(changed), lengths)

    best = advice(settings, plan, word_level=word_level)
    return Forecast(settings, lengths, plan(settings), best, word_level)


def lengths_of(tasks: TaskSet, settings: TrainSettings, counter: TokenCounter) -> Lengths:
    """Return the longest prompt of all tasks, and the longest oracle plan for training, in tokens."""
    rows = settings.prompt.rows
    prompts = prompts_of((*tasks.train, *tasks.heldout), rows, counter.codec).values()
    plans = [counter.plan_tokens(plan_of(task, rows, counter.codec)) for task in tasks.train if task.oracle]
    return Lengths(max(map(counter.prompt_tokens, prompts)), max(plans, default=1))


def _word_level(
    settings: TrainSettings, tasks: TaskSet
) -> tuple[Callable[[TrainSettings], Footprint], TokenCounter]:
    vocabulary, shape = word_level_shape(settings, tasks)
    casts = torch_dtype(settings.compute_dtype, settings.device) is torch.bfloat16
    return lambda _: WordLevelFootprint(shape, casts), TokenCounter.of_vocabulary(vocabulary, shape)


def _language_model(
    settings: TrainSettings, _: TaskSet
) -> tuple[Callable[[TrainSettings], Footprint], TokenCounter]:
    shape = language_model_shape(settings.model)
    casts = torch_dtype(settings.compute_dtype, settings.device) is torch.bfloat16

    def footprint(changed: TrainSettings) -> Footprint:
        precision = precision_of(changed, casts=casts)
        return LanguageModelFootprint(shape, precision, changed.lora, changed.gradient_checkpointing)

    return footprint, TokenCounter.of_unread_tokenizer(settings.codec)


def memory_text(found: Forecast, gpu_gb: float) -> str:
    """Write the parts by phase in GB, the peak, whether it fits in a GPU of ``gpu_gb``, and the change that helps most."""
    phases = list(found.plan.parts)
    rows = [("", *(phase.value for phase in phases))]
    for part in Part:
        values = [found.plan.parts[phase][part] for phase in phases]
        if any(values):
            rows.append((part.value, *map(_in_gb, values)))
    rows.append(("sum", *(_in_gb(found.plan.total(phase)) for phase in phases)))
    widths = [max(len(row[column]) for row in rows) for column in range(len(phases) + 1)]
    table = [
        "  ".join([row[0].ljust(widths[0]), *(map(str.rjust, row[1:], widths[1:]))]).rstrip() for row in rows
    ]
    return "\n".join([*_about(found), *table, *_verdict(found, gpu_gb)])


def _in_gb(value: int) -> str:
    return f"{value / GB:.2f}" if value else "-"


def _about(found: Forecast) -> tuple[str, str]:
    settings, lengths = found.settings, found.lengths
    source = "" if found.is_word_level else ", estimated from characters"
    return (
        f"peak memory of training {settings.model} on {settings.device} in GB (10^9 bytes), tensors only",
        f"longest prompt {lengths.prompt:,} tokens, longest oracle plan {lengths.oracle:,}{source}; "
        f"prompt.rows = {settings.prompt.rows}, grpo.max_new = {settings.grpo.max_new}",
    )


def _verdict(found: Forecast, gpu_gb: float) -> tuple[str, ...]:
    usable = USABLE_SHARE * gpu_gb * GB
    peak = f"peak: {found.plan.peak / GB:.2f} GB in the phase {found.plan.peak_phase.value}"
    room = f"{usable / GB:.2f} GB, the usable share of {gpu_gb:g} GB"
    if found.plan.peak <= usable:
        return (f"{peak}. It fits in {room}.",)
    best = found.advice
    if best is None:
        return (f"{peak}. It does not fit in {room}: take a larger GPU or a smaller model.",)
    outcome = "which fits" if best.peak <= usable else "which does not fit either"
    return (
        f"{peak}. It does not fit in {room}.",
        f"{best.change} helps most: {best.peak / GB:.2f} GB, {outcome}.",
    )
