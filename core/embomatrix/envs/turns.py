"""Closed-loop episodes in this process, turn by turn like those of a cluster."""

from __future__ import annotations

import asyncio
import contextlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Self

from embomatrix.reward.hierarchy import Fulfilment, judge, worth
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.reward.turns import EpisodeStart, RunningEpisode, Turn
from embomatrix.sim.planner.oracle import advice_from_here
from embomatrix.sim.simulation import load_simulator
from embomatrix.sim.transitions import TransitionTree

if TYPE_CHECKING:
    from embomatrix.sim.executor import Simulator
    from embomatrix.skills.syntax import Plan
    from embomatrix.skills.turns import EpisodePrefix
    from embomatrix.world.bundle import Bundle
    from embomatrix.world.dataset import Dataset, TaskRecord

SCENES_KEPT: Final = 4
"""Simulators kept, about 100 MB each."""


@dataclass(frozen=True, slots=True)
class _Scene:
    bundle: Bundle
    simulator: Simulator
    tree: TransitionTree[Fulfilment]


class LocalEpisodes:
    """Context manager over episodes in simulators of this process, any number side by side.

    ``read`` returns the bundle of a digest, for example ``Dataset.read_bundle``. Turns equal those of a cluster on the same
    platform to the bit.
    """

    def __init__(
        self,
        read: Callable[[str], Bundle],
        reward: RewardSettings = PAPER,
        simulate: Callable[[Bundle], Simulator] = load_simulator,
    ) -> None:
        self._read = read
        self._reward = reward
        self._simulate = simulate
        self._scenes: OrderedDict[str, _Scene] = OrderedDict()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def begin(
        self, bundle_digest: str, task_id: str, seed: int = 0, *, sight: bool = False
    ) -> RunningEpisode:
        """Begin an episode. Its scene is loaded with its first turn.

        A turn raises KeyError for an unknown task, besides what ``RunningEpisode.act`` and reading and loading raise.
        """
        return RunningEpisode(EpisodeStart(bundle_digest, task_id, seed, sight), self._take_turn)

    def close(self) -> None:
        """Free every simulator."""
        with contextlib.ExitStack() as stack:
            while self._scenes:
                stack.callback(self._scenes.popitem()[1].simulator.close)

    async def _take_turn(
        self, start: EpisodeStart, plan: Plan, prefix: EpisodePrefix, *, advise: bool = False
    ) -> Turn:
        await asyncio.sleep(0)  # other episodes take turns
        scene = self._scene(start.bundle_digest)
        tasks = scene.bundle.tasks
        task = tasks.get(start.task_id)
        if task is None:
            name = f"bundle {start.bundle_digest} has no task {start.task_id!r}"
            raise KeyError(f"{name}: expected one of its {len(tasks)} tasks")
        run, judgement, _ = scene.tree.execute_turn(task, plan, start.seed, prefix.length, sight=start.sight)
        prefix.check(run.steps[: prefix.length], run.prefix_digest)
        observation = run.observation
        if advise:
            advice = scene.tree.after_turn(task, plan, start.seed, prefix.length, advice_from_here)
            observation = replace(observation, advice=advice)
        return Turn(
            run.steps[prefix.length :],
            observation,
            worth(task, run.touched, judgement, self._reward),
            run.digest,
        )

    def _scene(self, digest: str) -> _Scene:
        if digest not in self._scenes:
            if len(self._scenes) >= SCENES_KEPT:
                self._scenes.popitem(last=False)[1].simulator.close()
            bundle = self._read(digest)
            simulator = self._simulate(bundle)
            tree = TransitionTree(simulator, lambda task: judge(task, simulator.facts))
            self._scenes[digest] = _Scene(bundle, simulator, tree)
        self._scenes.move_to_end(digest)
        return self._scenes[digest]


class LocalSimulation:
    """Simulators of this process."""

    scenes = SCENES_KEPT

    def __init__(self, dataset: Dataset, reward: RewardSettings = PAPER) -> None:
        self.reward = reward
        self._episodes = LocalEpisodes(dataset.read_bundle, reward)

    async def open(self) -> None:
        pass

    async def announce(self, steps: Sequence[Sequence[TaskRecord]], count: int) -> None:
        """Without effect: a scene is loaded with its first turn."""

    async def begin(self, record: TaskRecord, seed: int, *, sight: bool) -> RunningEpisode:
        return self._episodes.begin(record.bundle_digest, record.task.task_id, seed, sight=sight)

    async def close(self) -> None:
        self._episodes.close()
