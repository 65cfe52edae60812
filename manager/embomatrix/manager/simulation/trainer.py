"""A simulated trainer: announces its window, writes groups of plans, waits for their outcomes, and updates."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING

from embomatrix.rpc.wire.values import Batch, Completed, LookaheadEntry, Rollout

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from embomatrix.manager.simulation.agenda import Agenda
    from embomatrix.manager.simulation.front import SimulatedManager
    from embomatrix.manager.simulation.gauge import Gauge
    from embomatrix.manager.simulation.scenario import Trainer
    from embomatrix.rpc.wire.values import RolloutResult


class SimulatedTrainer:
    """One run over the scenes, in an order that ``rng`` gives: every epoch a permutation, as the real schedule."""

    def __init__(
        self,
        plan: Trainer,
        scenes: Sequence[str],
        agenda: Agenda,
        front: SimulatedManager,
        gauge: Gauge,
        rng: np.random.Generator,
    ) -> None:
        self.plan = plan
        self.done = False
        self.ended_s = 0.0
        self.warmed_up_s = plan.start_s
        """When its first step was over, which nobody could announce in time; where there is only one, when it began."""
        self.groups_s: list[float] = []
        """From the submission of each group to its last result."""
        self.waited_s = 0.0
        """Since then: from the last submission of each step to its last result."""
        self.first_result_s = math.inf
        """From the first submission to the first result."""
        self._agenda = agenda
        self._front = front
        self._gauge = gauge
        self._announced, self._actual = _schedule(plan, scenes, rng)
        self._step = 0
        self._left = 0
        self._starts_s: dict[str, list[float]] = {}
        self._warm: dict[str, bool] = {}
        self._began_s = math.inf
        self._sent_s = 0.0
        self._open: dict[str, tuple[int, float]] = {}
        """By group: results to come, and when it was sent."""
        front.open_run(plan.name, plan.terms, self._take)
        agenda.after(plan.start_s, self._begin_step)

    @property
    def warmed_up(self) -> bool:
        return self._step > 0 or self.plan.steps == 1

    def _begin_step(self) -> None:
        plan, step = self.plan, self._step
        window = [(step, self._actual[step])] + [
            (later, self._announced[later])
            for later in range(step + 1, min(step + plan.lookahead, plan.steps - 1) + 1)
        ]
        entries = tuple(
            LookaheadEntry(at + 1, scene, plan.group_size, plan.render)
            for at, scenes in window
            for scene in scenes
        )
        self._agenda.after(plan.latency_s, lambda: self._front.announce(plan.name, step + 1, entries))
        self._left = plan.groups * plan.group_size
        for group in range(plan.groups):
            written_s = (group + 1) / plan.groups * plan.write_s
            self._agenda.after(written_s, functools.partial(self._send, group))

    def _send(self, group: int) -> None:
        """One batch for each group, as soon as its plans are written."""
        plan, step = self.plan, self._step
        name = f"{plan.name}.{step}.{group}"
        scene = self._actual[step][group]
        rollouts = tuple(
            Rollout(f"{name}.{index}", name, scene, scene, (), step, plan.render)
            for index in range(plan.group_size)
        )
        self._sent_s = self._agenda.now_s
        self._open[name] = plan.group_size, self._sent_s
        self._began_s = min(self._began_s, self._sent_s)
        batch = Batch(plan.name, name, step + 1, rollouts)
        self._agenda.after(plan.latency_s, lambda: self._front.submit(batch))

    def _take(self, results: Sequence[RolloutResult]) -> None:
        for result in results:
            left, sent_s = self._open[result.group_id]
            self._open[result.group_id] = left - 1, sent_s
            if left == 1:
                self.groups_s.append(self._agenda.now_s - sent_s)
            if isinstance(result.outcome, Completed):
                self._gauge.queued_s.append(result.outcome.timings.queued_s)
                self._starts_s.setdefault(result.group_id, []).append(result.outcome.timings.queued_s)
                self._warm[result.group_id] = result.outcome.warm
        self._agenda.after(self.plan.latency_s, lambda: self._count(len(results)))

    def _count(self, results: int) -> None:
        self.first_result_s = min(self.first_result_s, self._agenda.now_s - self._began_s)
        self._left -= results
        if self._left:
            return
        self._gauge.first_queued_s += [min(starts) for starts in self._starts_s.values()]
        if self._step:
            self._gauge.foretold += len(self._warm)
            self._gauge.warm += sum(self._warm.values())
        self._starts_s.clear()
        self._warm.clear()
        self._gauge.waits_s.append(self._agenda.now_s - self._sent_s)
        if self._step or self.plan.steps == 1:
            self.waited_s += self._agenda.now_s - self._sent_s
        else:
            self.warmed_up_s = self._agenda.now_s
        self._step += 1
        if self._step < self.plan.steps:
            self._agenda.after(self.plan.update_s, self._begin_step)
        else:
            self.done, self.ended_s = True, self._agenda.now_s


def _schedule(
    plan: Trainer, scenes: Sequence[str], rng: np.random.Generator
) -> tuple[list[list[str]], list[list[str]]]:
    """What each step's groups are announced to need, and what they will need."""
    order: list[str] = []
    while len(order) < plan.steps * plan.groups:
        order += [scenes[at] for at in rng.permutation(len(scenes))]
    announced = [order[step * plan.groups : (step + 1) * plan.groups] for step in range(plan.steps)]
    actual = [
        [
            scenes[int(rng.integers(len(scenes)))] if rng.random() < plan.surprises else scene
            for scene in groups
        ]
        for groups in announced
    ]
    return announced, actual
