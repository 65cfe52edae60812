"""Every constant of a training run, parsed once: from the command line, from a TOML file, or from a checkpoint."""

from __future__ import annotations

import tomllib
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.skills.prompt import Codec
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.grpo.objective import LossKind, Objective, RatioLevel

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


class Overlap(StrEnum):
    """What is computed while the cluster simulates."""

    NONE = "none"  # nothing: every reward of a step is waited for, then the policy learns
    STREAM = "stream"  # groups are sampled and learnt while others are simulated
    AHEAD = "ahead"  # so is the next step's batch sampled, with weights that are one step old


class TrackerKind(StrEnum):
    """Programs that draw metrics."""

    TENSORBOARD = "tensorboard"
    WANDB = "wandb"
    TRACKIO = "trackio"


class OptimiserKind(StrEnum):
    """What imitation moves weights by."""

    ADAMW = "adamw"
    MUON = "muon"  # for the matrices of linear layers, and AdamW for everything else


class Products(StrEnum):
    """The type in which a policy's layers multiply on a processor; weights, sums and attention are of 32 bits always."""

    AUTO = "auto"  # bfloat16 where the processor has instructions for it
    BFLOAT16 = "bfloat16"
    FLOAT32 = "float32"


class OnLost(StrEnum):
    """What becomes of a group of which the infrastructure lost a rollout."""

    GROUP = "group"  # the whole group is left out of the update
    PARTIAL = "partial"  # only the lost rollout is


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class TinySettings(_Frozen):
    """The from-scratch policy's shape."""

    layers: int = Field(default=4, ge=1)
    width: int = Field(default=128, ge=16)
    heads: int = Field(default=4, ge=1)
    inner: int = Field(default=384, ge=16)


class LoraSettings(_Frozen):
    """Low-rank adapters for a Hugging Face model, in place of learning all of its weights."""

    rank: int = Field(default=0, ge=0)
    """0: none, the whole model learns."""
    alpha: float = Field(default=32.0, gt=0)
    """What the adapters add is scaled by alpha / rank."""
    targets: tuple[str, ...] = ()
    """Last parts of the names of the linear layers that get one; none: all but the output layer."""


class PromptSettings(_Frozen):
    """What of a task's table is told, and how the telling varies during training."""

    rows: int = Field(default=16, ge=1)
    """Rows told at most: those that the instruction names come first."""
    rename_share: float = Field(default=0.8, ge=0, le=1)
    """Share of imitation's examples in which categories are called by the names of others (tiny policy only)."""
    practice_rename_share: float = Field(default=0.0, ge=0, le=1)
    """The same for GRPO's: by default it practises in the words of its tasks."""
    drop_share: float = Field(default=0.7, ge=0, le=1)
    """During imitation: up to this share of the rows that the oracle does not use is left untold."""


class ImitationSettings(_Frozen):
    """Teacher forcing on the oracle's plans, before GRPO."""

    seconds: float = Field(default=150.0, ge=0)
    steps: int | None = Field(default=None, ge=0)
    """A number of steps in place of the seconds."""
    batch: int = Field(default=32, ge=1)
    """Plans of a step."""
    chunk: int | None = Field(default=None, ge=1)
    """Plans that are learnt from at once: a step's gradient is accumulated over chunks, and memory is a chunk's. None: all."""
    optimiser: OptimiserKind = OptimiserKind.MUON
    learning_rate: float = Field(default=2e-3, gt=0)
    """AdamW's."""
    matrix_learning_rate: float = Field(default=0.02, gt=0)
    """Muon's."""
    warmup_steps: int = Field(default=20, ge=0)
    weight_decay: float = Field(default=0.01, ge=0)
    patience: int = Field(default=0, ge=0)
    """Early stopping: so many measurements in a row without a lower loss on tasks set aside end imitation, once their mean is
    not below that of as many before them. The policy is put back to where that loss was lowest. 0: every task is taught, for
    the whole budget."""
    validation_share: float = Field(default=0.05, gt=0, lt=1)
    """Share of the training tasks that are set aside for it."""
    validate_every: int = Field(default=100, ge=1)
    """Steps between two measurements."""
    checkpoint_seconds: float = Field(default=60.0, gt=0)
    """Seconds of imitation between two checkpoints."""


class GrpoSettings(_Frozen):
    """Group relative policy optimisation. The paper gives no values for these constants."""

    minutes: float = Field(default=5.0, ge=0)
    steps: int | None = Field(default=None, ge=0)
    """A number of steps in place of the minutes."""
    tasks_per_step: int = Field(default=16, ge=1)
    group: int = Field(default=8, ge=2)
    """Plans per task: G."""
    chunk: int = Field(default=8, ge=1)
    """Tasks sampled together: their plans go to the cluster while the next chunk is sampled."""
    learning_rate: float = Field(default=4e-4, gt=0)
    warmup_steps: int = Field(default=20, ge=0)
    """Adam's first steps have the full length of the rate whatever the gradient: unless it rises slowly, the first few small
    batches undo what imitation taught."""
    final_learning_rate_share: float = Field(default=0.2, gt=0, le=1)
    """The rate falls linearly to this share of itself."""
    temperature: float = Field(default=1.0, gt=0)
    max_new: int = Field(default=72, ge=1)
    """Tokens of a plan at most."""
    loss: LossKind = LossKind.DAPO
    ratio: RatioLevel = RatioLevel.TOKEN
    clip_low: float = Field(default=0.2, gt=0, lt=1)
    clip_high: float = Field(default=0.28, gt=0)
    kl_coef: float = Field(default=0.02, ge=0)
    """Weight of the KL to the policy as imitation left it: the paper's beta."""
    entropy_coef: float = Field(default=0.0, ge=0)
    spread_floor: float = Field(default=1.0, gt=0)
    """Added to the spread of a group's rewards, in units of reward, before they are divided by it. At 1, a group whose plans
    differ by a touched object only weighs a tenth of one in which some reach the goal; near 0, as in the paper, as much."""
    max_grad_norm: float = Field(default=1.0, gt=0)
    lookahead: int = Field(default=3, ge=0)
    """Steps announced ahead."""
    on_lost: OnLost = OnLost.GROUP
    overlap: Overlap = Overlap.STREAM
    reserve: int = Field(default=0, ge=0)
    """Dynamic sampling: tasks of a step, at most, that take the place of groups without signal."""
    curriculum_tasks: int = Field(default=0, ge=0)
    """While so many tasks are drawn, they come from a pool that grows from the shortest plans to all; 0: from all at once."""
    curriculum_start: float = Field(default=0.25, gt=0, le=1)
    """The pool's share of all tasks at the start."""
    relevance: float = Field(default=1.0, ge=0)
    """Weight of the reward's second tier in what is learnt; 0 leaves it out."""
    relevance_final: float | None = Field(default=None, ge=0)
    """Its weight at the end of the budget, reached linearly; None: it stays."""

    def objective(self) -> Objective:
        return Objective(
            self.loss, self.ratio, self.clip_low, self.clip_high, self.kl_coef, self.entropy_coef
        )


class RewardTable(_Frozen):
    """Coefficients of the reward's tiers: what the cluster scores this run's plans with. 0 leaves a tier out."""

    unparsable: float = PAPER.unparsable
    format: float = PAPER.format
    relevance_per_object: float = PAPER.relevance_per_object
    relevance_limit: float = PAPER.relevance_limit
    goal: float = PAPER.goal

    @model_validator(mode="after")
    def _pays(self) -> Self:
        self.settings()
        return self

    def settings(self) -> RewardSettings:
        return RewardSettings(**self.model_dump())


class EvaluationSettings(_Frozen):
    """Success on held-out tasks."""

    samples: int = Field(default=10, ge=1)
    temperature: float = Field(default=1.0, ge=0)
    chunk: int = Field(default=8, ge=1)


class TrainSettings(_Frozen):
    """One training run."""

    model: str = "tiny"
    """``tiny``, or a Hugging Face model by name or folder."""
    codec: Codec = Codec.LINES
    """Plan form of a Hugging Face model: ``lines`` or ``json``. The tiny policy calls objects by name."""
    seed: int = 0
    threads: int = Field(default=1, ge=1)
    """Threads of torch, in each process."""
    processes: int = Field(default=1, ge=1)
    """Processes that sample and back-propagate GRPO's chunks side by side, on a processor. What is learnt is the same to the
    bit with any number; more than a step has chunks have nothing to do."""
    device: str = "cpu"
    checkpoint_every: int = Field(default=50, ge=1)
    keep_checkpoints: int = Field(default=2, ge=1)
    track: tuple[TrackerKind, ...] = ()
    """Where metrics go besides the run's own files."""
    samples_every: int = Field(default=10, ge=1)
    """Steps between two groups that are written to the sample log."""
    gradient_checkpointing: bool = False
    """Hugging Face models: keep only the inputs of layers for the way back, and compute the rest again."""
    products: Products = Products.AUTO
    tiny: TinySettings = TinySettings()
    lora: LoraSettings = LoraSettings()
    prompt: PromptSettings = PromptSettings()
    imitation: ImitationSettings = ImitationSettings()
    grpo: GrpoSettings = GrpoSettings()
    reward: RewardTable = RewardTable()
    evaluation: EvaluationSettings = EvaluationSettings()


LANGUAGE_MODEL_DEFAULTS: Final[Mapping[str, Any]] = {
    "prompt.rows": 28,
    "prompt.rename_share": 0.0,
    "imitation.batch": 4,
    "imitation.chunk": 1,
    "imitation.optimiser": "adamw",
    "imitation.learning_rate": 5e-5,
    "grpo.tasks_per_step": 4,
    "grpo.chunk": 1,
    "grpo.learning_rate": 1e-5,
    "grpo.max_new": 96,
}
"""What differs by default for a pretrained model: it knows words and needs memory."""


def read_settings(
    path: Path | None, changes: Mapping[str, Any], defaults: Mapping[str, Any] | None = None
) -> TrainSettings:
    """``defaults``, then a TOML file, then ``changes`` (dotted keys; None: not given). Raises TrainerError."""
    values: dict[str, Any] = {}
    _set_all(values, defaults or {})
    if path is not None:
        try:
            _merge(values, tomllib.loads(path.read_text(encoding="utf-8")))
        except OSError as error:
            raise TrainerError(
                f"the settings file {path} can't be read ({error.strerror}): expected a TOML file"
            ) from error
        except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise TrainerError(f"the settings file {path} is no TOML: {error}") from error
    return with_changes(values, changes)


def with_changes(values: dict[str, Any], changes: Mapping[str, Any]) -> TrainSettings:
    """Settings of nested ``values`` with ``changes`` on top. Raises TrainerError that names the field."""
    _set_all(values, changes)
    return checked_settings(values)


def checked_settings(values: Mapping[str, Any]) -> TrainSettings:
    """Settings of nested ``values``. Raises TrainerError that names the field."""
    try:
        return TrainSettings.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        if first["type"] == "extra_forbidden":
            raise TrainerError(f"there is no setting {where!r}: mend its name or leave it out") from error
        expected = first["msg"].removeprefix("Value error, ")
        expected = expected[:1].lower() + expected[1:]
        raise TrainerError(f"setting {where!r}: {expected} (found {first.get('input')!r})") from error


def _set_all(values: dict[str, Any], changes: Mapping[str, Any]) -> None:
    for key, value in changes.items():
        if value is not None:
            *parents, leaf = key.split(".")
            level = values
            for parent in parents:
                level = level.setdefault(parent, {})
                if not isinstance(level, dict):
                    raise TrainerError(f"setting {parent!r}: expected a table of settings (found {level!r})")
            level[leaf] = value


def _merge(values: dict[str, Any], more: Mapping[str, Any]) -> None:
    for key, value in more.items():
        if isinstance(value, dict) and isinstance(values.get(key), dict):
            _merge(values[key], value)
        else:
            values[key] = value
