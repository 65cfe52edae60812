"""Training reports of the latest runs: learning curves and sampled plans, in bounded memory.

They are not stored: after a restart the curves continue from the next report.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from embomatrix.rpc.status import NotFoundError
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


@dataclass(frozen=True, slots=True)
class TrainingDetail:
    """All reports of a run. ``plans`` belong to step ``plans_step``."""

    run: TrainingView
    phases: list[Curves]
    plans_step: int
    plans: list[SampledPlan]


@dataclass(slots=True, eq=False)
class _Record:
    name: str
    phases: dict[str, Curves] = field(default_factory=dict)
    plans: tuple[SampledPlan, ...] = ()
    plans_step: int = 0
    phase: str = ""
    step: int = 0
    reported_s: float = 0.0
    revision: int = 0


class TrainingBook:
    """Runs by id, latest report last. Beyond ``RUNS_KEPT`` the first run is dropped."""

    def __init__(self) -> None:
        self._runs: dict[str, _Record] = {}

    def note(self, run_id: str, name: str, report: TrainingReport, *, at_s: float) -> None:
        """Add a report. A repeated step is updated; a lower step discards all later ones."""
        record = self._runs.pop(run_id, None) or _Record(name)
        self._runs[run_id] = record
        while len(self._runs) > RUNS_KEPT:
            del self._runs[next(iter(self._runs))]
        if report.figures and (report.phase in record.phases or len(record.phases) < PHASES_KEPT):
            curves = record.phases.setdefault(report.phase, Curves(report.phase, [], {}))
            _add(curves, report.step, report.figures)
        if report.plans:
            record.plans, record.plans_step = report.plans[:PLANS], report.step
        record.phase, record.step, record.reported_s = report.phase, report.step, at_s
        record.revision += 1

    def views(self) -> list[TrainingView]:
        """Return the runs, latest report first."""
        return [_view(run_id, record) for run_id, record in reversed(self._runs.items())]

    def detail(self, run_id: str) -> TrainingDetail:
        """Return all reports of a run. Raises NotFoundError."""
        record = self._runs.get(run_id)
        if record is None:
            raise NotFoundError(
                f"no training of run {run_id!r} was reported to this manager: the latest {RUNS_KEPT} are kept"
            )
        phases = list(record.phases.values())
        return TrainingDetail(_view(run_id, record), phases, record.plans_step, list(record.plans))


def _view(run_id: str, record: _Record) -> TrainingView:
    return TrainingView(run_id, record.name, record.phase, record.step, record.reported_s, record.revision)


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
