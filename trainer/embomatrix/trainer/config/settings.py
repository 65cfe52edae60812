"""Settings of a training run, parsed once from the command line, a TOML file or a checkpoint."""

import tomllib
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any, Final, Self
from urllib.parse import urlsplit

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from embomatrix.envs.rules import Visibility
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.skills.prompt import Codec
from embomatrix.trainer.config.errors import TrainerError


class LossKind(StrEnum):
    """Kind of loss: how the tokens' terms are averaged, and for GSPO the ratio too."""

    PAPER = "paper"  # mean over plans of one term each with ratio = "sequence" (the paper), else of the sum over tokens
    GRPO = "grpo"  # mean over a plan's tokens, then over plans: DeepSeekMath
    BNPO = "bnpo"  # mean over the tokens of each microbatch, then over microbatches
    DAPO = "dapo"  # mean over all tokens of the step: a plan's weight grows with its length
    DR_GRPO = "dr_grpo"  # sum over tokens / (plans * longest allowed plan): length has no influence
    GSPO = "gspo"  # like GRPO, with the geometric mean of a plan's token ratios in place of each ratio


class RatioLevel(StrEnum):
    """Level of the importance ratio (new probability / old probability)."""

    TOKEN = "token"
    SEQUENCE = "sequence"  # product over a plan's tokens: the formula of the paper
    MEAN = "mean"  # geometric mean over a plan's tokens: GSPO


class Overlap(StrEnum):
    """Work of the trainer while the cluster simulates."""

    NONE = "none"  # none: wait for all rewards of a step, then update
    STREAM = "stream"  # sample and back-propagate groups while others are simulated
    AHEAD = "ahead"  # also sample the next step's batch, from weights that are one step old


class SeedPer(StrEnum):
    """Time for which a task keeps the seed of its rollouts."""

    TASK = "task"  # the whole run: later epochs share calls with earlier ones, but one draw can be learnt by heart
    EPOCH = "epoch"  # one pass over all tasks


class TrackerKind(StrEnum):
    """Experiment trackers."""

    TENSORBOARD = "tensorboard"
    WANDB = "wandb"
    TRACKIO = "trackio"


class OptimiserKind(StrEnum):
    """Optimiser of imitation."""

    ADAMW = "adamw"
    MUON = "muon"  # for the matrices of linear layers; AdamW for all other parameters


class ComputeDtype(StrEnum):
    """Data type of the matrix products in linear layers. Weights that learn, their gradients and sums are in float32.

    On a CPU attention and the output layer are in float32 too. On a GPU a language model computes in torch's automatic mixed
    precision; the word-level policy stays in float32 with ``AUTO``.
    """

    AUTO = "auto"  # bfloat16 on CPUs with instructions for it and for language models on GPUs, else float32
    BFLOAT16 = "bfloat16"
    FLOAT32 = "float32"


class OnLost(StrEnum):
    """Treatment of a group that lost a rollout to the infrastructure."""

    GROUP = "group"  # leave out the whole group
    PARTIAL = "partial"  # leave out the lost rollout only


class ZeroVariance(StrEnum):
    """Treatment of a group whose rewards are all equal. Its advantages are 0, but not its KL and entropy terms."""

    SKIP = "skip"  # leave out the group: no forward and no backward pass
    KEEP = "keep"  # learn its KL and entropy terms, as TRL does


class Overlong(StrEnum):
    """Treatment of a plan that ``grpo.max_new`` cut off before its end token, or of an episode that the context cut off."""

    KEEP = "keep"  # learn from it as from any other plan
    MASK = "mask"  # leave its tokens out of the loss (DAPO's overlong filtering); its reward stays in the group's mean


class ServerKind(StrEnum):
    """Model server that samples plans."""

    VLLM = "vllm"
    SGLANG = "sglang"


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class TinySettings(_Frozen):
    """Shape of the word-level policy that is trained from scratch."""

    layers: int = Field(default=4, ge=1)
    width: int = Field(default=128, ge=16)
    heads: int = Field(default=4, ge=1)
    inner: int = Field(default=384, ge=16)


class EpisodeSettings(_Frozen):
    """Episodes instead of whole plans: the policy answers call by call, and is told what happened."""

    visibility: Visibility | None = None
    """``full``: the policy is told of all objects; ``seen``: of those that the robot has seen. None: it writes whole plans."""
    calls_factor: float = Field(default=2.0, ge=1)
    """Budget of calls: this many times those of the oracle plan, and ``calls_more``."""
    calls_more: int = Field(default=12, ge=0)
    call_cost: float = Field(default=0.0, ge=0)
    """Subtracted from an episode's reward for each call."""
    failure_cost: float = Field(default=0.0, ge=0)
    """Subtracted from an episode's reward for each failed call, besides ``call_cost``."""
    answer_tokens: int = Field(default=64, ge=1)
    """Maximum tokens of a language model's answer. Longer ones are cut off, and what they say up to there is carried out."""
    step_weight: float = Field(default=0.0, ge=0)
    """Weight of step advantages in GRPO: of each answer among those in equal states (GiGPO, Feng et al. 2025). 0: none."""
    step_discount: float = Field(default=0.95, gt=0, le=1)
    """An answer's return is the episode's reward, discounted by this factor with each answer that follows."""
    teacher_rounds: int = Field(default=0, ge=0, le=100)
    """Rounds of teaching, at equal distances within imitation: the policy begins episodes, the oracle finishes them from
    wherever that led, and what the oracle did is imitated from then on (DAgger, Ross et al. 2011).
    """
    teacher_episodes: int = Field(default=256, ge=1)
    """Episodes of a round, each of another task, as far as there are so many."""

    @field_validator("teacher_rounds")
    @classmethod
    def _check_rounds(cls, value: int, info: ValidationInfo) -> int:
        if value and info.data.get("visibility", ...) is None:
            raise ValueError(
                "expected 0 without episodes, because the oracle takes over within them: set episodes.visibility "
                "(--episodes), or leave it out"
            )
        return value


class LoraSettings(_Frozen):
    """Low-rank adapters for a Hugging Face model. The model's own weights stay frozen."""

    rank: int = Field(default=0, ge=0)
    """0: no adapters, all weights learn."""
    alpha: float = Field(default=32.0, gt=0)
    """The adapters' output is scaled by alpha / rank."""
    targets: tuple[str, ...] = ()
    """Last parts of the names of the linear layers to adapt. Empty: all except the output layer."""


def _is_http_address(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:  # a port above 65535, or half of an IPv6 address
        return False


class SamplerSettings(_Frozen):
    """Model server that samples the plans of a Hugging Face model."""

    url: str = ""
    """Address, such as ``http://127.0.0.1:8000``. Empty: the trainer's process samples."""
    kind: ServerKind = ServerKind.VLLM
    folder: str = ""
    """Folder for weights on their way to the server, which reads it by this path. Empty: ``sampler`` in the run's folder."""
    timeout_s: float = Field(default=600.0, gt=0)
    """Seconds that one request may take."""
    retry_s: float = Field(default=300.0, ge=0)
    """Seconds for which the run waits for a server that is away or fails, before it ends."""
    tolerance: float = Field(default=0.25, gt=0)
    """Largest mean difference in nats between the server's log-probabilities and the trainer's, in the check at the start."""

    @field_validator("url")
    @classmethod
    def _check_url(cls, value: str) -> str:
        if value and not _is_http_address(value):
            raise ValueError("expected an address such as http://127.0.0.1:8000")
        return value.rstrip("/").removesuffix("/v1")


class PromptSettings(_Frozen):
    """Contents of prompts, and their variation during training."""

    rows: int = Field(default=16, ge=1)
    """Maximum rows of the object table. Rows that the instruction names come first.

    If it is not given, a new run takes the fewest rows that hold the objects of every oracle plan for training.
    """
    rename_share: float = Field(default=0.0, ge=0, le=1)
    """Share of imitation examples with renamed object categories (word-level policy only). The default keeps the tasks' own
    words.
    """
    practice_rename_share: float = Field(default=0.0, ge=0, le=1)
    """The same share in GRPO."""
    drop_share: float = Field(default=0.7, ge=0, le=1)
    """Imitation leaves out up to this share of the rows that the oracle plan does not use."""


class ImitationSettings(_Frozen):
    """Teacher forcing on the oracle plans, before GRPO."""

    seconds: float = Field(default=150.0, ge=0)
    steps: int | None = Field(default=None, ge=0)
    """Number of steps. Overrides ``seconds``."""
    batch: int = Field(default=32, ge=1)
    """Plans per step."""
    chunk: int | None = Field(default=16, ge=1)
    """Plans per forward pass, the microbatches of a step. Gradients accumulate over them, which bounds memory. None: the whole
    batch.
    """
    optimiser: OptimiserKind = OptimiserKind.MUON
    learning_rate: float = Field(default=2e-3, gt=0)
    """Learning rate of AdamW."""
    matrix_learning_rate: float = Field(default=0.02, gt=0)
    """Learning rate of Muon."""
    warmup_steps: int = Field(default=20, ge=0)
    weight_decay: float = Field(default=0.01, ge=0)
    patience: int = Field(default=0, ge=0)
    """Early stopping: evaluations without a lower validation loss before imitation ends and the best weights are restored.

    The mean loss over the last ``patience`` evaluations must also not be below the mean over the ``patience`` before
    them. 0: no early stopping, and no task is held back.
    """
    validation_share: float = Field(default=0.05, gt=0, lt=1)
    """Share of the training tasks that is held back for validation."""
    validate_every: int = Field(default=100, ge=1)
    """Steps between two evaluations."""
    checkpoint_seconds: float = Field(default=60.0, gt=0)
    """Seconds between two checkpoints."""


class GrpoSettings(_Frozen):
    """Group relative policy optimisation. The paper publishes no values for these constants."""

    minutes: float = Field(default=5.0, ge=0)
    steps: int | None = Field(default=None, ge=0)
    """Number of steps. Overrides ``minutes``."""
    tasks_per_step: int = Field(default=16, ge=1)
    group: int = Field(default=8, ge=2)
    """Plans per task: G."""
    chunk: int = Field(default=8, ge=1)
    """Tasks per microbatch. Its plans go to the cluster while the next microbatch is sampled."""
    updates_per_batch: int = Field(default=1, ge=1)
    """Passes over a step's plans. The ratio's denominator stays the policy that sampled them."""
    minibatches: int = Field(default=1, ge=1)
    """Optimiser steps per pass, at most ``tasks_per_step``. Each pass divides the groups anew, in a seeded order.

    With more than one, the first update begins when all rewards of the step are there.
    """
    learning_rate: float = Field(default=4e-4, gt=0)
    warmup_steps: int = Field(default=20, ge=0)
    """Steps of linear warm-up. Adam's first steps have full length for any gradient: without warm-up, the first small batches
    undo imitation.
    """
    final_learning_rate_share: float = Field(default=0.2, gt=0, le=1)
    """The learning rate decays linearly to this share of itself."""
    temperature: float = Field(default=1.0, gt=0)
    max_new: int = Field(default=72, ge=1)
    """Maximum tokens of a plan. If it is not given, a new run takes 1.5 times the longest oracle plan for training."""
    overlong: Overlong = Overlong.KEEP
    """Plans that ``max_new`` cut off."""
    loss: LossKind = LossKind.DAPO
    ratio: RatioLevel = RatioLevel.TOKEN
    clip_low: float = Field(default=0.2, gt=0, lt=1)
    clip_high: float = Field(default=0.28, gt=0)
    """Upper clip. Above ``clip_low`` it lets the probability of rare tokens grow (DAPO)."""
    kl_coef: float = Field(default=0.02, ge=0)
    """Weight of the KL divergence to the policy after imitation: the paper's beta."""
    entropy_coef: float = Field(default=0.0, ge=0)
    spread_floor: float = Field(default=1.0, gt=0)
    """Reward units added to a group's standard deviation before the division by it.

    At 1, a group that differs only by a touched object weighs a tenth of a group in which some plans reach the goal.
    Near 0, as in the paper, both weigh the same.
    """
    max_grad_norm: float = Field(default=1.0, gt=0)
    lookahead: int = Field(default=3, ge=0)
    """Steps that are announced to the cluster ahead of time."""
    seed_per: SeedPer = SeedPer.EPOCH
    """Time for which a task keeps the seed of its rollouts."""
    on_lost: OnLost = OnLost.GROUP
    zero_variance: ZeroVariance = ZeroVariance.SKIP
    """Groups whose rewards are all equal. ``LANGUAGE_MODEL_DEFAULTS`` keep them. A ``reserve`` replaces them in any case."""
    overlap: Overlap = Overlap.STREAM
    truncate_ratio: float | None = Field(default=None, ge=1)
    """Truncated importance sampling: largest weight of plans from older weights (``Overlap.AHEAD``) or from a model server.

    The ratio's denominator is then the policy at the beginning of the step, and the weight is the probability under it
    over that under the sampling policy. None: off, or ``SERVER_TRUNCATE_RATIO`` with a model server.
    """
    reserve: int = Field(default=0, ge=0)
    """Dynamic sampling: maximum tasks per step that replace zero-variance groups."""
    curriculum_tasks: int = Field(default=0, ge=0)
    """Number of draws over which the task pool grows from the shortest plans to all tasks. 0: no curriculum."""
    curriculum_start: float = Field(default=0.25, gt=0, le=1)
    """Initial share of the tasks in the pool."""
    relevance: float = Field(default=1.0, ge=0)
    """Weight of the reward's relevance tier in the advantage. 0 leaves the tier out."""
    relevance_final: float | None = Field(default=None, ge=0)
    """Weight at the end of the budget, reached linearly. None: constant."""

    @field_validator("minibatches")
    @classmethod
    def _check_minibatches(cls, value: int, info: ValidationInfo) -> int:
        tasks = info.data.get("tasks_per_step", value)
        if value > tasks:
            raise ValueError(
                f"expected at most {tasks}, the value of grpo.tasks_per_step, because a minibatch has at least one task: "
                "lower it, or raise grpo.tasks_per_step"
            )
        return value

    @property
    def ratio_level(self) -> RatioLevel:
        """Level of the importance ratio. GSPO is defined with the geometric mean."""
        return RatioLevel.MEAN if self.loss is LossKind.GSPO else self.ratio

    @property
    def keeps_zero_variance_groups(self) -> bool:
        """True if zero-variance groups stay in the update. Without KL and entropy terms their gradient would be 0."""
        has_terms = self.kl_coef > 0 or self.entropy_coef > 0
        return self.zero_variance is ZeroVariance.KEEP and has_terms and not self.reserve


class RewardCoefficients(_Frozen):
    """Coefficients of the reward's tiers, which the cluster applies to this run's plans. 0 leaves a tier out."""

    unparsable: float = PAPER.unparsable
    format: float = PAPER.format
    relevance_per_object: float = PAPER.relevance_per_object
    relevance_limit: float = PAPER.relevance_limit
    goal: float = PAPER.goal

    @model_validator(mode="after")
    def _check(self) -> Self:
        self.settings()
        return self

    def settings(self) -> RewardSettings:
        return RewardSettings(**self.model_dump())


class EvaluationSettings(_Frozen):
    """Evaluation on held-out tasks."""

    tasks: int | None = Field(default=None, ge=1)
    """Held-out tasks that all evaluations of a run use, drawn by its seed. None: all."""
    samples: int = Field(default=10, ge=1)
    """Plans per task before and after GRPO."""
    every: int = Field(default=0, ge=0)
    """Steps of GRPO between evaluations during it. 0: none."""
    samples_during: int = Field(default=4, ge=1)
    """Plans per task in the evaluations during GRPO."""
    temperature: float = Field(default=1.0, ge=0)
    chunk: int = Field(default=8, ge=1)


class TrainSettings(_Frozen):
    """Settings of one training run."""

    model: str = "tiny"
    """``tiny``, or a Hugging Face model by name or folder."""
    codec: Codec = Codec.LINES
    """Plan format of a Hugging Face model: ``lines`` or ``json``. The word-level policy always uses ``names``."""
    seed: int = 0
    threads: int = Field(default=1, ge=1)
    """Torch threads per process."""
    processes: int = Field(default=1, ge=1)
    """Data-parallel processes on a CPU. The result is bit-identical for any number.

    Processes beyond the number of microbatches of a step stay idle.
    """
    device: str = "cpu"
    checkpoint_every: int = Field(default=50, ge=1)
    keep_checkpoints: int = Field(default=2, ge=1)
    track: tuple[TrackerKind, ...] = ()
    """Experiment trackers that also receive the metrics."""
    samples_every: int = Field(default=10, ge=1)
    """Steps between two groups in the sample log."""
    gradient_checkpointing: bool = False
    """Hugging Face models: keep only the layers' inputs for the backward pass and recompute the rest."""
    compute_dtype: ComputeDtype = ComputeDtype.AUTO
    tiny: TinySettings = TinySettings()
    lora: LoraSettings = LoraSettings()
    sampler: SamplerSettings = SamplerSettings()
    prompt: PromptSettings = PromptSettings()
    episodes: EpisodeSettings = EpisodeSettings()
    imitation: ImitationSettings = ImitationSettings()
    grpo: GrpoSettings = GrpoSettings()
    reward: RewardCoefficients = RewardCoefficients()
    evaluation: EvaluationSettings = EvaluationSettings()

    @field_validator("device")
    @classmethod
    def _check_device(cls, value: str, info: ValidationInfo) -> str:
        processes = info.data.get("processes", 1)
        if processes > 1 and value != "cpu":
            raise ValueError(
                f"expected cpu with processes = {processes}, which share the weights in its memory: set processes to 1, or "
                "leave the device out"
            )
        return value


SERVER_TRUNCATE_RATIO: Final = 2.0
"""Default of ``grpo.truncate_ratio`` with a model server, whose arithmetic differs from the trainer's."""
LANGUAGE_MODEL_DEFAULTS: Final[Mapping[str, Any]] = {
    "imitation.batch": 4,
    "imitation.chunk": 1,
    "imitation.optimiser": "adamw",
    "imitation.learning_rate": 5e-5,
    "grpo.tasks_per_step": 4,
    "grpo.chunk": 1,
    "grpo.learning_rate": 1e-5,
    "grpo.zero_variance": "keep",
}
"""Defaults that differ for a pretrained model: it needs more memory, and TRL's updates keep zero-variance groups."""


def read_settings(
    path: Path | None, changes: Mapping[str, Any], defaults: Mapping[str, Any] | None = None
) -> TrainSettings:
    """Merge ``defaults``, then a TOML file, then ``changes`` (dotted keys; None: not given). Raises TrainerError."""
    values: dict[str, Any] = {}
    _set_all(values, defaults or {})
    if path is not None:
        _merge(values, read_toml(path))
    return with_changes(values, changes)


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file of settings. Raises TrainerError."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise TrainerError(
            f"the settings file {path} can't be read ({error.strerror}): expected a TOML file"
        ) from error
    except (ValueError, RecursionError) as error:
        raise TrainerError(f"the settings file {path} is not valid TOML ({error}): fix the file") from error


def with_changes(values: dict[str, Any], changes: Mapping[str, Any]) -> TrainSettings:
    """Apply ``changes`` to nested ``values``. Raises TrainerError that names the field."""
    _set_all(values, changes)
    return checked_settings(values)


def checked_settings(values: Mapping[str, Any]) -> TrainSettings:
    """Validate nested ``values``. Raises TrainerError that names the field."""
    try:
        settings = TrainSettings.model_validate(values)
    except ValidationError as error:
        raise settings_error(error) from error
    _check_teaching(settings)
    if settings.episodes.visibility is not None and settings.sampler.url:
        raise TrainerError(
            "setting 'sampler.url': expected none in episodes, because the server samples whole plans: leave it or "
            f"episodes.visibility out (found {settings.sampler.url!r})"
        )
    return _with_server(settings) if settings.sampler.url else _without_server(settings)


def _check_teaching(settings: TrainSettings) -> None:
    """Raise TrainerError for rounds of teaching that imitation has no room for, or with early stopping."""
    rounds, imitation = settings.episodes.teacher_rounds, settings.imitation
    if not rounds:
        return
    if imitation.steps is not None and imitation.steps <= rounds:
        raise TrainerError(
            f"setting 'episodes.teacher_rounds': expected fewer than the {imitation.steps} steps of imitation, because "
            f"at least one step belongs between two rounds: lower it, or raise imitation.steps (found {rounds})"
        )
    if imitation.steps is None and imitation.seconds == 0:
        raise TrainerError(
            "setting 'episodes.teacher_rounds': expected 0 without imitation, because its steps learn what is taught: leave it "
            f"out, or raise imitation.seconds (found {rounds})"
        )
    if imitation.patience:
        raise TrainerError(
            "setting 'episodes.teacher_rounds': expected imitation.patience = 0 with it, because the validation loss knows the "
            f"oracle's own episodes only: leave one of them out (found {imitation.patience})"
        )


def _with_server(settings: TrainSettings) -> TrainSettings:
    """Return the settings with ``SERVER_TRUNCATE_RATIO`` unless another ratio is given. Raises TrainerError."""
    if settings.processes > 1:
        raise TrainerError(
            f"setting 'processes': expected 1 with sampler.url, because the server samples all plans at once (found "
            f"{settings.processes}): leave one of them out"
        )
    if settings.grpo.truncate_ratio is not None:
        return settings
    grpo = settings.grpo.model_copy(update={"truncate_ratio": SERVER_TRUNCATE_RATIO})
    return settings.model_copy(update={"grpo": grpo})


def _without_server(settings: TrainSettings) -> TrainSettings:
    """Return the settings. Raises TrainerError for truncated importance sampling of plans that the policy itself sampled."""
    grpo = settings.grpo
    if grpo.truncate_ratio is not None and grpo.overlap is not Overlap.AHEAD:
        raise TrainerError(
            f"setting 'grpo.truncate_ratio': expected none (found {grpo.truncate_ratio:g}), because the policy that learns "
            f"samples the plans itself with grpo.overlap = {grpo.overlap.value!r}: leave it out, or set grpo.overlap = 'ahead' "
            "or sampler.url"
        )
    return settings


def settings_error(error: ValidationError) -> TrainerError:
    """Return an error about the first wrong setting, with its name."""
    first = error.errors()[0]
    where = ".".join(map(str, first["loc"]))
    if first["type"] == "extra_forbidden":
        return TrainerError(f"unknown setting {where!r}: correct its name or remove it")
    expected = first["msg"].removeprefix("Value error, ")
    expected = expected[:1].lower() + expected[1:]
    return TrainerError(f"setting {where!r}: {expected} (found {first.get('input')!r})")


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
