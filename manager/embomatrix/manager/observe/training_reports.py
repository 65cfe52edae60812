"""Training reports of the latest runs: learning curves and sampled plans, in bounded memory.

Those of closed runs are archived. Those of open runs are not stored: after a restart the curves continue from the next report.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from embomatrix.rpc.wire.training import FIGURES, PLANS, SampledPlan, TrainingReport

RUNS_KEPT: Final = 16
PHASES_KEPT: Final = 4
"""Phases of one run at most: imitation, GRPO, and evaluations before and after it."""
STEPS_KEPT: Final = 512
"""Steps of one phase at most. Beyond it every second step is dropped, so that a long run keeps its whole curve."""


@dataclass(frozen=True, slots=True)
class TrainingView:
    """Run with training reports. ``revision`` grows with every report; ``reported_s`` is seconds since the epoch."""

    run_id: str
    name: str
    phase: str
    step: int
    reported_s: float
    revision: int


@dataclass(frozen=True, slots=True)
class Curves:
    """Figures of a phase by name, each as long as ``steps``; None for steps without the figure."""

    phase: str
    steps: list[int]
    figures: dict[str, list[float | None]]

    @property
    def last_step(self) -> int:
        """Number of the last reported step; 0 without any. A phase may report only some of its steps."""
        return max(self.steps, default=0)

    def latest(self, name: str, steps: int) -> float | None:
        """Return the mean of the latest values of a figure, at most ``steps``; None without any."""
        values = [value for value in self.figures.get(name, ()) if value is not None][-steps:]
        return sum(values) / len(values) if values else None


@dataclass(slots=True)
class TrainingDetail:
    """All reports of a run. ``plans`` belong to step ``plans_step``."""

    run: TrainingView
    phases: list[Curves] = field(default_factory=list)
    plans_step: int = 0
    plans: list[SampledPlan] = field(default_factory=list)


class TrainingBook:
    """Runs by id, latest report last. Beyond ``RUNS_KEPT`` the first run is dropped."""

    def __init__(self) -> None:
        self._runs: dict[str, TrainingDetail] = {}

    def note(self, run_id: str, name: str, report: TrainingReport, *, at_s: float) -> None:
        """Add a report. A repeated step is updated; a lower step discards all later ones."""
        first = TrainingDetail(TrainingView(run_id, name, "", 0, 0.0, 0))
        detail = self._runs[run_id] = self._runs.pop(run_id, first)
        while len(self._runs) > RUNS_KEPT:
            del self._runs[next(iter(self._runs))]
        if report.figures:
            curves = next((known for known in detail.phases if known.phase == report.phase), None)
            if curves is None and len(detail.phases) < PHASES_KEPT:
                curves = Curves(report.phase, [], {})
                detail.phases.append(curves)
            if curves is not None:
                _add(curves, report.step, report.figures)
        if report.plans:
            detail.plans, detail.plans_step = list(report.plans[:PLANS]), report.step
        revision = detail.run.revision + 1
        detail.run = replace(
            detail.run, phase=report.phase, step=report.step, reported_s=at_s, revision=revision
        )

    def views(self) -> list[TrainingView]:
        """Return the runs, latest report first."""
        return [detail.run for detail in reversed(self._runs.values())]

    def find(self, run_id: str) -> TrainingDetail | None:
        """Return all reports of a run, which later reports change; None if it has none, or none are left."""
        return self._runs.get(run_id)

    def copy_of(self, run_id: str) -> TrainingDetail | None:
        """Return a copy that later reports do not change."""
        detail = self._runs.get(run_id)
        if detail is None:
            return None
        phases = [
            Curves(
                curves.phase, list(curves.steps), {name: list(row) for name, row in curves.figures.items()}
            )
            for curves in detail.phases
        ]
        return replace(detail, phases=phases, plans=list(detail.plans))


def _add(curves: Curves, step: int, figures: Mapping[str, float]) -> None:
    while curves.steps and curves.steps[-1] > step:
        for row in _rows(curves):
            row.pop()
    if not curves.steps or curves.steps[-1] < step:
        curves.steps.append(step)
        for column in curves.figures.values():
            column.append(None)
    for name, value in figures.items():
        if name not in curves.figures and len(curves.figures) < FIGURES:
            curves.figures[name] = [None] * len(curves.steps)
        if name in curves.figures:
            curves.figures[name][-1] = value
    if len(curves.steps) > STEPS_KEPT:
        for row in _rows(curves):
            # The newest step stays.
            del row[-2::-2]


def _rows(curves: Curves) -> Iterator[list[int] | list[float | None]]:
    yield curves.steps
    yield from curves.figures.values()
