"""Taught episodes: the policy begins, and the oracle finishes from wherever that led (DAgger: Ross et al. 2011).

The oracle's own episodes show states that good answers lead to. Without teaching, imitation never shows those that the policy's
answers lead to: a door left open, the wrong thing in the hand, a room searched twice.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from embomatrix.scripts.searching import PlacePriors, SearchingScript
from embomatrix.skills.seeds import training_seed
from embomatrix.trainer.cluster.gateway import refuse_without_workers
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.episodes.batches import EpisodeBatch, play_batches
from embomatrix.trainer.episodes.client import ClusterEpisode, EpisodeClient, PlannedEpisode
from embomatrix.trainer.episodes.oracle import (
    ATTEMPTS,
    OracleEpisode,
    OracleExamples,
    finish,
    read_episodes,
    result_of_all,
    successful,
    write_episodes,
)
from embomatrix.trainer.learning.learner import SamplingParams

if TYPE_CHECKING:
    from embomatrix.trainer.config.settings import TrainSettings
    from embomatrix.trainer.data.tasks import TrainingTask
    from embomatrix.trainer.episodes.terms import EpisodeTerms
    from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
    from embomatrix.trainer.policy.protocol import Policy

TAUGHT_EPISODES: Final = "taught_episodes_{}.json"
_BATCH_EPISODES: Final = 16
"""Episodes that a learner samples together."""
_CONCURRENT_BATCHES: Final = 2
"""Such batches that each learner plays at a time. With more, workers would load the scenes again and again."""
_RNG_STREAM: Final = 6
"""Part of the seed of a round's draws, which sets them apart from all others of a run."""


@dataclass(frozen=True, slots=True)
class TeachingRules:
    """Number of rounds and of their episodes, the terms of the episodes, and how the policy samples in them."""

    rounds: int
    episodes: int
    terms: EpisodeTerms
    sampling: SamplingParams
    seed: int

    @staticmethod
    def of(settings: TrainSettings, terms: EpisodeTerms) -> TeachingRules:
        """Return the rules that the settings of a run ask for."""
        table, grpo = settings.episodes, settings.grpo
        sampling = SamplingParams(1, grpo.temperature, table.answer_tokens)
        return TeachingRules(table.teacher_rounds, table.teacher_episodes, terms, sampling, settings.seed)

    def due(self, share: float) -> int:
        """Return the number of rounds that belong before this share of imitation. The rounds divide it into equal parts."""
        return min(self.rounds, int(share * (self.rounds + 1) + 1e-9))


class TeachingDisplay(Protocol):
    """Shows how far a round is, and at its end how many of its episodes succeeded."""

    def teaching(self, number: int, done: int, total: int) -> None: ...

    def taught(self, number: int, count: int, total: int) -> None: ...


class Teacher:
    """Rounds of teaching of one run, whose episodes are kept in its folder and added to its examples.

    ``learned`` are the settings and data that the policy during imitation depends on: episodes that were kept with others are
    played again. The manager and the workers must know advice; without it, a round ends with a TrainerError.
    """

    def __init__(
        self,
        folder: Path,
        learned: Mapping[str, object],
        rules: TeachingRules,
        policy: Policy,
        workers: DataParallelWorkers,
        client: EpisodeClient,
        examples: OracleExamples,
        display: TeachingDisplay,
    ) -> None:
        self._folder = folder
        self._learned = learned
        self._rules = rules
        self._policy = policy
        self._workers = workers
        self._client = client
        self._examples = examples
        self._display = display
        self._priors = PlacePriors([task.situation for task in examples.tasks])
        self._done = 0

    def teach_if_due(self, share: float, tasks: Sequence[TrainingTask]) -> None:
        """Before a step of imitation at this share of its budget, hold the rounds that are due, on some of the ``tasks``.

        Rounds of an interrupted run are read from its folder. Raises TrainerError.
        """
        while self._done < self._rules.due(share):
            self._examples.add(self._round(self._done + 1, tasks))
            self._done += 1

    def _round(self, number: int, tasks: Sequence[TrainingTask]) -> dict[str, OracleEpisode]:
        path = self._folder / TAUGHT_EPISODES.format(number)
        temperature = self._rules.sampling.temperature
        version = {"round": number, "temperature": temperature, "learned": dict(self._learned)}
        known = read_episodes(path, version)
        if known is None:
            planned = self._planned(number, tasks)
            known = self._play(number, planned)
            write_episodes(path, version, known)
            self._display.taught(number, len(known), len(planned))
        return known

    def _planned(self, number: int, tasks: Sequence[TrainingTask]) -> list[PlannedEpisode]:
        """Draw the tasks of a round, those of a scene side by side, and the answers after which the oracle takes over."""
        rules = self._rules
        rng = np.random.default_rng(np.random.SeedSequence((rules.seed, _RNG_STREAM, number)))
        chosen = rng.choice(len(tasks), size=min(rules.episodes, len(tasks)), replace=False)
        drawn = sorted((tasks[int(at)] for at in chosen), key=lambda task: task.bundle_digest)
        return [
            PlannedEpisode(
                task,
                training_seed(rules.seed, task.task.task_id, number),
                int(rng.integers(1, max(2, rules.terms.rules(task.oracle).calls // 2))),
            )
            for task in drawn
        ]

    def _play(self, number: int, planned: Sequence[PlannedEpisode]) -> dict[str, OracleEpisode]:
        """Play the episodes of a round. Return those that succeed, by task. Raises TrainerError if all were lost."""
        found: dict[str, OracleEpisode] = {}
        lost = ""
        size = _CONCURRENT_BATCHES * _BATCH_EPISODES * self._workers.count
        for start in range(0, len(planned), size):
            self._display.teaching(number, start, len(planned))
            for task_id, episode in self._begin_and_finish(number, planned, range(start, start + size)):
                taught = successful(episode, episode.policy_answers)
                if taught is not None:
                    found[task_id] = taught
                elif episode.lost is not None:
                    lost = lost or f"{episode.lost.code}: {episode.lost.message}"
        if lost and not found:
            raise TrainerError(f"round {number} of teaching has no episode: the first was lost ({lost})")
        return found

    def _begin_and_finish(
        self, number: int, planned: Sequence[PlannedEpisode], places: range
    ) -> list[tuple[str, ClusterEpisode]]:
        """Let the policy begin the episodes at these places, and the oracle finish them. Return them with their tasks."""
        starts = places[::_BATCH_EPISODES]
        batches = [
            EpisodeBatch(index, part, _batch_seed(self._rules.seed, number, start))
            for index, start in enumerate(starts)
            if (part := planned[start : start + _BATCH_EPISODES])
        ]
        played = play_batches(batches, self._workers, self._client, self._policy, self._rules.sampling)
        begun = [
            (each, episode)
            for batch in played
            for each, episode in zip(batch.batch.planned, batch.episodes, strict=True)
        ]
        finished = result_of_all(self._client.run(self._finish_all(begun)))
        refuse_without_workers([each.outcome() for each in finished], f"round {number} of teaching")
        return [(each.task.task.task_id, end) for (each, _), end in zip(begun, finished, strict=True)]

    async def _finish_all(
        self, begun: Sequence[tuple[PlannedEpisode, ClusterEpisode]]
    ) -> list[ClusterEpisode]:
        async with asyncio.TaskGroup() as group:
            finishing = [group.create_task(self._finish(each, episode)) for each, episode in begun]
        return [each.result() for each in finishing]

    async def _finish(self, planned: PlannedEpisode, episode: ClusterEpisode) -> ClusterEpisode:
        """Let the oracle finish an episode. One that the infrastructure loses is begun again with the policy's answers."""
        answers = tuple(episode.answers)
        for attempt in range(ATTEMPTS):
            if attempt:
                [episode] = await self._client.begin_all([planned])
                for answer in answers:
                    if not episode.is_over:
                        await episode.answer(answer)
            await self._finish_once(planned.task, episode)
            if episode.lost is None:
                break
        return episode

    async def _finish_once(self, task: TrainingTask, episode: ClusterEpisode) -> None:
        episode.policy_answers = len(episode.answers)
        if episode.is_over:
            return
        advice = await episode.advise()
        if advice is None or advice.problem:
            return
        script = SearchingScript.of(advice.plan, task.situation, self._priors)
        script.take_over(episode.player.observer.situation, episode.player.steps)
        await finish(episode, script)


def _batch_seed(seed: int, number: int, at: int) -> int:
    """Seed of what the policy samples in a part of a round."""
    return int(np.random.SeedSequence((seed, _RNG_STREAM, number, at)).generate_state(1)[0])
