"""Training reports of a trainer, and their conversion to and from protobuf.

A report beyond its size limits is rejected with the name of the field.
"""

import functools
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
TURN_CHARS: Final = 2000
"""Characters of an answer or an observation; the sender cuts longer ones."""
TURNS: Final = MAX_STEPS + 1
"""Answers of one episode at most: each has a call or counts as one, except the last."""


@dataclass(frozen=True, slots=True)
class SampledStep:
    """Executed skill call of a plan, with its outcome in words. ``call`` is the call as a line of a plan."""

    skill: str
    ok: bool
    message: str
    call: str = ""


@dataclass(frozen=True, slots=True)
class SampledTurn:
    """Answer of a policy in an episode, and the observation that it received. ``steps`` counts the answer's calls."""

    answer: str
    observation: str
    steps: int


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

    An episode has ``turns``, whose steps are ``steps`` in this order, the text ``opening`` before the first answer, and the
    reason ``end`` why it ended. A whole plan has none of them.
    """

    task_id: str
    instruction: str
    text: str
    reward: RewardTiers | None
    advantage: float
    problem: str = ""
    steps: tuple[SampledStep, ...] = ()
    turns: tuple[SampledTurn, ...] = ()
    opening: str = ""
    end: str = ""


@dataclass(frozen=True, slots=True)
class TrainingReport:
    """Figures of one step of a phase, ``grpo`` or ``imitation``, by name. A figure of a table is named ``table/name``."""

    phase: str
    step: int
    figures: Mapping[str, float] = field(default_factory=dict)
    plans: tuple[SampledPlan, ...] = ()


_step_to_proto, _step_from_proto = converters(SampledStep, pb.SampledStep)
_turn_to_proto, _turn_from_proto = converters(SampledTurn, pb.SampledTurn)
sampled_plan_to_proto, _plan_from_proto = converters(
    SampledPlan,
    pb.SampledPlan,
    parts={
        "reward": converters(RewardTiers, pb.RewardTiers),
        "steps": (_step_to_proto, _step_from_proto),
        "turns": (_turn_to_proto, _turn_from_proto),
    },
    absent={"reward": None},
)
_PLAN_CHARS: Final = {
    "task_id": MESSAGE_CHARS,
    "instruction": TEXT_CHARS,
    "text": TEXT_CHARS,
    "problem": MESSAGE_CHARS,
    "opening": TEXT_CHARS,
    "end": NAME_CHARS,
}
_STEP_CHARS: Final = {"skill": NAME_CHARS, "message": MESSAGE_CHARS, "call": MESSAGE_CHARS}
_TURN_CHARS: Final = {"answer": TURN_CHARS, "observation": TURN_CHARS}


def training_report_to_proto(run_id: str, report: TrainingReport) -> pb.ReportTrainingRequest:
    """Return the request. Texts, steps and turns of sampled plans beyond their limits are cut off."""
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
    turns = tuple(replace(turn, **_cut(turn, _TURN_CHARS)) for turn in plan.turns[:TURNS])
    return replace(plan, steps=steps, turns=turns, **_cut(plan, _PLAN_CHARS))


def _cut(value: SampledPlan | SampledStep | SampledTurn, limits: Mapping[str, int]) -> dict[str, Any]:
    """Return the texts within their limits. A model may emit half a surrogate pair, which becomes ``?``."""
    return {
        name: getattr(value, name)[:limit].encode("utf-8", "replace").decode("utf-8")
        for name, limit in limits.items()
    }


def sampled_plan_from_proto(message: pb.SampledPlan) -> SampledPlan:
    """Return the plan of a report or an archive. Raise ConvertError if a text or a list is too long."""
    _bounded("steps", message.steps, MAX_STEPS)
    _bounded("turns", message.turns, TURNS)
    _check_texts(_PLAN_CHARS, message)
    each("steps", functools.partial(_check_texts, _STEP_CHARS), message.steps)
    each("turns", functools.partial(_check_texts, _TURN_CHARS), message.turns)
    return _plan_from_proto(message)


def _check_texts(
    limits: Mapping[str, int], message: pb.SampledPlan | pb.SampledStep | pb.SampledTurn
) -> None:
    for name, limit in limits.items():
        _bounded(name, getattr(message, name), limit)


def _bounded(field: str, value: T, at_most: int) -> T:
    """Return the value. Raise ConvertError if its length exceeds the limit."""
    if len(value) > at_most:
        raise ConvertError(field, f"found a length of {len(value)}: expected at most {at_most}; send less")
    return value
