"""A simulation from its scenario to its report. The invariants are asserted throughout; a broken one ends it."""

from __future__ import annotations

import contextlib
import gc
import random
from dataclasses import dataclass
from statistics import fmean
from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.histogram import quantile
from embomatrix.manager.runtime.intake import Intake
from embomatrix.manager.runtime.registry import Registry
from embomatrix.manager.simulation.agenda import Agenda
from embomatrix.manager.simulation.auditor import BrokenInvariantError, InvariantChecker
from embomatrix.manager.simulation.front import SimulatedManager
from embomatrix.manager.simulation.gauge import Gauge
from embomatrix.manager.simulation.machines import rng_for, setting_of
from embomatrix.manager.simulation.trainer import SimulatedTrainer
from embomatrix.manager.simulation.worker import SimulatedWorker

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from embomatrix.manager.simulation.gauge import Cost
    from embomatrix.manager.simulation.scenario import SimulationScenario
    from embomatrix.rpc.wire.values import RunStats

SAMPLE_S: Final = 0.1
"""The slots are looked at this often, to see how many are at work while there is work for all."""


@dataclass(frozen=True, slots=True)
class Report:
    """What came of a simulation. Times are simulated seconds, but for CPU times, which are real."""

    scenario: SimulationScenario
    slots: int
    submitted: int
    delivered: int
    infra_failures: int
    stats: RunStats
    elapsed_s: float
    """From the first step's begin to the last result."""
    waits_s: tuple[float, ...]
    queued_p50_s: float
    queued_p99_s: float
    utilisation: float
    """Share of the slots' time in which they executed something, from the first step's begin on."""
    pressed_utilisation: float | None
    """The same, while at least as many rollouts were open as there are slots, after each run's first step; None if never."""
    stall: float
    """Share of the time after that in which trainers waited for nothing but results."""
    foretold: int
    """Groups after the first step of their run: their scenes could be announced in time."""
    hit_rate: float
    """Share of those whose scene was warm when they came; 1 where there were none."""
    loads: int
    loads_unused: int
    cpu_s: float
    detected_s: tuple[float, ...]
    """From each death of a worker to the manager's knowing of it."""
    orphaned_s: tuple[float, ...]
    """From the loss of a worker to the next lease of each rollout that it held."""
    start_latency_s: float
    """From a group's submission to the start of its first execution, the mean."""
    first_result_s: float
    """From the first submission of a run to its first result, the longest of all runs."""
    groups_s: Mapping[str, tuple[float, ...]]
    """From the submission of each group to its last result, by run."""
    shares: Mapping[str, float]
    """What each run had of the slots at work, while every run wanted all of them; empty if that never was."""
    lag_p99_s: float
    """How long messages waited for a manager that takes time; 0 of one that answers at once."""
    costs: Mapping[str, Cost]
    counts: Mapping[str, int]
    caught: Mapping[str, int]
    """Workers that were put in quarantine, and how many of their executions had been compared by then."""

    @property
    def waste(self) -> float:
        """Share of the loads that no rollout ever used."""
        return self.loads_unused / self.loads if self.loads else 0.0

    @property
    def cpu_us_per_rollout(self) -> float:
        """The manager's decisions, all of them, shared among the rollouts."""
        return 1e6 * self.cpu_s / self.delivered

    @property
    def manager_load(self) -> float:
        """CPU seconds of decisions in a simulated second: above 1 one manager can't keep up."""
        return self.cpu_s / (self.elapsed_s + self.scenario.trainers[0].start_s)


class ClusterSimulation:
    """One cluster. ``run`` once; before it, ``agenda`` takes what shall happen to ``workers`` and ``front``."""

    def __init__(self, scenario: SimulationScenario) -> None:
        self._scenario = scenario
        self._setting = setting_of(scenario)
        self.agenda = Agenda()
        self._auditor = InvariantChecker(self.agenda)
        self._gauge = Gauge()
        self._cluster = ClusterState(scenario.dispatch, scenario.schedule, boot_id="simulated")
        numbers = iter(range(1 << 62))
        registry = Registry(scenario.liveness, new_id=lambda: f"session-{next(numbers)}")
        intake = Intake(self._cluster, registry)
        self.front = SimulatedManager(self.agenda, intake, self._auditor, self._gauge, scenario.manager)
        self.workers = self._hire()
        self._trainers = [
            SimulatedTrainer(
                plan,
                list(self._setting.scenes),
                self.agenda,
                self.front,
                self._gauge,
                rng_for(scenario, 3, at),
            )
            for at, plan in enumerate(scenario.trainers)
        ]

    def run(self) -> Report:
        """Raises BrokenInvariantError when an invariant does not hold, or rollouts have no outcome in time."""
        self.front.keep_time()
        self.agenda.after(0.0, self._look)
        with _without_collector():
            in_time = self.agenda.run(until=self._ended, limit_s=self._scenario.limit_s)
        # Audits of what was delivered end with their run.
        leases = self._cluster.dispatcher.live_leases.values()
        live = [lease for lease in leases if not lease.record.check]
        if not in_time or not self._auditor.complete or live:
            raise BrokenInvariantError(
                f"after {self.agenda.now_s:.0f} s {self._auditor.delivered} of {self._scenario.rollouts} rollouts have "
                f"an outcome, {len(live)} leases live"
            )
        return self._report()

    def _hire(self) -> list[SimulatedWorker]:
        joins = rng_for(self._scenario, 2).uniform(0.0, self._scenario.join_s, len(self._setting.machines))
        workers = []
        for at, machine in enumerate(self._setting.machines):
            worker = SimulatedWorker(
                machine,
                self._scenario,
                self._setting,
                self.agenda,
                self.front,
                self._auditor,
                self._gauge,
                random.Random(f"{self._scenario.seed}.{at}"),
            )
            self.agenda.after(float(joins[at]), worker.boot)
            workers.append(worker)
        return workers

    def _ended(self) -> bool:
        return all(trainer.done for trainer in self._trainers)

    def _look(self) -> None:
        warmed_up = all(trainer.warmed_up for trainer in self._trainers)
        if warmed_up and self._auditor.open_rollouts >= self._setting.slots:
            at_work = sum(worker.slots.executing for worker in self.workers if worker.slots is not None)
            self._gauge.pressed.append((at_work, self._setting.slots))
        if len(self._trainers) > 1:
            self._look_at_shares()
        self.agenda.after(SAMPLE_S, self._look)

    def _look_at_shares(self) -> None:
        """Note what each run has of the slots while all of them want more than there are."""
        wanted = self._auditor.open_by_run
        if all(wanted[trainer.plan.name] >= 2 * self._setting.slots for trainer in self._trainers):
            for worker in self.workers:
                if worker.slots is not None:
                    self._gauge.shared += worker.slots.executing_of()

    def _report(self) -> Report:
        for worker in self.workers:
            if worker.slots is not None:
                worker.slots.count_unused()
        began_s = min(plan.start_s for plan in self._scenario.trainers)
        elapsed_s = max(trainer.ended_s for trainer in self._trainers) - began_s
        gauge = self._gauge
        at_work, there = (sum(column) for column in zip((0, 0), *gauge.pressed, strict=True))
        queued = sorted(gauge.queued_s)
        return Report(
            scenario=self._scenario,
            slots=self._setting.slots,
            submitted=self._auditor.submitted,
            delivered=self._auditor.delivered,
            infra_failures=self._auditor.infra_failures,
            stats=self._cluster.totals(),
            elapsed_s=elapsed_s,
            waits_s=tuple(gauge.waits_s),
            queued_p50_s=quantile(queued, 0.5),
            queued_p99_s=quantile(queued, 0.99),
            utilisation=gauge.busy_s / (elapsed_s * self._setting.slots),
            pressed_utilisation=at_work / there if there else None,
            stall=fmean(t.waited_s / (t.ended_s - t.warmed_up_s) for t in self._trainers),
            foretold=gauge.foretold,
            hit_rate=gauge.warm / gauge.foretold if gauge.foretold else 1.0,
            loads=gauge.loads,
            loads_unused=gauge.loads_unused,
            cpu_s=gauge.cpu_s,
            detected_s=tuple(gauge.detected_s),
            orphaned_s=tuple(self._auditor.orphaned_s),
            start_latency_s=fmean(gauge.first_queued_s) if gauge.first_queued_s else 0.0,
            first_result_s=max(trainer.first_result_s for trainer in self._trainers),
            groups_s={trainer.plan.name: tuple(trainer.groups_s) for trainer in self._trainers},
            shares={run: count / gauge.shared.total() for run, count in sorted(gauge.shared.items())},
            lag_p99_s=quantile(sorted(gauge.lags_s), 0.99),
            costs=gauge.costs,
            counts=gauge.counts,
            caught=gauge.caught,
        )


@contextlib.contextmanager
def _without_collector() -> Iterator[None]:
    """Python's search for cycles would walk through the whole simulated world, and be charged to the manager."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def simulate(scenario: SimulationScenario) -> Report:
    """Run it to its end. Raises BrokenInvariantError."""
    return ClusterSimulation(scenario).run()
