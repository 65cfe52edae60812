"""Prometheus metrics, made from the manager's counters on each scrape.

Labels have closed sets of values; none carries the id of a run, rollout, worker or scene.
"""

import functools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Final

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from embomatrix.manager.control.workers import WorkerRecord
from embomatrix.manager.histogram import BOUNDS_S, Histogram
from embomatrix.manager.observe.run_archive import manager_version
from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.runtime.registry import WorkerStanding
from embomatrix.manager.web.cluster_view import standing_counts
from embomatrix.rpc.wire.values import InfraCode, ResidentState

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
OUTCOMES: Final = ("completed", "cancelled", *(code.value for code in InfraCode))
SLOT_STATES: Final = ("idle", "warming", "warm", "running", "quarantined")


def metrics_page(runtime: ManagerRuntime) -> str:
    """Return the metrics of the cluster and of the manager's process."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Cluster(runtime))
    ProcessCollector(registry=registry)
    return generate_latest(registry).decode()


class _Cluster(Collector):
    """Metric families of one moment, listed in ``docs/operations.md``."""

    def __init__(self, runtime: ManagerRuntime) -> None:
        self._runtime = runtime

    def collect(self) -> Iterable[Metric]:
        yield _gauge("embo_build_info", "Version of the manager.", {manager_version(): 1}, "version")
        yield from self._fleet()
        yield from self._work()
        yield from self._prewarming()
        yield from self._manager()

    def _fleet(self) -> Iterator[Metric]:
        sessions = self._runtime.registry.sessions
        standings = standing_counts(self._runtime)
        states = {standing.value: standings[standing.value] for standing in WorkerStanding}
        yield _gauge("embo_workers", "Workers by state.", states, "state")
        yield _gauge("embo_slots", "Slots of connected workers by state.", self._slot_states(), "state")
        scheduler = self._runtime.cluster.scheduler
        residents = Counter(
            resident.state.value for name in sessions for resident in scheduler.residents(name)
        )
        found = {state.value: residents[state.value] for state in ResidentState}
        yield _gauge("embo_residents", "Scenes on workers by state.", found, "state")
        loads = self._runtime.event_log.scene_load
        yield _histograms("embo_scene_load_seconds", "Time that workers took to load a scene.", loads)

    def _work(self) -> Iterator[Metric]:
        runtime, event_log = self._runtime, self._runtime.event_log
        dispatcher, totals = runtime.cluster.dispatcher, runtime.cluster.totals()
        yield _gauge("embo_runs", "Open runs.", len(runtime.runs.open))
        yield _gauge("embo_queue_depth", "Queued rollouts.", dispatcher.queued)
        yield _gauge("embo_leases", "Live leases.", len(dispatcher.live_leases))
        outcomes = {name: runtime.meter.outcomes[name] for name in OUTCOMES}
        yield _counter("embo_rollouts", "Rollouts by outcome.", outcomes, "outcome")
        phases = {phase.value: histogram for phase, histogram in event_log.phases().items()}
        yield _histograms("embo_rollout_seconds", "Time of completed rollouts by phase.", phases, "phase")
        yield _attempts(event_log.attempts)
        yield _counter("embo_redispatched", "Re-dispatched leases.", totals.redispatched)
        yield _counter("embo_lease_expired", "Expired leases.", dispatcher.state.leases.expired)
        yield _counter("embo_stale_results", "Late results that were rejected.", totals.stale_results)
        yield _counter("embo_hedges", "Hedge leases.", totals.hedged)
        yield _counter("embo_hedges_won", "Hedge leases that delivered first.", event_log.hedges_won)
        shared = {"shared": totals.shared_steps, "executed": totals.steps - totals.shared_steps}
        yield _counter(
            "embo_steps", "Steps of completed rollouts, by whether they were executed.", shared, "how"
        )
        yield _counter("embo_groups_failed", "Failed groups.", totals.groups_failed)

    def _prewarming(self) -> Iterator[Metric]:
        totals = self._runtime.cluster.totals()
        hits, misses = totals.prewarm_hits, totals.prewarm_misses
        yield _counter("embo_prewarm_hits", "Scenes that were warm when their batch arrived.", hits)
        yield _counter("embo_prewarm_misses", "Scenes that were not warm when their batch arrived.", misses)
        yield _counter("embo_prewarm_wasted", "Preloaded scenes that were not used.", totals.prewarm_wasted)
        leads = self._runtime.cluster.scheduler.prewarm.leads
        yield _histograms(
            "embo_prewarm_lead_seconds", "Time between a scene being warm and its demand.", leads
        )

    def _manager(self) -> Iterator[Metric]:
        runtime = self._runtime
        share = runtime.load.overhead()
        text = "CPU time of the manager over that of the manager and the slots, in the last minute."
        yield _gauge("embo_manager_overhead_ratio", text, share)
        yield _histograms("embo_manager_lag_seconds", "Lag of the manager's clock ticks.", runtime.load.lag)
        longest_s = runtime.load.longest_lag_s
        yield _gauge("embo_manager_longest_lag_seconds", "Longest lag since the manager started.", longest_s)
        operations = runtime.load.store
        yield _histograms("embo_store_op_seconds", "Time of the state store's operations.", operations, "op")
        dropped = sum(run.ring.dropped for run in runtime.event_log.runs.values())
        dropped += runtime.event_log.dropped + runtime.event_log.fleet.dropped
        yield _counter("embo_events_dropped", "Events discarded from full logs.", dropped)
        yield _counter("embo_errors", "Errors that the manager logged.", runtime.errors.total)

    def _slot_states(self) -> dict[str, int]:
        states = Counter[str]()
        for worker in self._runtime.cluster.dispatcher.workers.values():
            running = min(len(worker.held), worker.slots)
            states["running"] += running
            states[self._state_of_free(worker)] += worker.slots - running
        return {state: states[state] for state in SLOT_STATES}

    def _state_of_free(self, worker: WorkerRecord) -> str:
        """Return the state of a slot without a rollout."""
        if worker.quarantined:
            return "quarantined"
        states = {resident.state for resident in self._runtime.cluster.scheduler.residents(worker.worker_id)}
        if ResidentState.WARM in states:
            return "warm"
        return "warming" if ResidentState.LOADING in states else "idle"


def _family(
    kind: type[GaugeMetricFamily | CounterMetricFamily],
    name: str,
    text: str,
    values: float | Mapping[str, float],
    label: str = "",
) -> Metric:
    """Return a family with one value, or with a value per label value."""
    if not isinstance(values, Mapping):
        return kind(name, text, value=values)
    family = kind(name, text, labels=[label])
    for key, value in values.items():
        family.add_metric([key], value)
    return family


_gauge = functools.partial(_family, GaugeMetricFamily)
_counter = functools.partial(_family, CounterMetricFamily)


def _histograms(name: str, text: str, values: Histogram | Mapping[str, Histogram], label: str = "") -> Metric:
    """Return a family with one histogram, or with a histogram per label value."""
    family = HistogramMetricFamily(name, text, labels=[label] if label else [])
    every = {"": values} if isinstance(values, Histogram) else values
    for key, histogram in every.items():
        counts = zip(BOUNDS_S, histogram.cumulative(), strict=True)
        buckets = [(f"{bound_s:.6g}", float(count)) for bound_s, count in counts]
        family.add_metric([key] if label else [], [*buckets, ("+Inf", histogram.count)], histogram.sum_s)
    return family


def _attempts(attempts: Mapping[int, int]) -> Metric:
    family = HistogramMetricFamily("embo_attempts", "Attempts per rollout.", labels=[])
    bounds = (1, 2, 3, 5, 10)
    within = [sum(count for attempt, count in attempts.items() if attempt <= bound) for bound in bounds]
    buckets = [(str(bound), float(count)) for bound, count in zip(bounds, within, strict=True)]
    total = sum(attempt * count for attempt, count in attempts.items())
    family.add_metric([], [*buckets, ("+Inf", float(sum(attempts.values())))], float(total))
    return family
