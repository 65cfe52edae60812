"""Peak memory of a training run by phase and part, before anything is loaded.

All functions are arithmetic on sizes and settings. They count tensors: the driver's context, workspaces of libraries and
fragmentation come on top (``USABLE_SHARE``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

from embomatrix.trainer.config.settings import ImitationSettings, OptimiserKind, TrainSettings, with_changes
from embomatrix.trainer.policy.footprint import FLOAT32, Batch, Footprint, Usage

GB: Final = 10**9
"""Bytes of a GB."""
USABLE_SHARE: Final = 0.9
"""Share of a GPU's memory that tensors may take. The rest is for its context, workspaces and fragmentation."""
ADAPTER_RANK: Final = 16
"""Rank of the adapters that the advice names."""


class Part(StrEnum):
    """Part of the memory."""

    WEIGHTS = "weights"
    COPIES = "bfloat16 copies"
    GRADIENTS = "gradients"
    OPTIMISER = "optimiser state"
    REFERENCE = "reference policy"
    ACTIVATIONS = "activations"
    LOGITS = "logits"
    CACHE = "sampling KV cache"


class Phase(StrEnum):
    """Phase of a run with a peak of its own."""

    IMITATION = "imitation"
    EVALUATION = "evaluation"
    SAMPLING = "sampling"  # with the scores under the reference policy, and of what a model server sampled
    UPDATE = "update"
    STEP = "optimiser step"
    CHECKPOINT = "checkpoint"


@dataclass(frozen=True, slots=True)
class Lengths:
    """Longest prompt and longest oracle plan, in tokens."""

    prompt: int
    oracle: int


@dataclass(frozen=True, slots=True)
class MemoryPlan:
    """Bytes of each part at the peak of each phase."""

    parts: Mapping[Phase, Mapping[Part, int]]

    def total(self, phase: Phase) -> int:
        """Sum over the parts of a phase, in bytes."""
        return sum(self.parts[phase].values())

    @property
    def peak_phase(self) -> Phase:
        """Phase with the highest sum."""
        return max(self.parts, key=self.total)

    @property
    def peak(self) -> int:
        """Highest sum of all phases, in bytes."""
        return self.total(self.peak_phase)


@dataclass(frozen=True, slots=True)
class Advice:
    """Change of one setting, in words, and the peak of the run with it, in bytes."""

    change: str
    settings: TrainSettings
    peak: int


def plan_memory(settings: TrainSettings, footprint: Footprint, lengths: Lengths) -> MemoryPlan:
    """Return the peaks of a run in which every prompt is the longest one and every plan uses all tokens that it may.

    With a model server the trainer samples and evaluates nothing; it scores what the server sampled.
    """
    imitation, grpo, evaluation = settings.imitation, settings.grpo, settings.evaluation
    new = grpo.max_new
    gradients = footprint.learning * FLOAT32
    moments = 2 * gradients
    parts: dict[Phase, dict[Part, int]] = {}
    if imitation.steps or (imitation.steps is None and imitation.seconds):
        size = min(imitation.chunk or imitation.batch, imitation.batch)
        usage = footprint.learnt(Batch(size, 1, lengths.prompt, lengths.oracle), entropy=False)
        kept = footprint.weights * (2 if imitation.patience else 1)
        parts[Phase.IMITATION] = _parts(
            usage,
            weights=kept,
            gradients=gradients if imitation.batch > size else 0,
            optimiser=_imitation_state(imitation, footprint),
        )
    held = {
        "weights": footprint.weights,
        "gradients": gradients,  # a step's gradients live until the next update begins
        "optimiser": moments,
        "reference": footprint.reference if grpo.kl_coef else 0,
    }
    is_served = bool(settings.sampler.url)
    if not is_served:
        samples = max(evaluation.samples, evaluation.samples_during if evaluation.every else 0)
        usage = footprint.sampled(Batch(evaluation.chunk, samples, lengths.prompt, new))
        parts[Phase.EVALUATION] = _parts(usage, **held)
    size = min(grpo.chunk, grpo.tasks_per_step)
    batch = Batch(size, grpo.group, lengths.prompt, new)
    passes = [] if is_served else [footprint.sampled(batch)]
    if grpo.kl_coef or is_served:
        passes.append(footprint.scored(batch))
    parts[Phase.SAMPLING] = _parts(max(passes, key=lambda usage: usage.total), **held)
    usage = footprint.learnt(batch, entropy=grpo.entropy_coef > 0)
    earlier = gradients if grpo.tasks_per_step > size or grpo.reserve else 0
    parts[Phase.UPDATE] = _parts(usage, **{**held, "gradients": earlier})
    parts[Phase.STEP] = _parts(Usage(activations=_step_bytes(settings, footprint)), **held)
    if footprint.saving:
        parts[Phase.CHECKPOINT] = _parts(Usage(copies=footprint.saving), **held)
    return MemoryPlan(parts)


def _parts(
    usage: Usage, *, weights: int, gradients: int, optimiser: int, reference: int = 0
) -> dict[Part, int]:
    return {
        Part.WEIGHTS: weights,
        Part.COPIES: usage.copies,
        Part.GRADIENTS: gradients + usage.gradients,
        Part.OPTIMISER: optimiser,
        Part.REFERENCE: reference,
        Part.ACTIVATIONS: usage.activations,
        Part.LOGITS: usage.logits,
        Part.CACHE: usage.cache,
    }


def _imitation_state(settings: ImitationSettings, footprint: Footprint) -> int:
    """Bytes of two moments for AdamW's weights and of one for Muon's."""
    single = footprint.matrices if settings.optimiser is OptimiserKind.MUON else 0
    return FLOAT32 * (2 * footprint.learning - single)


def _step_bytes(settings: TrainSettings, footprint: Footprint) -> int:
    """Bytes of AdamW's denominators: of all weights at once on a GPU, of one tensor and its quotient on a CPU."""
    if settings.device == "cpu":
        return 2 * FLOAT32 * footprint.largest
    return FLOAT32 * footprint.learning


def advice(
    settings: TrainSettings, plan: Callable[[TrainSettings], MemoryPlan], *, word_level: bool
) -> Advice | None:
    """Return the change of one setting that lowers the peak most, None if no change lowers it."""
    peak = plan(settings).peak
    options = [
        Advice(change, changed, plan(changed).peak)
        for change, changed in _changes(settings, word_level=word_level)
    ]
    best = min(options, key=lambda option: option.peak, default=None)
    return best if best is not None and best.peak < peak else None


def _changes(settings: TrainSettings, *, word_level: bool) -> Iterator[tuple[str, TrainSettings]]:
    """Yield settings that differ in one value, with the change in words."""
    grpo, imitation, evaluation = settings.grpo, settings.imitation, settings.evaluation
    wanted: list[tuple[bool, str, Any]] = [
        (not word_level and not settings.gradient_checkpointing, "gradient_checkpointing", True),
        (not word_level and not settings.lora.rank, "lora.rank", ADAPTER_RANK),
        (grpo.chunk > 1, "grpo.chunk", 1),
        (imitation.chunk != 1, "imitation.chunk", 1),
        (evaluation.chunk > 1, "evaluation.chunk", 1),
        (grpo.group > 2, "grpo.group", max(2, grpo.group // 2)),
        (True, "grpo.max_new", max(1, grpo.max_new // 2)),
    ]
    for possible, name, value in wanted:
        if possible:
            shown = str(value).lower()
            yield f"{name} = {shown}", with_changes(settings.model_dump(), {name: value})
