"""Episodes of a dataset's tasks, played by answers in words.

A thread of its own runs the event loop, so the calls can be used in scripts, notebooks and threads of a trainer alike.
"""

from __future__ import annotations

import asyncio
import atexit
import threading
from collections.abc import Coroutine, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self, TypeVar

import numpy as np

from embomatrix.envs.player import EpisodePlayer, Observation
from embomatrix.envs.rules import EpisodeRules, Visibility
from embomatrix.skills.prompt import Codec, Prompt, situation_of
from embomatrix.world.dataset import SPLITS, Dataset, DatasetError

if TYPE_CHECKING:
    from embomatrix.envs.simulation import Simulation
    from embomatrix.skills.turns import Advice
    from embomatrix.world.dataset import TaskRecord

T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class PlayedEpisode:
    """Episode of an environment. ``prompt`` opens it."""

    task_id: str
    prompt: Prompt
    player: EpisodePlayer
    """Its rules, knowledge, steps so far, reward and end."""


class Environment:
    """Context manager over episodes of a dataset's tasks, any number side by side. ``envs.make`` opens one.

    ``reset`` and ``step`` play one episode; ``begin`` and ``answer`` play many, whose turns are executed together.
    """

    def __init__(
        self,
        dataset: Dataset,
        split: str,
        rules: EpisodeRules,
        codec: Codec,
        simulation: Simulation,
        seed: int,
    ) -> None:
        self.records = tuple(record for record in dataset.records if record.split == split)
        """Tasks of the split, with their oracle plans."""
        if not self.records:
            raise DatasetError(
                f"the dataset at {dataset.folder} has no task of the split {split!r}: expected one of {', '.join(SPLITS)} "
                "with tasks"
            )
        self._split = split
        self.rules = rules
        self.dataset = dataset
        """Tasks of all splits, and their scenes."""
        self._codec = codec
        self._simulation = simulation
        self._draws = np.random.default_rng(seed)
        self._current: PlayedEpisode | None = None
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="episodes", daemon=True)
        self._thread.start()
        try:
            self._wait(simulation.open())
        except BaseException:
            self._end_loop()
            raise
        # Scripts of trainers end without closing it, and a run on a cluster would stay open.
        atexit.register(self.close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def task_ids(self) -> tuple[str, ...]:
        """Ids of the tasks of the split."""
        return tuple(record.task.task_id for record in self.records)

    def reset(self, task_id: str = "", seed: int | None = None) -> Prompt:
        """Begin an episode for ``step`` and return its opening prompt.

        Without a task and a seed, both are drawn. Raises DatasetError for an unknown task, and what executing a turn raises.
        """
        named = task_id or self.task_ids[int(self._draws.integers(len(self.records)))]
        drawn = int(self._draws.integers(2**31)) if seed is None else seed
        (self._current,) = self.begin([(named, drawn)])
        return self._current.prompt

    def step(self, text: str) -> Observation:
        """Take the policy's answer in the episode that ``reset`` began. Raises RuntimeError without one, or after its end."""
        (observation,) = self.answer([self._playing], [text])
        return observation

    def advise(self) -> Advice:
        """Ask the oracle for calls that reach the goal from here on, in the episode that ``reset`` began. Counts as no call.

        The oracle sees the goal and the whole state, and may name rows that the policy has not seen. Raises RuntimeError
        without an episode.
        """
        return self._wait(self._playing.player.advise())

    @property
    def _playing(self) -> PlayedEpisode:
        if self._current is None:
            raise RuntimeError("no episode was begun: call reset first")
        return self._current

    def begin(self, tasks: Sequence[tuple[str, int]]) -> tuple[PlayedEpisode, ...]:
        """Begin an episode of each task, with its seed. Raises DatasetError for a task that the split lacks."""
        records = [(self._find(task_id), seed) for task_id, seed in tasks]
        return self._wait(_all([self._begin(record, seed) for record, seed in records]))

    def answer(self, episodes: Sequence[PlayedEpisode], texts: Sequence[str]) -> tuple[Observation, ...]:
        """Take one answer for each of the episodes, and execute them together.

        Raises ValueError for another number of answers, and for one that is no text; and what executing a turn raises, after
        all turns have ended. The others are executed then: ``player.observation`` of their episodes has what came of them.
        """
        if len(episodes) != len(texts):
            raise ValueError(
                f"found {len(texts)} answers for {len(episodes)} episodes: expected one for each"
            )
        for text in texts:
            if not isinstance(text, str):
                raise ValueError(f"an answer is {type(text).__name__}: expected a text")
        return self._wait(
            _all([each.player.answer(text) for each, text in zip(episodes, texts, strict=True)])
        )

    def _find(self, task_id: str) -> TaskRecord:
        record = self.dataset.find(task_id)
        if record.split != self._split:
            raise DatasetError(
                f"the task {task_id} is of the split {record.split}, and this environment plays {self._split}: name one of its "
                f"task_ids, or make another environment with split={record.split!r}"
            )
        return record

    def announce(self, steps: Sequence[Sequence[str]], count: int) -> None:
        """Say which tasks, by id, the coming steps play, with ``count`` episodes of each: a cluster loads their scenes by then.

        Replaces what was announced before, and does not wait. Raises DatasetError for an unknown task.
        """
        records = [[self.dataset.find(task_id) for task_id in step] for step in steps]
        asyncio.run_coroutine_threadsafe(self._simulation.announce(records, count), self._loop)

    def close(self) -> None:
        """Free the simulators, or close the run on the cluster."""
        atexit.unregister(self.close)
        if self._thread.is_alive():
            try:
                self._wait(self._simulation.close())
            finally:
                self._end_loop()

    async def _begin(self, record: TaskRecord, seed: int) -> PlayedEpisode:
        sight = self.rules.visibility is Visibility.SEEN
        bundle = self.dataset.read_bundle(record.bundle_digest)
        situation = situation_of(bundle.scene, record.task)
        running = await self._simulation.begin(record, seed, sight=sight)
        player = EpisodePlayer(running, situation, self.rules, self._codec, self._simulation.reward)
        return PlayedEpisode(record.task.task_id, await player.begin(), player)

    def _wait(self, work: Coroutine[object, object, T]) -> T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    def _end_loop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


async def _all(work: Sequence[Coroutine[object, object, T]]) -> tuple[T, ...]:
    """Await all. An error of one is raised when all have ended."""
    results = await asyncio.gather(*work, return_exceptions=True)
    for result in results:
        if isinstance(result, BaseException):
            raise result
    return tuple(result for result in results if not isinstance(result, BaseException))
