"""One task call by call, in this process: a simulator with the reward beside it. No cluster, and no other library."""

from __future__ import annotations

import contextlib
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

from embomatrix.reward.hierarchy import score
from embomatrix.reward.settings import PAPER
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.prompt import Codec, prompt_for, situation_of
from embomatrix.skills.syntax import MAX_STEPS
from embomatrix.world.dataset import Dataset

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from embomatrix.reward.breakdown import RewardBreakdown
    from embomatrix.reward.settings import RewardSettings
    from embomatrix.sim.executor import Simulator
    from embomatrix.skills.prompt import Prompt, Situation
    from embomatrix.skills.syntax import Plan, SkillCall
    from embomatrix.skills.trace import Step, Trace
    from embomatrix.world.bundle import Bundle
    from embomatrix.world.dataset import TaskRecord
    from embomatrix.world.task import Task

SCENES_KEPT: Final = 4
"""Simulators that wait for the next task of their scene: some 100 MB each."""


@dataclass(frozen=True, slots=True)
class EpisodeStep:
    """What one call came to. ``gain`` is what it added to the reward; ``reward`` is that of the state reached."""

    step: Step
    reward: RewardBreakdown
    gain: float
    over: bool
    """The plan is as long as a plan may be."""


class Episode:
    """A task in its scene. ``run`` executes a whole plan as a cluster does; ``reset`` and ``act`` go call by call.

    A call that fails changes nothing, and the next may be tried: a plan on the cluster would end there. The gains of an
    episode without failed calls add up to the reward of its calls as one plan.
    """

    def __init__(
        self, simulator: Simulator, task: Task, situation: Situation, reward: RewardSettings = PAPER
    ) -> None:
        self.task = task
        self.situation = situation
        self._simulator = simulator
        self._reward = reward
        self._calls = 0
        self._total = 0.0

    def run(self, plan: Plan, seed: int = 0) -> tuple[Trace, RewardBreakdown]:
        """Execute a plan from the start to its end or its first failed step; its trace and its reward."""
        trace = self._simulator.execute(self.task, plan, seed)
        return trace, self._score()

    def reset(self, seed: int = 0) -> None:
        """Back to the scene's start."""
        self._simulator.reset(self.task, seed)
        self._calls = 0
        self._total = 0.0

    def act(self, call: SkillCall) -> EpisodeStep:
        """Execute one call in the state reached."""
        step = self._simulator.run_step(call)
        self._calls += 1
        reward = self._score()
        gain, self._total = reward.total - self._total, reward.total
        return EpisodeStep(step, reward, gain, over=self._calls >= MAX_STEPS)

    def prompt(self, codec: Codec = Codec.JSON) -> Prompt:
        """What a language model is told of the task at its start."""
        return prompt_for(self.situation, codec)

    def state(self) -> tuple[str, ...]:
        """The state reached, a line for each object of the table."""
        return self._simulator.survey(self.task)

    def _score(self) -> RewardBreakdown:
        return score(self.task, self._simulator.touched, self._simulator.facts, self._reward)


class Household:
    """Context manager over a dataset's tasks. Scenes are loaded when they are first needed; a few are kept.

    Raises DatasetError for a folder that holds no dataset, EngineError for a scene that can't be loaded.
    """

    def __init__(
        self,
        dataset: str | Path,
        reward: RewardSettings = PAPER,
        simulate: Callable[[Bundle], Simulator] = load_simulator,
    ) -> None:
        self._dataset = Dataset.load(dataset)
        self._reward = reward
        self._simulate = simulate
        self._scenes: OrderedDict[str, tuple[Bundle, Simulator]] = OrderedDict()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def records(self) -> tuple[TaskRecord, ...]:
        """The tasks, in the dataset's order."""
        return self._dataset.records

    def episode(self, task_id: str) -> Episode:
        """A task, ready at its start. Episodes of one scene share its simulator: use one at a time."""
        record = self._dataset.find(task_id)
        bundle, simulator = self._scene(record.bundle_digest)
        task = bundle.tasks[task_id]
        episode = Episode(simulator, task, situation_of(bundle.scene, task), self._reward)
        episode.reset()
        return episode

    def close(self) -> None:
        """Free every simulator."""
        with contextlib.ExitStack() as stack:
            while self._scenes:
                stack.callback(self._scenes.popitem()[1][1].close)

    def _scene(self, digest: str) -> tuple[Bundle, Simulator]:
        if digest not in self._scenes:
            if len(self._scenes) >= SCENES_KEPT:
                self._scenes.popitem(last=False)[1][1].close()
            bundle = self._dataset.read_bundle(digest)
            self._scenes[digest] = bundle, self._simulate(bundle)
        self._scenes.move_to_end(digest)
        return self._scenes[digest]
