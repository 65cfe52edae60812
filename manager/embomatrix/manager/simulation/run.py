"""Discrete-event simulation of a cluster, from scenario to report. A broken invariant ends it."""

import contextlib
import gc
import random
from collections.abc import Iterator
from statistics import fmean
from typing import Final

from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.runtime.intake import Intake
from embomatrix.manager.runtime.registry import Registry
from embomatrix.manager.simulation.invariants import BrokenInvariantError, InvariantChecker
from embomatrix.manager.simulation.machines import SimulatedWorld, rng_for, setting_of
from embomatrix.manager.simulation.manager import SimulatedManager
from embomatrix.manager.simulation.network import EventQueue
from embomatrix.manager.simulation.report import Report
from embomatrix.manager.simulation.scenario import SimulationScenario
from embomatrix.manager.simulation.trainer import SimulatedTrainer
from embomatrix.manager.simulation.worker import SimulatedWorker

SAMPLE_S: Final = 0.1
"""Sampling interval of busy slots."""


class ClusterSimulation:
    """One cluster, to be run once. Actions on ``workers`` and ``manager`` are scheduled in ``queue`` before."""

    def __init__(self, scenario: SimulationScenario) -> None:
        self._scenario = scenario
        self.queue = EventQueue()
        self._checker = InvariantChecker(self.queue)
        self._setting = setting_of(scenario)
        self._report = Report(scenario, self._setting.slots)
        self._world = SimulatedWorld(self._setting, self.queue, self._checker, self._report)
        self._cluster = ClusterState(scenario.dispatch, scenario.schedule, lease_key=b"simulated")
        numbers = iter(range(1 << 62))
        registry = Registry(scenario.liveness, new_id=lambda: f"session-{next(numbers)}")
        self.manager = SimulatedManager(self._world, Intake(self._cluster, registry))
        self.workers = self._make_workers()
        self._trainers = [
            SimulatedTrainer(plan, self._world, self.manager, rng_for(scenario, 3, at))
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
        self._complete_report()
        return self._report

    def _make_workers(self) -> list[SimulatedWorker]:
        joins = rng_for(self._scenario, 2).uniform(0.0, self._scenario.join_s, len(self._setting.machines))
        workers = []
        for at, machine in enumerate(self._setting.machines):
            dice = random.Random(f"{self._scenario.seed}.{at}")
            worker = SimulatedWorker(machine, self._world, self.manager, dice)
            self.queue.after(float(joins[at]), worker.boot)
            workers.append(worker)
        return workers

    def _ended(self) -> bool:
        return all(trainer.done for trainer in self._trainers)

    def _sample(self) -> None:
        warmed_up = all(trainer.warmed_up for trainer in self._trainers)
        if warmed_up and self._checker.open_rollouts >= self._setting.slots:
            at_work = sum(worker.slots.executing for worker in self.workers if worker.slots is not None)
            self._report.busy.append(at_work)
        if len(self._trainers) > 1:
            self._sample_shares()
        self.queue.after(SAMPLE_S, self._sample)

    def _sample_shares(self) -> None:
        """Sample each run's slots while all runs want more slots than there are."""
        wanted = self._checker.open_by_run
        if all(wanted[trainer.plan.name] >= 2 * self._setting.slots for trainer in self._trainers):
            for worker in self.workers:
                if worker.slots is not None:
                    self._report.shared += worker.slots.executing_of()

    def _complete_report(self) -> None:
        for worker in self.workers:
            if worker.slots is not None:
                worker.slots.count_unused()
        report, checker, trainers = self._report, self._checker, self._trainers
        report.submitted, report.delivered = checker.submitted, checker.delivered
        report.infra_failures, report.orphaned_s = checker.infra_failures, checker.orphaned_s
        report.stats = self._cluster.totals()
        report.elapsed_s = max(t.ended_s for t in trainers) - min(t.plan.start_s for t in trainers)
        report.stall = fmean(t.waited_s / (t.ended_s - t.warmed_up_s) for t in trainers)
        report.first_result_s = max(t.first_result_s for t in trainers)


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
