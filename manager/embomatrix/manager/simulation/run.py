"""Discrete-event simulation of a cluster, from scenario to report. A broken invariant ends it."""

import contextlib
import gc
import random
from collections.abc import Iterator
from statistics import fmean
from typing import Final

from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.histogram import quantile
from embomatrix.manager.runtime.intake import Intake
from embomatrix.manager.runtime.registry import Registry
from embomatrix.manager.simulation.invariants import BrokenInvariantError, InvariantChecker
from embomatrix.manager.simulation.machines import rng_for, setting_of
from embomatrix.manager.simulation.manager import SimulatedManager
from embomatrix.manager.simulation.network import EventQueue
from embomatrix.manager.simulation.report import Measurements, Report
from embomatrix.manager.simulation.scenario import SimulationScenario
from embomatrix.manager.simulation.trainer import SimulatedTrainer
from embomatrix.manager.simulation.worker import SimulatedWorker

SAMPLE_S: Final = 0.1
"""Sampling interval of busy slots."""


class ClusterSimulation:
    """One cluster, to be run once. Actions on ``workers`` and ``manager`` are scheduled in ``queue`` before."""

    def __init__(self, scenario: SimulationScenario) -> None:
        self._scenario = scenario
        self._setting = setting_of(scenario)
        self.queue = EventQueue()
        self._checker = InvariantChecker(self.queue)
        self._measured = Measurements()
        self._cluster = ClusterState(scenario.dispatch, scenario.schedule, boot_id="simulated")
        numbers = iter(range(1 << 62))
        registry = Registry(scenario.liveness, new_id=lambda: f"session-{next(numbers)}")
        intake = Intake(self._cluster, registry)
        self.manager = SimulatedManager(self.queue, intake, self._checker, self._measured, scenario.manager)
        self.workers = self._make_workers()
        self._trainers = [
            SimulatedTrainer(
                plan,
                list(self._setting.scenes),
                self.queue,
                self.manager,
                self._measured,
                rng_for(scenario, 3, at),
            )
            for at, plan in enumerate(scenario.trainers)
        ]

    def run(self) -> Report:
        """Run to the end. Raise BrokenInvariantError if an invariant breaks or rollouts have no outcome in time."""
        self.manager.tick_forever()
        self.queue.after(0.0, self._sample)
        with _without_collector():
            in_time = self.queue.run(until=self._ended, limit_s=self._scenario.limit_s)
        # Checks of delivered results end with their run.
        leases = self._cluster.dispatcher.live_leases.values()
        live = [lease for lease in leases if not lease.record.check]
        if not in_time or not self._checker.complete or live:
            raise BrokenInvariantError(
                f"after {self.queue.now_s:.0f} s {self._checker.delivered} of {self._scenario.rollouts} rollouts have "
                f"an outcome, {len(live)} leases live"
            )
        return self._report()

    def _make_workers(self) -> list[SimulatedWorker]:
        joins = rng_for(self._scenario, 2).uniform(0.0, self._scenario.join_s, len(self._setting.machines))
        workers = []
        for at, machine in enumerate(self._setting.machines):
            worker = SimulatedWorker(
                machine,
                self._scenario,
                self._setting,
                self.queue,
                self.manager,
                self._checker,
                self._measured,
                random.Random(f"{self._scenario.seed}.{at}"),
            )
            self.queue.after(float(joins[at]), worker.boot)
            workers.append(worker)
        return workers

    def _ended(self) -> bool:
        return all(trainer.done for trainer in self._trainers)

    def _sample(self) -> None:
        warmed_up = all(trainer.warmed_up for trainer in self._trainers)
        if warmed_up and self._checker.open_rollouts >= self._setting.slots:
            at_work = sum(worker.slots.executing for worker in self.workers if worker.slots is not None)
            self._measured.pressed.append((at_work, self._setting.slots))
        if len(self._trainers) > 1:
            self._sample_shares()
        self.queue.after(SAMPLE_S, self._sample)

    def _sample_shares(self) -> None:
        """Sample each run's slots while all runs want more slots than there are."""
        wanted = self._checker.open_by_run
        if all(wanted[trainer.plan.name] >= 2 * self._setting.slots for trainer in self._trainers):
            for worker in self.workers:
                if worker.slots is not None:
                    self._measured.shared += worker.slots.executing_of()

    def _report(self) -> Report:
        for worker in self.workers:
            if worker.slots is not None:
                worker.slots.count_unused()
        began_s = min(plan.start_s for plan in self._scenario.trainers)
        elapsed_s = max(trainer.ended_s for trainer in self._trainers) - began_s
        measured = self._measured
        at_work, there = (sum(column) for column in zip((0, 0), *measured.pressed, strict=True))
        return Report(
            scenario=self._scenario,
            slots=self._setting.slots,
            submitted=self._checker.submitted,
            delivered=self._checker.delivered,
            infra_failures=self._checker.infra_failures,
            stats=self._cluster.totals(),
            elapsed_s=elapsed_s,
            waits_s=tuple(measured.waits_s),
            pressed_utilisation=at_work / there if there else None,
            stall=fmean(t.waited_s / (t.ended_s - t.warmed_up_s) for t in self._trainers),
            foretold=measured.foretold,
            hit_rate=measured.warm / measured.foretold if measured.foretold else 1.0,
            loads=measured.loads,
            loads_unused=measured.loads_unused,
            cpu_s=measured.cpu_s,
            detected_s=tuple(measured.detected_s),
            orphaned_s=tuple(self._checker.orphaned_s),
            start_latency_s=fmean(measured.first_queued_s) if measured.first_queued_s else 0.0,
            first_result_s=max(trainer.first_result_s for trainer in self._trainers),
            groups_s={trainer.plan.name: tuple(trainer.groups_s) for trainer in self._trainers},
            shares={run: count / measured.shared.total() for run, count in sorted(measured.shared.items())},
            lag_p99_s=quantile(sorted(measured.lags_s), 0.99),
            counts=measured.counts,
            caught=measured.caught,
        )


@contextlib.contextmanager
def _without_collector() -> Iterator[None]:
    """Switch Python's garbage collector off: it would scan the simulated world at the manager's expense."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def simulate(scenario: SimulationScenario) -> Report:
    """Run a scenario. Raise BrokenInvariantError."""
    return ClusterSimulation(scenario).run()
