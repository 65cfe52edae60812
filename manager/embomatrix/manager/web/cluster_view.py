"""State of the cluster at one moment, as the dashboard, the REST API and AdminService report it."""

import dataclasses
import json
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from embomatrix.manager.control.schedule.lookahead import LookaheadWindow
from embomatrix.manager.observe.metrics import FAILURES_KEPT, FailureNote
from embomatrix.manager.observe.run_figures import summary_of
from embomatrix.manager.observe.training_reports import TrainingView
from embomatrix.manager.runtime.event_loop import UNAUDITED, ManagerRuntime
from embomatrix.manager.runtime.registry import WorkerSession, WorkerStanding
from embomatrix.rpc.status import NotFoundError
from embomatrix.rpc.wire.run_log import PhaseSummary
from embomatrix.rpc.wire.values import (
    HostUse,
    PlanCell,
    Resident,
    ResidentState,
    RunInfo,
    Warmth,
    WorkerInfo,
)

NO_WINDOW: Final = LookaheadWindow(0, ())
PAGES_KEPT: Final = 64
"""Serialized pages of one snapshot that are cached."""
FRESH_S: Final = 0.9
"""Pages ask once a second. All viewers within this time share one snapshot."""
BUSY_CORE: Final = 0.8
"""Share of its core above which the manager soon delays rollouts."""
RECENT_S: Final = 300.0
"""Failures are reported in the health sentence for this long."""
MANY_LOST: Final = 0.2
"""A larger share of lost workers is reported before its consequences. Equals the bound of the alert rule."""
FEWEST_LOST: Final = 3
"""Lost workers from which ``MANY_LOST`` applies."""


class Mood(StrEnum):
    """Severity of a health sentence."""

    GOOD = "good"
    IDLE = "idle"
    WARNING = "warning"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Health:
    """Most important fact about the cluster, with its severity."""

    mood: Mood
    sentence: str


@dataclass(frozen=True, slots=True)
class Overview:
    """Figures of the cluster. ``throughput`` counts the completed rollouts of each past second."""

    uptime_s: float
    workers: dict[str, int]
    """Number of workers by state."""
    slots: int
    slots_busy: int
    queued: int
    leased: int
    runs: int
    outcomes: dict[str, int]
    throughput: list[int]
    latency_p50_s: float
    latency_p95_s: float
    prewarm_hits: int
    prewarm_misses: int
    prewarm_wasted: int
    prewarm_lead_s: float
    """Median time between a scene being warm and its demand."""
    redispatched: int
    stale_results: int
    failures: list[FailureNote]
    notice: str = ""
    """Note for the operator."""
    unplaceable: int = 0
    """Announced scenes that fit on no worker."""
    phases: dict[str, PhaseSummary] = field(default_factory=dict)
    """Durations of completed rollouts by phase, in order."""
    store: str = ""
    """Problem of the state store; empty while it can be written."""
    overhead: float = 0.0
    """Manager's share of the CPU time of manager and slots in the last minute; 0 if hardly anything ran."""
    core_share: float = 0.0
    """Share of one core that the manager used in the last minute."""
    slots_at_work: float = 0.0
    """Mean number of slots that executed plans in the last minute."""
    failed: int = 0
    """Rollouts that ended in an infrastructure failure since the manager started; ``failures`` lists the latest."""


@dataclass(frozen=True, slots=True)
class WorkerView:
    """One worker. ``loads`` are desired scenes that it has not reported."""

    worker_id: str
    state: str
    reason: str
    slots: int
    busy: int
    waiting: int
    completed: int
    cores: int
    memory_mb: int
    memory_used_mb: int
    load: float
    gpu: str
    versions: dict[str, str]
    silent_s: float
    residents: list[Resident]
    loads: list[str]
    audited: int = 0
    audit_mismatches: int = 0
    labels: dict[str, str] = field(default_factory=dict)
    """Labels of the owner, sorted by name."""
    host: HostUse | None = None
    """Use of its machine by all programs now; None if it does not report it, is lost or has left."""


@dataclass(frozen=True, slots=True)
class LookaheadCell:
    """A scene that a coming step needs, with the number of rollouts and the loading state."""

    bundle_digest: str
    count: int
    warmth: str
    worker_ids: list[str]
    """Workers that hold or load the scene."""
    problem: str = ""
    """Reason why the scene fits on no worker."""


@dataclass(frozen=True, slots=True)
class LookaheadStep:
    """Scenes that a step of a run needs."""

    run_id: str
    step: int
    cells: list[LookaheadCell]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State of the cluster; ``at_s`` is seconds since the epoch."""

    at_s: float
    health: Health
    paused: bool
    overview: Overview
    workers: list[WorkerView]
    runs: list[RunInfo]
    lookahead: list[LookaheadStep]
    training: list[TrainingView]


class Snapshots:
    """Cache of the latest snapshot and of the pages made from it."""

    def __init__(self, runtime: ManagerRuntime) -> None:
        self._runtime = runtime
        self._taken_s = float("-inf")
        self._last: Snapshot | None = None
        self._pages: dict[object, bytes] = {}

    def now(self) -> Snapshot:
        """Return a snapshot that is at most ``FRESH_S`` old."""
        if self._last is None or time.monotonic() - self._taken_s >= FRESH_S:
            self._last = snapshot(self._runtime)
            self._pages.clear()
            self._taken_s = time.monotonic()
        return self._last

    def page(self, key: object, make: Callable[[Snapshot], object]) -> bytes:
        """Return a dataclass made from the snapshot, as JSON. It is made once per key and snapshot."""
        seen = self.now()
        if key not in self._pages:
            if len(self._pages) >= PAGES_KEPT:
                self._pages.clear()
            text = json.dumps(make(seen), default=dataclasses.asdict, separators=(",", ":"))
            self._pages[key] = text.encode()
        return self._pages[key]

    def forget(self) -> None:
        """Take a new snapshot for the next request, after a command."""
        self._last = None


def snapshot(runtime: ManagerRuntime) -> Snapshot:
    now_s, seen = time.time(), overview(runtime)
    return Snapshot(
        at_s=now_s,
        health=health(seen, paused=runtime.paused, now_s=now_s),
        paused=runtime.paused,
        overview=seen,
        workers=[worker_view(runtime, worker_id) for worker_id in sorted(runtime.registry.sessions)],
        runs=run_infos(runtime),
        lookahead=_lookahead(runtime),
        training=runtime.training.views(),
    )


def overview(runtime: ManagerRuntime) -> Overview:
    now_s = time.monotonic()
    cluster, meter = runtime.cluster, runtime.meter
    totals = cluster.totals()
    workers = list(cluster.dispatcher.workers.values())
    return Overview(
        uptime_s=now_s - runtime.started_s,
        workers=dict(standing_counts(runtime)),
        slots=sum(worker.slots for worker in workers),
        slots_busy=sum(min(len(worker.held), worker.slots) for worker in workers),
        queued=cluster.dispatcher.queued,
        leased=len(cluster.dispatcher.live_leases),
        runs=len(runtime.runs.open),
        outcomes=dict(meter.outcomes),
        throughput=meter.throughput(now_s),
        latency_p50_s=meter.latency_s(0.5),
        latency_p95_s=meter.latency_s(0.95),
        prewarm_hits=totals.prewarm_hits,
        prewarm_misses=totals.prewarm_misses,
        prewarm_wasted=totals.prewarm_wasted,
        prewarm_lead_s=cluster.scheduler.prewarm.leads.quantile(0.5),
        redispatched=totals.redispatched,
        stale_results=totals.stale_results,
        failures=list(meter.failures),
        notice=UNAUDITED if cluster.dispatcher.auditor.lone else "",
        unplaceable=len(cluster.scheduler.unplaceable),
        phases={phase.value: summary_of(found) for phase, found in runtime.event_log.phases().items()},
        store=runtime.store_problem,
        overhead=runtime.load.overhead(),
        core_share=runtime.load.core_share(),
        slots_at_work=runtime.load.slots_at_work(),
        failed=meter.failed,
    )


def _lookahead(runtime: ManagerRuntime) -> list[LookaheadStep]:
    steps: dict[tuple[str, int], list[LookaheadCell]] = {}
    problems = runtime.cluster.scheduler.unplaceable
    for cell in plan(runtime):
        problem = problems.get(cell.bundle_digest, "") if cell.warmth is Warmth.UNPLACEABLE else ""
        found = LookaheadCell(
            cell.bundle_digest, cell.count, cell.warmth.value, list(cell.worker_ids), problem
        )
        steps.setdefault((cell.run_id, cell.step), []).append(found)
    return [LookaheadStep(run_id, step, cells) for (run_id, step), cells in sorted(steps.items())]


def plan(runtime: ManagerRuntime, run_id: str = "") -> list[PlanCell]:
    """Return the look-ahead grid of a run, or of all runs. Raises NotFoundError for a run that is not open."""
    scheduler = runtime.cluster.scheduler
    if run_id and run_id not in runtime.runs.open:
        raise NotFoundError(f"run {run_id!r} is not open: leave its id out to see all runs")
    windows = scheduler.windows if not run_id else {run_id: scheduler.windows.get(run_id, NO_WINDOW)}
    return scheduler.readiness.grid(windows)


def worker_infos(runtime: ManagerRuntime) -> list[WorkerInfo]:
    """Return all known workers for AdminService."""
    infos: list[WorkerInfo] = []
    for session in runtime.registry.sessions.values():
        view = worker_view(runtime, session.worker_id)
        infos.append(
            WorkerInfo(
                worker_id=view.worker_id,
                state=view.state,
                resources=session.resources,
                residents=tuple(view.residents),
                running=view.busy,
                completed=view.completed,
                last_seen_s=view.silent_s,
                reason=view.reason,
                audited=view.audited,
                audit_mismatches=view.audit_mismatches,
            )
        )
    return infos


def run_infos(runtime: ManagerRuntime) -> list[RunInfo]:
    """Return the open runs, oldest first."""
    return [runtime.history.info(record) for record in runtime.event_log.runs.values()]


def standing_counts(runtime: ManagerRuntime) -> Counter[str]:
    """Return the number of workers in each state, in the order of the states."""
    found = Counter(_standing(runtime, session) for session in runtime.registry.sessions.values())
    return Counter({standing.value: found[standing] for standing in WorkerStanding if found[standing]})


def _standing(runtime: ManagerRuntime, session: WorkerSession) -> WorkerStanding:
    """Return the state to show: quarantine and drain override the worker's own report."""
    if session.standing.is_gone:
        return session.standing
    if runtime.cluster.dispatcher.auditor.of(session.worker_id).quarantine:
        return WorkerStanding.QUARANTINED
    record = runtime.cluster.dispatcher.workers.get(session.worker_id)
    return WorkerStanding.DRAINING if record is not None and record.draining else session.standing


def worker_view(runtime: ManagerRuntime, worker_id: str) -> WorkerView:
    """Return one worker, which the registry knows."""
    session = runtime.registry.sessions[worker_id]
    record = runtime.cluster.dispatcher.workers.get(worker_id)
    scheduler = runtime.cluster.scheduler
    held = len(record.held) if record else 0
    residents = scheduler.residents(worker_id)
    reputation = runtime.cluster.dispatcher.auditor.of(worker_id)
    here = {r.bundle_digest for r in residents if r.state is not ResidentState.FAILED}
    return WorkerView(
        worker_id=worker_id,
        state=_standing(runtime, session).value,
        reason=reputation.quarantine or session.reason,
        audited=reputation.audited,
        audit_mismatches=reputation.mismatches,
        slots=session.resources.slots,
        busy=min(held, record.slots) if record else 0,
        waiting=max(0, held - record.slots) if record else 0,
        completed=runtime.meter.completed_by[worker_id],
        cores=session.resources.cores,
        memory_mb=session.resources.memory_mb,
        memory_used_mb=session.memory_used_mb,
        load=session.load,
        gpu=session.resources.gpu,
        versions=dict(session.resources.versions),
        silent_s=time.monotonic() - session.last_seen_s,
        residents=list(residents),
        loads=[scene for scene in scheduler.desired(worker_id) if scene not in here],
        labels=dict(sorted(session.resources.labels.items())),
        host=None if session.standing.is_gone else runtime.hosts.use_of(worker_id),
    )


def health(seen: Overview, *, paused: bool, now_s: float) -> Health:
    """Return the first fact that an operator should know. ``now_s`` is seconds since the epoch."""
    working = seen.workers.get("ready", 0) + seen.workers.get("suspect", 0)
    if seen.store:
        return Health(Mood.BAD, f"The state store cannot be written, so dispatch has stopped: {seen.store}.")
    if paused:
        return Health(Mood.WARNING, "Dispatch is paused: no new rollouts start until an operator resumes it.")
    # Workers that left in order count only if no other worker is connected.
    every = sum(seen.workers.values()) - seen.workers.get("left", 0)
    if not every:
        if seen.queued:
            return Health(Mood.BAD, f"{_queued(seen.queued)} and no worker is connected.")
        return Health(Mood.IDLE, "Every worker has left." if seen.workers else "No worker has joined yet.")
    if not working:
        return Health(
            Mood.BAD,
            "The only worker is not working." if every == 1 else f"None of {every} workers is working.",
        )
    if quarantined := seen.workers.get("quarantined", 0):
        return Health(
            Mood.BAD, f"{_workers(quarantined)} in quarantine: results disagreed with other workers."
        )
    lost = seen.workers.get("lost", 0)
    if lost >= FEWEST_LOST and lost > MANY_LOST * every:
        return Health(
            Mood.BAD, f"{lost} of {every} workers were lost recently; their leases were re-dispatched."
        )
    return _health_of_work(seen, working, lost, now_s)


def _health_of_work(seen: Overview, working: int, lost: int, now_s: float) -> Health:
    """Return the first fact about rollouts, where most workers are connected."""
    recent = [note for note in seen.failures if now_s - note.at_s < RECENT_S]
    if recent:
        # The meter keeps no more failures than this.
        rollouts = sum(note.count for note in recent)
        count = f"{rollouts} or more" if len(recent) == FAILURES_KEPT else f"{rollouts}"
        failed, latest = ("rollout", "with") if rollouts == 1 else ("rollouts", "the latest with")
        return Health(
            Mood.WARNING,
            f"{count} {failed} failed in the last {RECENT_S / 60:.0f} minutes, {latest} {recent[0].code}.",
        )
    if stuck := seen.unplaceable:
        scenes = "1 announced scene fits" if stuck == 1 else f"{stuck} announced scenes fit"
        return Health(Mood.WARNING, f"{scenes} on no worker: the look-ahead page shows the reason.")
    if lost:
        return Health(Mood.WARNING, f"{_workers(lost)} lost recently; all leases were re-dispatched.")
    if seen.queued and not seen.leased:
        return Health(Mood.WARNING, f"{_queued(seen.queued)} and none runs: no scene is warm yet.")
    if seen.core_share > BUSY_CORE:
        return Health(
            Mood.WARNING,
            f"The manager uses {seen.core_share:.0%} of its core: send larger batches, or give it a faster core.",
        )
    if not seen.runs:
        waits = "waits" if working == 1 else "wait"
        return Health(Mood.IDLE, f"Ready: {_workers(working)} {waits} for a run.")
    return Health(Mood.GOOD, "All is well.")


def _queued(count: int) -> str:
    return "1 rollout is queued" if count == 1 else f"{count} rollouts are queued"


def _workers(count: int) -> str:
    return f"{count} worker{'' if count == 1 else 's'}"
