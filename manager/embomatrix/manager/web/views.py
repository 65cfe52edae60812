"""What people and their tools see of the cluster: plain values, made when somebody asks."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.schedule.lookahead import LookaheadWindow
from embomatrix.manager.observe.meter import FailureNote  # noqa: TC001  # the OpenAPI page is made of annotations
from embomatrix.manager.observe.run_figures import summary_of
from embomatrix.manager.runtime.registry import WorkerStanding
from embomatrix.rpc.run_log import PhaseSummary  # noqa: TC001  # the OpenAPI page is made of annotations
from embomatrix.rpc.status import NotFoundError
from embomatrix.rpc.wire.values import Resident, ResidentState, RunInfo, RunStats, Warmth, WorkerInfo

if TYPE_CHECKING:
    from embomatrix.manager.runtime.event_loop import ManagerRuntime
    from embomatrix.manager.runtime.registry import WorkerSession
    from embomatrix.rpc.wire.values import PlanCell

NOTHING: Final = LookaheadWindow(0, ())
UNAUDITED: Final = "results are not audited: that takes a second worker"


@dataclass(frozen=True, slots=True)
class Overview:
    """The cluster in numbers. Seconds, except for counts; ``throughput`` is completed rollouts of each past second."""

    uptime_s: float
    workers: dict[str, int]
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
    """Median."""
    redispatched: int
    stale_results: int
    failures: list[FailureNote]
    notice: str = ""
    """What an operator should know."""
    unplaceable: int = 0
    """Announced scenes that no worker can hold."""
    phases: dict[str, PhaseSummary] = field(default_factory=dict)
    """Where the time of completed rollouts went, in the order in which it goes there."""
    store: str = ""
    """Why results can't be written down, while that is so."""
    overhead: float = 0.0
    """The manager's share of the CPU time that it and the slots used in the last minute."""


@dataclass(frozen=True, slots=True)
class WorkerView:
    """One worker. ``loads`` are scenes that it was told to load and has not reported yet."""

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
    """As its owner calls it, in the order of their names."""


@dataclass(frozen=True, slots=True)
class LookaheadCell:
    """A scene that a step of the look-ahead wants, how often, and whether it is warm anywhere."""

    bundle_digest: str
    count: int
    warmth: str
    worker_ids: list[str]
    """Those that hold the scene, or load it."""
    problem: str = ""
    """Why no worker can hold it."""


@dataclass(frozen=True, slots=True)
class LookaheadStep:
    """The scenes that a step of a run needs, and how far each is."""

    run_id: str
    step: int
    cells: list[LookaheadCell]


@dataclass(frozen=True, slots=True)
class RunView:
    """An open run: rollouts that wait or are under way, and what its results came to so far."""

    run_id: str
    name: str
    pending: int
    stats: RunStats


def overview(runtime: ManagerRuntime) -> Overview:
    """The numbers of this moment."""
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
        phases={phase.value: summary_of(found) for phase, found in runtime.chronicle.phases().items()},
        store=runtime.store_problem,
        overhead=runtime.effort.overhead(),
    )


def workers(runtime: ManagerRuntime) -> list[WorkerView]:
    """Every worker that is there or was there a moment ago, by id."""
    return [_worker(runtime, worker_id) for worker_id in sorted(runtime.registry.sessions)]


def runs(runtime: ManagerRuntime) -> list[RunView]:
    """Open runs, oldest first, as the page shows them."""
    return [RunView(info.run_id, info.name, info.pending, info.stats) for info in run_infos(runtime)]


def lookahead(runtime: ManagerRuntime) -> list[LookaheadStep]:
    """The grid: steps by scenes, with how far each scene is."""
    steps: dict[tuple[str, int], list[LookaheadCell]] = {}
    problems = runtime.cluster.scheduler.unplaceable
    for cell in plan(runtime):
        problem = problems.get(cell.bundle_digest, "") if cell.warmth is Warmth.UNPLACEABLE else ""
        held = list(cell.worker_ids)
        found = LookaheadCell(cell.bundle_digest, cell.count, cell.warmth.value, held, problem)
        steps.setdefault((cell.run_id, cell.step), []).append(found)
    return [LookaheadStep(run_id, step, cells) for (run_id, step), cells in sorted(steps.items())]


def plan(runtime: ManagerRuntime, run_id: str = "") -> list[PlanCell]:
    """What the run announced, or all of them; NotFoundError for a run that is not open."""
    scheduler = runtime.cluster.scheduler
    if run_id and run_id not in runtime.runs.open:
        raise NotFoundError(f"run {run_id!r} is not open: leave its id out to see all runs")
    windows = scheduler.windows if not run_id else {run_id: scheduler.windows.get(run_id, NOTHING)}
    return scheduler.readiness.grid(windows)


def worker_infos(runtime: ManagerRuntime) -> list[WorkerInfo]:
    """The same for the wire."""
    infos: list[WorkerInfo] = []
    for session in runtime.registry.sessions.values():
        view = _worker(runtime, session.worker_id)
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
    """Open runs, oldest first."""
    return [runtime.history.info(record) for record in runtime.chronicle.runs.values()]


def standing_counts(runtime: ManagerRuntime) -> Counter[str]:
    """How many workers are in each state, in the order of the states."""
    found = Counter(_standing(runtime, session) for session in runtime.registry.sessions.values())
    return Counter({standing.value: found[standing] for standing in WorkerStanding if found[standing]})


def _standing(runtime: ManagerRuntime, session: WorkerSession) -> WorkerStanding:
    """As people shall see it: what was decided about a worker comes before what it says itself."""
    if session.standing.is_gone:
        return session.standing
    if runtime.cluster.dispatcher.auditor.quarantined(session.worker_id):
        return WorkerStanding.QUARANTINED
    record = runtime.cluster.dispatcher.workers.get(session.worker_id)
    return WorkerStanding.DRAINING if record is not None and record.draining else session.standing


def _worker(runtime: ManagerRuntime, worker_id: str) -> WorkerView:
    session = runtime.registry.sessions[worker_id]
    record = runtime.cluster.dispatcher.workers.get(worker_id)
    scheduler = runtime.cluster.scheduler
    held = len(record.held) if record else 0
    residents = scheduler.residents(worker_id)
    repute = runtime.cluster.dispatcher.auditor.of(worker_id)
    here = {r.bundle_digest for r in residents if r.state is not ResidentState.FAILED}
    return WorkerView(
        worker_id=worker_id,
        state=_standing(runtime, session).value,
        reason=repute.quarantine or session.reason,
        audited=repute.audited,
        audit_mismatches=repute.mismatches,
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
    )
