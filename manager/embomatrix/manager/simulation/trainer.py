"""Simulated trainer: announces its look-ahead, submits groups of plans, waits for their outcomes, and updates."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from embomatrix.manager.simulation.machines import SimulatedWorld
from embomatrix.manager.simulation.manager import SimulatedManager
from embomatrix.rpc.wire.values import Batch, Completed, LookaheadEntry, Rollout, RolloutResult

if TYPE_CHECKING:
    import numpy as np

    from embomatrix.manager.simulation.scenario import Trainer


class SimulatedTrainer:
    """One run over the scenes, in a random permutation per epoch, as the real schedule."""

    def __init__(
        self,
        plan: Trainer,
        world: SimulatedWorld,
        manager: SimulatedManager,
        rng: np.random.Generator,
    ) -> None:
        self.plan = plan
        self.done = False
        self.ended_s = 0.0
        self.warmed_up_s = plan.start_s
        """End of its first step, which could not be announced in time; the start if there is only one step."""
        self.waited_s = 0.0
        """Total time after the first step that it only waited for results."""
        self.first_result_s = math.inf
        """Time from the first submission to the first result."""
        self._queue = world.queue
        self._manager = manager
        self._report = world.report
        self._announced, self._actual = _schedule(plan, list(world.setting.scenes), rng)
        self._step = 0
        self._left = 0
        self._starts_s: dict[str, list[float]] = {}
        self._warm: dict[str, bool] = {}
        self._began_s = math.inf
        self._sent_s = 0.0
        self._open: dict[str, tuple[int, float]] = {}
        """Missing results and submission time of each group."""
        manager.open_run(plan.name, plan.terms, self._take)
        self._queue.after(plan.start_s, self._begin_step)

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
        self._queue.after(plan.latency_s, lambda: self._manager.announce(plan.name, step + 1, entries))
        self._left = plan.groups * plan.group_size
        for group in range(plan.groups):
            written_s = (group + 1) / plan.groups * plan.write_s
            self._queue.after(written_s, functools.partial(self._send, group))

    def _send(self, group: int) -> None:
        """Submit a group as a batch."""
        plan, step = self.plan, self._step
        name = f"{plan.name}.{step}.{group}"
        scene = self._actual[step][group]
        names = [f"{name}.{index}" for index in range(plan.group_size)]
        count = plan.distinct or plan.group_size
        rollouts = tuple(
            Rollout(first, name, scene, scene, (), step, plan.render, tuple(also))
            for first, *also in (names[start::count] for start in range(min(count, plan.group_size)))
        )
        self._sent_s = self._queue.now_s
        self._open[name] = plan.group_size, self._sent_s
        self._began_s = min(self._began_s, self._sent_s)
        batch = Batch(plan.name, name, step + 1, rollouts)
        self._queue.after(plan.latency_s, lambda: self._manager.submit(batch))

    def _take(self, merged: Sequence[RolloutResult]) -> None:
        results = [one for result in merged for one in result.each()]
        for result in results:
            left, sent_s = self._open[result.group_id]
            self._open[result.group_id] = left - 1, sent_s
            if left == 1:
                self._report.groups_s[self.plan.name].append(self._queue.now_s - sent_s)
            if isinstance(result.outcome, Completed):
                self._starts_s.setdefault(result.group_id, []).append(result.outcome.timings.queued_s)
                self._warm[result.group_id] = result.outcome.warm
        self._queue.after(self.plan.latency_s, lambda: self._count(len(results)))

    def _count(self, results: int) -> None:
        self.first_result_s = min(self.first_result_s, self._queue.now_s - self._began_s)
        self._left -= results
        if self._left:
            return
        self._report.first_queued_s += [min(starts) for starts in self._starts_s.values()]
        if self._step:
            self._report.foretold += len(self._warm)
            self._report.warm += sum(self._warm.values())
        self._starts_s.clear()
        self._warm.clear()
        self._report.waits_s.append(self._queue.now_s - self._sent_s)
        if self._step or self.plan.steps == 1:
            self.waited_s += self._queue.now_s - self._sent_s
        else:
            self.warmed_up_s = self._queue.now_s
        self._step += 1
        if self._step < self.plan.steps:
            self._queue.after(self.plan.update_s, self._begin_step)
        else:
            self.done, self.ended_s = True, self._queue.now_s


def _schedule(
    plan: Trainer, scenes: Sequence[str], rng: np.random.Generator
) -> tuple[list[list[str]], list[list[str]]]:
    """Return the announced and the actual scenes of each step's groups."""
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
