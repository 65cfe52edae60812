"""Training reports of an archived run, and their conversion to and from protobuf."""

import math
from typing import Final

from embomatrix.manager.observe.training_reports import (
    PHASES_KEPT,
    STEPS_KEPT,
    Curves,
    TrainingDetail,
    TrainingView,
)
from embomatrix.proto.v1 import admin_service_pb2 as pb
from embomatrix.rpc.wire.codec import ConvertError, each, finite
from embomatrix.rpc.wire.training import (
    FIGURES,
    PLANS,
    sampled_plan_from_proto,
    sampled_plan_to_proto,
)

_MOST: Final = {"phases": PHASES_KEPT, "plans": PLANS}
"""Longest lists that a manager archives, by field."""


def kept_training_to_proto(detail: TrainingDetail) -> pb.KeptTraining:
    message = pb.KeptTraining(
        phase=detail.run.phase,
        step=detail.run.step,
        reported_s=detail.run.reported_s,
        plans_step=detail.plans_step,
        plans=map(sampled_plan_to_proto, detail.plans),
    )
    for curves in detail.phases:
        phase = message.phases.add(phase=curves.phase, steps=curves.steps)
        for name, values in curves.figures.items():
            phase.curves.add(name=name, values=[math.nan if value is None else value for value in values])
    return message


def kept_training_from_proto(message: pb.KeptTraining, run_id: str, name: str) -> TrainingDetail:
    """Return the reports of the archived run. Raise ConvertError for lists that are too long or of unequal length."""
    for field, most in _MOST.items():
        _at_most(field, len(getattr(message, field)), most)
    reported_s = finite("reported_s", message.reported_s)
    return TrainingDetail(
        TrainingView(run_id, name, message.phase, message.step, reported_s, 1),
        list(each("phases", _curves_from_proto, message.phases)),
        message.plans_step,
        list(each("plans", sampled_plan_from_proto, message.plans)),
    )


def _curves_from_proto(message: pb.KeptPhase) -> Curves:
    _at_most("steps", len(message.steps), STEPS_KEPT)
    _at_most("curves", len(message.curves), FIGURES)
    figures: dict[str, list[float | None]] = {}
    for curve in message.curves:
        if len(curve.values) != len(message.steps):
            raise ConvertError(
                f"curves[{curve.name[:80]!r}]",
                f"found {len(curve.values)} values: expected one for each of {len(message.steps)} steps",
            )
        figures[curve.name] = [value if math.isfinite(value) else None for value in curve.values]
    return Curves(message.phase, list(message.steps), figures)


def _at_most(field: str, found: int, most: int) -> None:
    if found > most:
        raise ConvertError(field, f"found {found} elements: expected at most {most}")
