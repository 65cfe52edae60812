"""What the REST API answers with: pages of lists, and what a change came to.

FastAPI derives the OpenAPI page from these, by annotations that it evaluates: here they are no text.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.manager.observe.training_reports import TrainingView
from embomatrix.manager.web.health import Health
from embomatrix.manager.web.views import LookaheadStep, Overview, RunView, WorkerView

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.manager.web.snapshot import Snapshot

PAGE: Final = 100
"""Rows of a page, unless another number is asked for."""
LARGEST_PAGE: Final = 1000
TROUBLE: Final = ("quarantined", "lost", "suspect", "draining", "paused")
"""States in the order in which an operator wants to see them; all others come after, and who left comes last."""


@dataclass(frozen=True, slots=True)
class WorkerPage:
    """Workers from ``offset``, of ``total`` that fit what was asked for."""

    at_s: float
    total: int
    offset: int
    items: list[WorkerView]


@dataclass(frozen=True, slots=True)
class RunPage:
    """Some of the runs, those from ``offset`` on, of ``total``; ``at_s`` is wall time."""

    at_s: float
    total: int
    offset: int
    items: list[RunView]


@dataclass(frozen=True, slots=True)
class SnapshotPage:
    """The cluster at one moment, with one page of its workers."""

    at_s: float
    health: Health
    paused: bool
    overview: Overview
    workers: WorkerPage
    runs: list[RunView]
    lookahead: list[LookaheadStep]
    training: list[TrainingView]


@dataclass(frozen=True, slots=True)
class SlotSpan:
    """A slot worked on a rollout. Times are seconds since the epoch on the manager's clock."""

    begin_s: float
    end_s: float
    load_s: float
    outcome: str
    rollout_id: str
    bundle_digest: str
    attempt: int
    deliver_s: float


@dataclass(frozen=True, slots=True)
class SlotTrack:
    """What one slot of a worker did, in the order of time."""

    worker_id: str
    slot: int
    spans: list[SlotSpan]


@dataclass(frozen=True, slots=True)
class Timeline:
    """What each slot did between two moments, by the event log. ``dropped`` events made room for later ones.

    ``slots`` is how many did anything, of which the tracks are the first.
    """

    run_id: str
    from_s: float
    until_s: float
    dropped: int
    slots: int
    tracks: list[SlotTrack]


@dataclass(frozen=True, slots=True)
class Changed:
    """What a change came to."""

    thing: str
    state: str


def worker_page(
    seen: "Snapshot", *, state: str = "", search: str = "", offset: int = 0, limit: int = PAGE
) -> WorkerPage:
    """Those in the state, or with the text in their name or a label; who doesn't work comes first."""
    found = [
        worker for worker in seen.workers if state in ("", worker.state) and search.lower() in _words(worker)
    ]
    found.sort(key=_urgency)
    return WorkerPage(seen.at_s, len(found), offset, found[offset : offset + limit])


def run_page(seen: "Snapshot", *, offset: int = 0, limit: int = PAGE) -> RunPage:
    """Open runs, the one opened last first."""
    newest: Sequence[RunView] = seen.runs[::-1]
    return RunPage(seen.at_s, len(newest), offset, list(newest[offset : offset + limit]))


def _words(worker: WorkerView) -> str:
    """What a search looks in."""
    return " ".join([worker.worker_id, *(f"{name}={value}" for name, value in worker.labels.items())]).lower()


def _urgency(worker: WorkerView) -> tuple[int, str]:
    order = TROUBLE.index(worker.state) if worker.state in TROUBLE else len(TROUBLE)
    return order + (worker.state == "left"), worker.worker_id
