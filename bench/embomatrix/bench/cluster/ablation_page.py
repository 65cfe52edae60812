"""The ablation as the paper shows it, for the page of benchmarks: a row for each thing that is added."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.bench.cluster.ablation import DELAY_S
from embomatrix.pages.figures import shown

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from embomatrix.pages.figures import Figure


@dataclass(frozen=True, slots=True)
class AblationRow:
    """One row: its words, the paper's seconds where it has them, and the figures that stand in it."""

    words: str
    paper_s: float | None
    name: str
    slow_name: str = ""


USER: Final = AblationRow("as a user would write it, estimated", None, "ablation_user_ms")
ROWS: Final = (
    AblationRow("naive", 3.48, "ablation_naive_ms", "ablation_naive_slow_ms"),
    AblationRow("+ pre-cached execution", 0.85, "ablation_cached_ms", "ablation_cached_slow_ms"),
    AblationRow("+ Resource-Scheduler", 0.14, "ablation_scheduler_ms", "ablation_scheduler_slow_ms"),
    AblationRow("+ Task-Dispatcher", 0.07, "ablation_dispatcher_ms", "ablation_dispatcher_slow_ms"),
)
"""The rows of EmboMatrix's table on the efficiency of simulation."""
EXPLANATION: Final = (
    "Mean latency of a rollout, as in the paper's table, on the plans of the pinned workload in its scenes of about "
    "300 bodies. *Naive*: one process decodes the bundle, loads the scene and executes the plan in physical mode, for "
    "every rollout anew, with our loader and with what rests asleep. *As a user would write it*: every object from a "
    "URDF of its own by `loadURDF`, nothing ever asleep, steps of 1/240 s. Such a rollout takes minutes: it is the "
    "measured loading, and the measured cost of a step times the steps of the naive rollout, without the robot's "
    "motions. *Pre-cached*: the same in cached mode, in physics clients that stay connected. *Resource-Scheduler*: a "
    "manager and a worker with two slots, all scenes announced and warm; one rollout is submitted when the one before "
    "it has its result; the latency is from submission to result, with all that gRPC and the state store cost. "
    "*Task-Dispatcher*: the same, all plans submitted as one batch; the latency is the time until the last result "
    "over the number of rollouts, each plan executed once, in slots that have executed ten others of each scene. "
    f"*With loading slowed* by {DELAY_S:g} s, what it costs in the paper: the first two rows are the measured mean and "
    "that wait; in the last two a trainer announces two steps ahead, waits 1.5 such loads between the announcement "
    "and the submission of a step, which is not counted, and submits two scenes a step. The gain counts the slots as "
    "well: *equal cores* in the table below is the ratio with the naive row's work shared by as many cores without "
    "loss."
)


def ablation_lines(figures: Sequence[Figure]) -> list[str]:
    """The table in Markdown; nothing when the rows were not measured."""
    values = {figure.name: figure.value for figure in figures}
    rows = [row for row in ROWS if row.name in values]
    if not rows:
        return []
    first_ms = values[rows[0].name]
    slow_ms = values.get(rows[0].slow_name)
    lines = [
        "| | paper, s | ratio | ours, ms | ratio | ours with loading slowed, ms | ratio |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for row in ((USER,) if USER.name in values else ()) + tuple(rows):
        paper = (
            f"{row.paper_s:g} | {ROWS[0].paper_s / row.paper_s:.3g} ×"
            if row.paper_s and ROWS[0].paper_s
            else " | "
        )
        cells = [paper, _ours(values, row.name, first_ms), _ours(values, row.slow_name, slow_ms)]
        lines.append(f"| {row.words} | {' | '.join(cells)} |")
    return lines


def _ours(values: Mapping[str, float], name: str, first_ms: float | None) -> str:
    if name not in values or first_ms is None:
        return " | "
    return f"{shown(values[name])} | {shown(first_ms / values[name])} ×"
