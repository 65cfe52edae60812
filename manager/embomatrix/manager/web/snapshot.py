"""The cluster at one moment: what every list, page and viewer is fed from, so that none of them disagree."""

from __future__ import annotations

import dataclasses
import json
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from embomatrix.manager.web import views
from embomatrix.manager.web.health import health

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable

    from embomatrix.manager.observe.training_reports import TrainingView
    from embomatrix.manager.runtime.event_loop import ManagerRuntime
    from embomatrix.manager.web.health import Health
    from embomatrix.manager.web.views import LookaheadStep, Overview, RunView, WorkerView

ANSWERS_KEPT: Final = 64
"""To different questions about one snapshot."""
FRESH_S: Final = 0.9
"""Pages ask once a second. However many viewers there are, the cluster is looked at once for all of them."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """``at_s`` is seconds since the epoch."""

    at_s: float
    health: Health
    paused: bool
    overview: Overview
    workers: list[WorkerView]
    runs: list[RunView]
    lookahead: list[LookaheadStep]
    training: list[TrainingView]


class Snapshots:
    """Takes a snapshot when the last is too old. Reads the process's own clocks: nothing is decided by them."""

    def __init__(self, runtime: ManagerRuntime) -> None:
        self._runtime = runtime
        self._taken_s = float("-inf")
        self._last: Snapshot | None = None
        self._told: dict[Hashable, bytes] = {}

    def now(self) -> Snapshot:
        """That of this moment, or of less than ``FRESH_S`` ago."""
        if self._last is None or time.monotonic() - self._taken_s >= FRESH_S:
            self._last = self._take()
            self._told.clear()
            self._taken_s = time.monotonic()
        return self._last

    def told(self, asked: Hashable, page: Callable[[Snapshot], Any]) -> bytes:
        """A dataclass made of the snapshot, as JSON: made once for all who ask the same of this moment."""
        seen = self.now()
        if asked not in self._told:
            if len(self._told) >= ANSWERS_KEPT:
                self._told.clear()
            self._told[asked] = json.dumps(dataclasses.asdict(page(seen)), separators=(",", ":")).encode()
        return self._told[asked]

    def forget(self) -> None:
        """Something was changed: who looks next wants to see it."""
        self._last = None

    def _take(self) -> Snapshot:
        runtime, now_s = self._runtime, time.time()
        seen = views.overview(runtime)
        return Snapshot(
            at_s=now_s,
            health=health(seen, paused=runtime.paused, now_s=now_s),
            paused=runtime.paused,
            overview=seen,
            workers=views.workers(runtime),
            runs=views.runs(runtime),
            lookahead=views.lookahead(runtime),
            training=runtime.training.views(),
        )
