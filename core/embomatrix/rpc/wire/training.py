"""Reports of training to wire messages and back; whatever is larger than a report may be is refused by its field."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from embomatrix.proto.v1 import rollout_service_pb2 as pb
from embomatrix.rpc.training import (
    FIGURES,
    MESSAGE_CHARS,
    NAME_CHARS,
    PLANS,
    TEXT_CHARS,
    RewardTiers,
    SampledPlan,
    SampledStep,
    TrainingReport,
)
from embomatrix.rpc.wire.rollout import ConvertError, each, finite, inside, required
from embomatrix.skills.syntax import MAX_STEPS

if TYPE_CHECKING:
    from collections.abc import Sized

T = TypeVar("T", bound="Sized")


def training_report_to_proto(run_id: str, report: TrainingReport) -> pb.ReportTrainingRequest:
    return pb.ReportTrainingRequest(
        run_id=run_id,
        phase=report.phase,
        step=report.step,
        figures=report.figures,
        plans=[_plan_to_proto(plan) for plan in report.plans],
    )


def training_report_from_proto(message: pb.ReportTrainingRequest) -> TrainingReport:
    _bounded("figures", message.figures, FIGURES)
    _bounded("plans", message.plans, PLANS)
    for name, value in message.figures.items():
        _bounded("figures", required("figures", name), NAME_CHARS)
        finite(f"figures[{name!r}]", value)
    phase = _bounded("phase", required("phase", message.phase), NAME_CHARS)
    return TrainingReport(
        phase, message.step, dict(message.figures), each("plans", _plan_from_proto, message.plans)
    )


def _plan_to_proto(plan: SampledPlan) -> pb.SampledPlan:
    told, reward = None, plan.reward
    if reward is not None:
        told = pb.RewardTiers(
            format=reward.format, relevance=reward.relevance, goal=reward.goal, success=reward.success
        )
    return pb.SampledPlan(
        task_id=_cut(plan.task_id, MESSAGE_CHARS),
        instruction=_cut(plan.instruction, TEXT_CHARS),
        text=_cut(plan.text, TEXT_CHARS),
        reward=told,
        advantage=plan.advantage,
        problem=_cut(plan.problem, MESSAGE_CHARS),
        steps=[
            pb.SampledStep(
                skill=_cut(step.skill, NAME_CHARS), ok=step.ok, message=_cut(step.message, MESSAGE_CHARS)
            )
            for step in plan.steps[:MAX_STEPS]
        ],
    )


def _cut(text: str, at_most: int) -> str:
    """The text's beginning, as the wire takes it: a model may write half a character."""
    return text[:at_most].encode("utf-8", "replace").decode("utf-8")


def _plan_from_proto(message: pb.SampledPlan) -> SampledPlan:
    _bounded("steps", message.steps, MAX_STEPS)
    return SampledPlan(
        task_id=_bounded("task_id", message.task_id, MESSAGE_CHARS),
        instruction=_bounded("instruction", message.instruction, TEXT_CHARS),
        text=_bounded("text", message.text, TEXT_CHARS),
        reward=inside("reward", _reward_from_proto, message.reward) if message.HasField("reward") else None,
        advantage=finite("advantage", message.advantage),
        problem=_bounded("problem", message.problem, MESSAGE_CHARS),
        steps=each("steps", _step_from_proto, message.steps),
    )


def _reward_from_proto(message: pb.RewardTiers) -> RewardTiers:
    format_, relevance, goal = (
        finite(name, getattr(message, name)) for name in ("format", "relevance", "goal")
    )
    return RewardTiers(format_, relevance, goal, message.success)


def _step_from_proto(message: pb.SampledStep) -> SampledStep:
    skill = _bounded("skill", message.skill, NAME_CHARS)
    return SampledStep(skill, message.ok, _bounded("message", message.message, MESSAGE_CHARS))


def _bounded(field: str, value: T, at_most: int) -> T:
    """The value, unless it is longer than it may be."""
    if len(value) > at_most:
        raise ConvertError(field, f"has a length of {len(value)}: at most {at_most}, tell less of it")
    return value
