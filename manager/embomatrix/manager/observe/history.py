"""Runs as people look back on them: those that are open from the chronicle, those that were closed from the archive."""

from __future__ import annotations

import itertools
import logging
import time
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from embomatrix.manager.observe.chronicle import PAGE
from embomatrix.manager.observe.run_figures import summary_of
from embomatrix.rpc.run_log import EventPage, RolloutExplanation, RunSummary
from embomatrix.rpc.status import NotFoundError
from embomatrix.rpc.wire.values import RunInfo

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.manager.control.cluster_state import ClusterState
    from embomatrix.manager.observe.archive import RunArchive
    from embomatrix.manager.observe.chronicle import Chronicle, RunRecord
    from embomatrix.reward.settings import RewardSettings
    from embomatrix.rpc.run_log import PhaseSummary, RunEvent
    from embomatrix.rpc.wire.values import Batch, RunStats

logger = logging.getLogger(__name__)


class RunHistory:
    """Reads the process's own clocks: it is told of runs by their door, not by a state machine."""

    def __init__(self, chronicle: Chronicle, archive: RunArchive, cluster: ClusterState) -> None:
        self._chronicle = chronicle
        self._archive = archive
        self._cluster = cluster

    def opened(self, run_id: str, name: str, reward: RewardSettings) -> None:
        logger.info("run opened run=%s: %s", run_id, name or "no name")
        self._chronicle.open_run(
            run_id, name, now_s=time.monotonic(), cpu_s=time.process_time(), reward=reward
        )

    def submitted(self, batch: Batch) -> None:
        self._chronicle.submitted(batch, now_s=time.monotonic())

    def leads(self, run_id: str) -> PhaseSummary:
        """How long before their demand the run's scenes were warm; gone once the run is closed."""
        return summary_of(self._cluster.scheduler.prewarm.counters(run_id).leads)

    async def closed(self, run_id: str, stats: RunStats, leads: PhaseSummary) -> None:
        """The run is over, with these counters: it goes to the archive."""
        record = self._chronicle.close_run(run_id, now_s=time.monotonic())
        logger.info(
            "run closed run=%s: %d outcomes, %d failures", run_id, stats.delivered, stats.infra_failures
        )
        if record is not None:
            info = self._info(record, stats, pending=0, closed_s=time.time())
            await self._archive.keep(self._summed(record, info, leads), tuple(record.ring.events))

    async def summary(self, run_id: str) -> RunSummary:
        """What a run came to, so far or in the end. Raises ``NotFoundError``."""
        record = self._chronicle.runs.get(run_id)
        if record is not None:
            return self._summed(record, self.info(record), self.leads(run_id))
        kept = await self._archive.load(run_id)
        if kept is None:
            raise _unknown(run_id)
        return kept[0]

    def info(self, record: RunRecord) -> RunInfo:
        """Of an open run."""
        pending = self._cluster.dispatcher.pending_of(record.run_id)
        return self._info(record, self._cluster.stats(record.run_id), pending=pending)

    async def kept(self) -> list[RunInfo]:
        """Runs that are kept, the one that was closed last first."""
        return [summary.run for summary in await self._archive.summaries()]

    async def events(self, run_id: str, after: int, limit: int) -> EventPage:
        """A page of the run's log, or of the fleet's for an empty id. Raises ``NotFoundError``."""
        limit = min(limit or PAGE, PAGE)
        page = self._chronicle.page(run_id, after, limit)
        if page is not None:
            return page
        kept = await self._archive.load(run_id)
        if kept is None:
            raise _unknown(run_id)
        summary, events = kept
        beyond = [event for event in events if event.sequence > after]
        return EventPage(tuple(beyond[:limit]), summary.events_dropped)

    def explain(self, rollout_id: str) -> RolloutExplanation:
        """Return the recent decisions about a rollout. Raises ``NotFoundError``."""
        steps, place = self._cluster.explain(rollout_id)
        if not steps and not place:
            raise NotFoundError(
                f"there is no trace of rollout {rollout_id!r}: this manager never had it, or its history made room for "
                "later ones; `embomatrix cluster events RUN` may still have its events"
            )
        epoch_s = self._chronicle.epoch_s
        return RolloutExplanation(tuple(s._replace(at_s=epoch_s + s.at_s) for s in steps), place)

    async def latest(self, run_id: str, seconds: float) -> EventPage:
        """The last of a run's log: events of so many seconds before its last. Raises ``NotFoundError``."""
        record = self._chronicle.runs.get(run_id)
        if record is not None:
            events: Sequence[RunEvent] = record.ring.events
            dropped = record.ring.dropped
        else:
            kept = await self._archive.load(run_id)
            if kept is None:
                raise _unknown(run_id)
            dropped, events = kept[0].events_dropped, kept[1]
        since_s = events[-1].at_s - seconds if events else 0.0
        late = itertools.takewhile(lambda event: event.at_s >= since_s, reversed(events))
        return EventPage(tuple(late)[::-1], dropped)

    def _summed(self, record: RunRecord, info: RunInfo, leads: PhaseSummary) -> RunSummary:
        figures = record.figures
        return RunSummary(
            run=info,
            phases={phase: summary_of(histogram) for phase, histogram in figures.phases.items()},
            workers=figures.worker_rows(),
            series=figures.series.values(),
            failures=tuple(figures.failures),
            manager_cpu_s=time.process_time() - record.cpu_s,
            prewarm_lead=leads,
            scene_load=summary_of(self._chronicle.fleet.scene_load),
            events_dropped=record.ring.dropped,
            version=manager_version(),
        )

    def _info(self, record: RunRecord, stats: RunStats, *, pending: int, closed_s: float = 0.0) -> RunInfo:
        opened_s = self._chronicle.epoch_s + record.opened_s
        return RunInfo(
            record.run_id,
            record.name,
            stats,
            pending,
            opened_s,
            closed_s,
            record.reward,
            self._cluster.waits_for(record.run_id),
        )


def manager_version() -> str:
    """Of the installed package."""
    try:
        return version("embomatrix")
    except PackageNotFoundError:
        return "unknown"


def _unknown(run_id: str) -> NotFoundError:
    return NotFoundError(
        f"no run {run_id!r} is open or kept: `embomatrix cluster runs --closed` lists those that are kept"
    )
