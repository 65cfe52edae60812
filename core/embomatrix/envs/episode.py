"""Episodes in this process: a simulator and the reward, without a cluster."""

import contextlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.reward.hierarchy import score
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.sim.executor import Simulator
from embomatrix.sim.film import FilmFrame, snapshot
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.prompt import Codec, Prompt, Situation, prompt_for, situation_of
from embomatrix.skills.syntax import MAX_STEPS, Plan, SkillCall
from embomatrix.skills.trace import Step, Trace
from embomatrix.starter.shipped import dataset_named
from embomatrix.world.bundle import Bundle
from embomatrix.world.dataset import TaskRecord
from embomatrix.world.scene import Scene
from embomatrix.world.task import Task

SCENES_KEPT: Final = 4
"""Simulators kept for the next task of their scene, about 100 MB each."""


@dataclass(frozen=True, slots=True)
class EpisodeStep:
    """Outcome of one call. ``gain`` is the change of the reward; ``reward`` is that of the state reached."""

    step: Step
    reward: RewardBreakdown
    gain: float
    over: bool
    """True if the plan has reached its maximum length."""


class Episode:
    """Task in its scene. ``run`` executes a whole plan as a cluster does; ``reset`` and ``act`` go call by call.

    A failed call changes nothing and the episode continues; on the cluster the plan would end. In an episode without failed
    calls, the gains add up to the reward of the same plan.
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
        """Execute a plan from the start to its end or first failed step. Return its trace and its reward."""
        trace = self._simulator.execute(self.task, plan, seed)
        return trace, self._score()

    def reset(self, seed: int = 0) -> None:
        """Return to the scene's start."""
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

    def skip(self) -> bool:
        """Count a call that could not be understood, and return whether the plan has reached its maximum length."""
        self._calls += 1
        return self._calls >= MAX_STEPS

    def prompt(self, codec: Codec = Codec.JSON) -> Prompt:
        """Prompt of the task for a language model."""
        return prompt_for(self.situation, codec)

    def state(self) -> tuple[str, ...]:
        """State reached, one line per object of the table."""
        return self._simulator.survey(self.task)

    @property
    def scene(self) -> Scene:
        """Scene at its start."""
        return self._simulator.world.scene

    def frame(self) -> FilmFrame:
        """State reached, as a frame of a film."""
        return snapshot(self._simulator.world, self._calls)

    def _score(self) -> RewardBreakdown:
        return score(self.task, self._simulator.touched, self._simulator.facts, self._reward)


class Household:
    """Context manager over the tasks of a dataset, a folder or one that ships by its name. A few scenes are kept loaded.

    Raises DatasetError for a folder without a dataset, EngineError for a scene that can't be loaded.
    """

    def __init__(
        self,
        dataset: str | Path,
        reward: RewardSettings = PAPER,
        simulate: Callable[[Bundle], Simulator] = load_simulator,
    ) -> None:
        self._dataset = dataset_named(str(dataset))
        self._reward = reward
        self._simulate = simulate
        self._scenes: OrderedDict[str, tuple[Bundle, Simulator]] = OrderedDict()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def records(self) -> tuple[TaskRecord, ...]:
        """Tasks in the dataset's order."""
        return self._dataset.records

    def episode(self, task_id: str) -> Episode:
        """Task at its start. Episodes of one scene share a simulator: use one at a time."""
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
