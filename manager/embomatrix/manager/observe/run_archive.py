"""History of runs: open runs from the event log, closed runs from an archive on disk."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import itertools
import logging
import re
import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from google.protobuf.message import DecodeError

from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.control.dispatch.state import steps_of
from embomatrix.manager.observe.event_log import PAGE, RunEventLog, RunRecord
from embomatrix.manager.observe.run_figures import summary_of
from embomatrix.manager.observe.training_archive import kept_training_from_proto, kept_training_to_proto
from embomatrix.manager.observe.training_reports import RUNS_KEPT as TRAINED_KEPT
from embomatrix.manager.observe.training_reports import TrainingBook, TrainingDetail
from embomatrix.proto.v1 import admin_service_pb2 as pb
from embomatrix.reward.settings import RewardSettings
from embomatrix.rpc.status import NotFoundError
from embomatrix.rpc.versions import software_version
from embomatrix.rpc.wire.codec import ConvertError, each, inside
from embomatrix.rpc.wire.run_log import (
    EventPage,
    PhaseSummary,
    RolloutExplanation,
    RunEvent,
    RunSummary,
    run_event_from_proto,
    run_event_to_proto,
    run_summary_from_proto,
    run_summary_to_proto,
)
from embomatrix.rpc.wire.values import Batch, RunInfo, RunStats
from embomatrix.world.whole_file import write_whole

logger = logging.getLogger(__name__)


class RunHistory:
    """History of open and closed runs. Reads the process's own clocks."""

    def __init__(
        self, event_log: RunEventLog, archive: RunArchive, cluster: ClusterState, training: TrainingBook
    ) -> None:
        self._event_log = event_log
        self._archive = archive
        self._cluster = cluster
        self._training = training

    def opened(self, run_id: str, name: str, reward: RewardSettings) -> None:
        logger.info("run opened run=%s: %s", run_id, name or "no name")
        self._event_log.open_run(
            run_id, name, now_s=time.monotonic(), cpu_s=time.process_time(), reward=reward
        )

    def submitted(self, batch: Batch) -> None:
        self._event_log.submitted(batch, now_s=time.monotonic())

    def leads(self, run_id: str) -> PhaseSummary:
        """Return how long before their demand the run's scenes were warm. Available until the run is closed."""
        return summary_of(self._cluster.scheduler.prewarm.counters(run_id).leads)

    async def closed(self, run_id: str, stats: RunStats, leads: PhaseSummary) -> None:
        """Move a closed run, with its final counters, to the archive."""
        now_s = time.monotonic()
        record = self._event_log.close_run(run_id, now_s=now_s)
        logger.info(
            "run closed run=%s: %d outcomes, %d failures", run_id, stats.delivered, stats.infra_failures
        )
        if record is not None:
            # On the clock of the opening, which a change of the system's time does not move.
            closed_s = self._event_log.epoch_s + now_s
            info = self._info(record, stats, pending=0, closed_s=closed_s)
            summary = self._summed(record, info, leads)
            kept = ArchivedRun(summary, tuple(record.ring.events), self._training.copy_of(run_id))
            await asyncio.to_thread(self._archive.keep, kept)

    async def summary(self, run_id: str) -> RunSummary:
        """Return the totals of an open or archived run. Raises NotFoundError."""
        record = self._event_log.runs.get(run_id)
        if record is not None:
            return self._summed(record, self.info(record), self.leads(run_id))
        return (await self._archived(run_id)).summary

    def info(self, record: RunRecord) -> RunInfo:
        """Return the listing of an open run."""
        pending = self._cluster.dispatcher.pending_of(record.run_id)
        return self._info(record, self._cluster.stats(record.run_id), pending=pending)

    async def kept(self) -> list[RunInfo]:
        """Return the archived runs, the last closed first."""
        return await asyncio.to_thread(self._archive.infos)

    async def find_training(self, run_id: str) -> TrainingDetail | None:
        """Return the training reports of an open or archived run; None without any."""
        detail = self._training.find(run_id)
        if detail is None and run_id not in self._event_log.runs:
            kept = await asyncio.to_thread(self._archive.load, run_id)
            return kept.training if kept is not None else None
        return detail

    async def training(self, run_id: str) -> TrainingDetail:
        """Return the training reports of an open or archived run. Raises NotFoundError."""
        detail = await self.find_training(run_id)
        if detail is None:
            raise NotFoundError(
                f"no training of run {run_id!r} was reported to this manager: it keeps the latest {TRAINED_KEPT}, and "
                "those of archived runs"
            )
        return detail

    async def events(self, run_id: str, after: int, limit: int) -> EventPage:
        """Return a page of the run's log, or of workers and scenes for an empty id. Raises NotFoundError."""
        limit = min(limit or PAGE, PAGE)
        page = self._event_log.page(run_id, after, limit)
        if page is not None:
            return page
        kept = await self._archived(run_id)
        beyond = [event for event in kept.events if event.sequence > after]
        return EventPage(tuple(beyond[:limit]), kept.summary.events_dropped)

    async def explain(self, rollout_id: str) -> RolloutExplanation:
        """Return the recent decisions about a rollout. Raises ``NotFoundError``."""
        state = self._cluster.dispatcher.state
        place = state.where(rollout_id)
        # The whole history is searched, which takes longer than other calls should wait.
        steps = await asyncio.to_thread(steps_of, rollout_id, state.history(), state.batches_with(rollout_id))
        if not steps and not place:
            raise NotFoundError(
                f"there is no trace of rollout {rollout_id!r}: this manager never had it, or its history made room for "
                "later ones; `embomatrix cluster events RUN` may still have its events"
            )
        epoch_s = self._event_log.epoch_s
        return RolloutExplanation(tuple(s._replace(at_s=epoch_s + s.at_s) for s in steps), place)

    async def latest(self, run_id: str, seconds: float) -> EventPage:
        """Return the events of the last seconds before the run's last event. Raises NotFoundError."""
        record = self._event_log.runs.get(run_id)
        if record is not None:
            events: Sequence[RunEvent] = record.ring.events
            dropped = record.ring.dropped
        else:
            kept = await self._archived(run_id)
            events, dropped = kept.events, kept.summary.events_dropped
        since_s = events[-1].at_s - seconds if events else 0.0
        late = itertools.takewhile(lambda event: event.at_s >= since_s, reversed(events))
        return EventPage(tuple(late)[::-1], dropped)

    async def _archived(self, run_id: str) -> ArchivedRun:
        kept = await asyncio.to_thread(self._archive.load, run_id)
        if kept is None:
            raise NotFoundError(
                f"no run {run_id!r} is open or kept: `embomatrix cluster runs --closed` lists those that are kept"
            )
        return kept

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
            scene_load=summary_of(self._event_log.scene_load),
            events_dropped=record.ring.dropped,
            version=manager_version(),
        )

    def _info(self, record: RunRecord, stats: RunStats, *, pending: int, closed_s: float = 0.0) -> RunInfo:
        opened_s = self._event_log.epoch_s + record.opened_s
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
    """Return the version of the installed package; "unknown" in a source tree that is not installed."""
    return software_version() or "unknown"


RUNS_KEPT: Final = 50
SUFFIX: Final = ".run.gz"
RUN_ID: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")
"""Valid run ids. Each is also a safe file name."""


@dataclass(frozen=True, slots=True)
class ArchivedRun:
    """Closed run: its totals, its latest events, and the reports of its trainer if it sent any."""

    summary: RunSummary
    events: tuple[RunEvent, ...]
    training: TrainingDetail | None = None


class RunArchive:
    """Folder with one file for each of the ``kept`` last closed runs.

    Its methods wait for the disk. Read and write errors are logged and ignored: no run fails for its history.
    """

    def __init__(self, folder: Path, *, kept: int = RUNS_KEPT) -> None:
        self._folder = folder
        self._kept = kept
        self._infos: dict[str, tuple[int, RunInfo | None]] = {}
        """Listing of each file by name, with the file's time of change: a list needs no second look at its events."""

    def keep(self, kept: ArchivedRun) -> None:
        """Write a closed run. It replaces an earlier run of the same id."""
        summary = kept.summary
        message = pb.KeptRun(
            summary=run_summary_to_proto(summary), events=map(run_event_to_proto, kept.events)
        )
        if kept.training is not None:
            message.training.CopyFrom(kept_training_to_proto(kept.training))
        path = self._path(summary.run.run_id)
        try:
            self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            self._folder.chmod(0o700)
            write_whole(path, gzip.compress(message.SerializeToString(), compresslevel=3))
            for old in self._files()[self._kept :]:
                old.unlink(missing_ok=True)
        except OSError as error:
            logger.warning("run history not archived run=%s: %s", summary.run.run_id, error)

    def infos(self) -> list[RunInfo]:
        """Return the listings of the archived runs, the last closed first."""
        known, seen = self._infos, dict[str, tuple[int, RunInfo | None]]()
        found: list[RunInfo] = []
        for path in self._files():
            try:
                changed_ns = path.stat().st_mtime_ns
            except FileNotFoundError:
                continue
            entry = known.get(path.name)
            if entry is None or entry[0] != changed_ns:
                message = self._message(path)
                entry = (changed_ns, None if message is None else self._info(path, message))
            seen[path.name] = entry
            if entry[1] is not None:
                found.append(entry[1])
        # Other threads list the files at the same time: they find the former listings until the new ones are whole.
        self._infos = seen
        return found

    def load(self, run_id: str) -> ArchivedRun | None:
        """Return an archived run; None if there is none of that id."""
        # The id becomes a file name, so only valid run ids are accepted.
        return self._read(self._path(run_id)) if RUN_ID.fullmatch(run_id) else None

    def _path(self, run_id: str) -> Path:
        return self._folder / f"{run_id}{SUFFIX}"

    def _files(self) -> list[Path]:
        """Return the files, newest first."""
        found = []
        for path in self._folder.glob(f"*{SUFFIX}"):
            # Another thread may remove the oldest ones meanwhile.
            with contextlib.suppress(FileNotFoundError):
                found.append((path.stat().st_mtime_ns, path.name, path))
        return [path for _, _, path in sorted(found, reverse=True)]

    def _read(self, path: Path) -> ArchivedRun | None:
        message = self._message(path)
        if message is None:
            return None
        try:
            summary = run_summary_from_proto(message.summary)
            events = each("events", run_event_from_proto, message.events)
            training = None
            if message.HasField("training"):
                run = summary.run
                training = inside(
                    "training",
                    lambda kept: kept_training_from_proto(kept, run.run_id, run.name),
                    message.training,
                )
        except ConvertError as error:
            logger.warning("run history can't be read file=%s: %s", path.name, error)
            return None
        return ArchivedRun(summary, events, training)

    def _info(self, path: Path, message: pb.KeptRun) -> RunInfo | None:
        try:
            return run_summary_from_proto(message.summary).run
        except ConvertError as error:
            logger.warning("run history can't be read file=%s: %s", path.name, error)
            return None

    def _message(self, path: Path) -> pb.KeptRun | None:
        try:
            return pb.KeptRun.FromString(gzip.decompress(path.read_bytes()))
        except FileNotFoundError:
            return None
        except (OSError, EOFError, zlib.error, DecodeError) as error:
            logger.warning("run history can't be read file=%s: %s", path.name, error)
            return None
