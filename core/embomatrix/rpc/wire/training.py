"""Training reports of a trainer, and their conversion to and from protobuf.

A report beyond its size limits is rejected with the name of the field.
"""

from collections.abc import Mapping, Sized
from dataclasses import dataclass, field, replace
from typing import Any, Final, TypeVar

from embomatrix.proto.v1 import rollout_service_pb2 as pb
from embomatrix.rpc.wire.codec import ConvertError, converters, each, finite, required
from embomatrix.skills.syntax import MAX_STEPS

T = TypeVar("T", bound="Sized")

FIGURES: Final = 64
"""Figures of one report, and of one phase, at most."""
PLANS: Final = 8
"""Sampled plans of one report at most."""
NAME_CHARS: Final = 64
"""Characters of a phase's or figure's name at most."""
TEXT_CHARS: Final = 4000
"""Characters of a plan or an instruction; the sender cuts longer ones."""
MESSAGE_CHARS: Final = 500


@dataclass(frozen=True, slots=True)
class SampledStep:
    """Executed skill call of a plan, with its outcome in words."""

    skill: str
    ok: bool
    message: str


@dataclass(frozen=True, slots=True)
class RewardTiers:
    """Reward of a plan by tier: format, relevance and goal."""

    format: float
    relevance: float
    goal: float
    success: bool


@dataclass(frozen=True, slots=True)
class SampledPlan:
    """Plan that a policy wrote. ``reward`` is None if the rollout ended in an infrastructure failure.

    ``advantage`` is relative to the group, in standard deviations. ``problem`` says why there was nothing to execute, or why
    there is no result.
    """

    task_id: str
    instruction: str
    text: str
    reward: RewardTiers | None
    advantage: float
    problem: str = ""
    steps: tuple[SampledStep, ...] = ()


@dataclass(frozen=True, slots=True)
class TrainingReport:
    """Figures of one step of a phase, ``grpo`` or ``imitation``, by name. A figure of a table is named ``table/name``."""

    phase: str
    step: int
    figures: Mapping[str, float] = field(default_factory=dict)
    plans: tuple[SampledPlan, ...] = ()


_step_to_proto, _step_from_proto = converters(SampledStep, pb.SampledStep)
sampled_plan_to_proto, _plan_from_proto = converters(
    SampledPlan,
    pb.SampledPlan,
    parts={
        "reward": converters(RewardTiers, pb.RewardTiers),
        "steps": (_step_to_proto, _step_from_proto),
    },
    absent={"reward": None},
)
_PLAN_CHARS: Final = {
    "task_id": MESSAGE_CHARS,
    "instruction": TEXT_CHARS,
    "text": TEXT_CHARS,
    "problem": MESSAGE_CHARS,
}
_STEP_CHARS: Final = {"skill": NAME_CHARS, "message": MESSAGE_CHARS}


def training_report_to_proto(run_id: str, report: TrainingReport) -> pb.ReportTrainingRequest:
    """Return the request. Texts and steps of sampled plans beyond their limits are cut off."""
    return pb.ReportTrainingRequest(
        run_id=run_id,
        phase=report.phase,
        step=report.step,
        figures=report.figures,
        plans=[sampled_plan_to_proto(_cut_plan(plan)) for plan in report.plans],
    )


def training_report_from_proto(message: pb.ReportTrainingRequest) -> TrainingReport:
    _bounded("figures", message.figures, FIGURES)
    _bounded("plans", message.plans, PLANS)
    for name, value in message.figures.items():
        _bounded("figures", required("figures", name), NAME_CHARS)
        finite(f"figures[{name!r}]", value)
    phase = _bounded("phase", required("phase", message.phase), NAME_CHARS)
    return TrainingReport(
        phase, message.step, dict(message.figures), each("plans", sampled_plan_from_proto, message.plans)
    )


def _cut_plan(plan: SampledPlan) -> SampledPlan:
    steps = tuple(replace(step, **_cut(step, _STEP_CHARS)) for step in plan.steps[:MAX_STEPS])
    return replace(plan, steps=steps, **_cut(plan, _PLAN_CHARS))


def _cut(value: SampledPlan | SampledStep, limits: Mapping[str, int]) -> dict[str, Any]:
    """Return the texts within their limits. A model may emit half a surrogate pair, which becomes ``?``."""
    return {
        name: getattr(value, name)[:limit].encode("utf-8", "replace").decode("utf-8")
        for name, limit in limits.items()
    }


def sampled_plan_from_proto(message: pb.SampledPlan) -> SampledPlan:
    """Return the plan of a report or an archive. Raise ConvertError if a text or the list of steps is too long."""
    _bounded("steps", message.steps, MAX_STEPS)
    for name, limit in _PLAN_CHARS.items():
        _bounded(name, getattr(message, name), limit)
    return replace(_plan_from_proto(message), steps=each("steps", _checked_step, message.steps))


def _checked_step(message: pb.SampledStep) -> SampledStep:
    for name, limit in _STEP_CHARS.items():
        _bounded(name, getattr(message, name), limit)
    return _step_from_proto(message)


def _bounded(field: str, value: T, at_most: int) -> T:
    """Return the value. Raise ConvertError if its length exceeds the limit."""
    if len(value) > at_most:
        raise ConvertError(field, f"found a length of {len(value)}: expected at most {at_most}; send less")
    return value
