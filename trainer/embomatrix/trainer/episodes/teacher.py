"""Taught episodes: the policy begins, and the oracle finishes from wherever that led (DAgger: Ross et al. 2011).

The oracle's episodes show states that good answers lead to. Those that the policy's own answers lead to, it would otherwise
never see in imitation: a door left open, the wrong thing in the hand, a room searched twice.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.rpc.status import ClusterError
from embomatrix.scripts.searching import PlacePriors, SearchingScript
from embomatrix.skills.episode_text import FORMAT
from embomatrix.skills.seeds import training_seed
from embomatrix.trainer.cluster.gateway import refuse_without_workers, result_of
from embomatrix.trainer.config.errors import TrainerError, first_of
from embomatrix.trainer.episodes.batches import EpisodeBatch, play_batches
from embomatrix.trainer.episodes.client import ClusterEpisode, EpisodeClient, PlannedEpisode
from embomatrix.trainer.episodes.oracle import (
    OracleEpisode,
    OracleExamples,
    finish,
    kept_episodes,
    successful,
    write_episodes,
)
from embomatrix.trainer.learning.learner import SamplingRule

if TYPE_CHECKING:
    from embomatrix.trainer.config.settings import TrainSettings
    from embomatrix.trainer.data.tasks import TrainingTask
    from embomatrix.trainer.episodes.terms import EpisodeTerms
    from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
    from embomatrix.trainer.policy.tiny import TinyPolicy

TAUGHT_EPISODES: Final = "taught_episodes_{}.json"
_TOGETHER: Final = 64
"""Episodes that are sampled together."""
_STREAM: Final = 4
"""Part of the seed of a round's draws, which sets them apart from those of imitation."""


@dataclass(frozen=True, slots=True)
class TeachingRules:
    """Rounds of teaching in a run: how many, their episodes, and the budgets of calls by the terms of the run's episodes."""

    rounds: int
    episodes: int
    terms: EpisodeTerms
    sampling: SamplingRule
    seed: int
    imitation: Mapping[str, object]
    """Settings of imitation, which the policies of the rounds depend on."""

    @staticmethod
    def of(settings: TrainSettings, terms: EpisodeTerms) -> TeachingRules:
        """Return the rules that the settings of a run ask for."""
        table, grpo = settings.episodes, settings.grpo
        return TeachingRules(
            table.teacher_rounds,
            table.teacher_episodes,
            terms,
            SamplingRule(1, grpo.temperature, grpo.max_new),
            settings.seed,
            {"model": settings.model, **settings.imitation.model_dump(mode="json")},
        )

    def due(self, share: float) -> int:
        """Return the number of rounds that belong before this share of imitation. The rounds divide it into equal parts."""
        return min(self.rounds, int(share * (self.rounds + 1) + 1e-9))


class Teacher:
    """Rounds of teaching of one run, whose episodes are kept in its folder and added to its examples.

    ``identity`` says what the episodes depend on, besides the policy. ``report`` gets the round, and finished and all
    episodes. All sides of the cluster must know advice.
    """

    def __init__(
        self,
        folder: Path,
        identity: Mapping[str, object],
        rules: TeachingRules,
        policy: TinyPolicy,
        workers: DataParallelWorkers,
        client: EpisodeClient,
        examples: OracleExamples,
        report: Callable[[int, int, int], None],
    ) -> None:
        self._folder = folder
        self._identity = identity
        self._rules = rules
        self._policy = policy
        self._workers = workers
        self._client = client
        self._examples = examples
        self._report = report
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
        rules = self._rules
        teaching = {"round": number, "rounds": rules.rounds, "episodes": rules.episodes, **rules.imitation}
        version = {**self._identity, "format": FORMAT, "teaching": teaching}
        known = kept_episodes(path, version)
        if known is None:
            known = self._play(number, self._planned(number, tasks))
            write_episodes(path, version, known)
        return known

    def _planned(self, number: int, tasks: Sequence[TrainingTask]) -> list[PlannedEpisode]:
        """Draw the tasks of a round, those of a scene side by side, and the answers after which the oracle takes over."""
        rules = self._rules
        rng = np.random.default_rng(np.random.SeedSequence((rules.seed, _STREAM, number)))
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
        found: dict[str, OracleEpisode] = {}
        each = _TOGETHER * self._workers.count
        for start in range(0, len(planned), each):
            self._report(number, start, len(planned))
            parts = range(start, min(start + each, len(planned)), _TOGETHER)
            batches = [
                EpisodeBatch(index, planned[at : at + _TOGETHER], _batch_seed(self._rules.seed, number, at))
                for index, at in enumerate(parts)
            ]
            played = play_batches(batches, self._workers, self._client, self._policy, self._rules.sampling)
            episodes = [
                (task, episode)
                for batch in played
                for task, episode in zip(batch.batch.planned, batch.episodes, strict=True)
            ]
            refuse_without_workers(
                [episode.outcome() for _, episode in episodes], f"round {number} of teaching"
            )
            found |= self._finish_all([(each.task, episode) for each, episode in episodes])
        self._report(number, len(planned), len(planned))
        return found

    def _finish_all(self, begun: Sequence[tuple[TrainingTask, ClusterEpisode]]) -> dict[str, OracleEpisode]:
        """Let the oracle finish episodes that the policy has begun. Return those that succeed, by task."""
        try:
            finished = result_of(self._client.run(self._finish_side_by_side(begun)))
        except ExceptionGroup as errors:
            first = first_of(errors)
            raise (TrainerError(str(first)) if isinstance(first, ClusterError) else first) from errors
        pairs = zip(begun, finished, strict=True)
        return {task.task.task_id: episode for (task, _), episode in pairs if episode is not None}

    async def _finish_side_by_side(
        self, begun: Sequence[tuple[TrainingTask, ClusterEpisode]]
    ) -> list[OracleEpisode | None]:
        async with asyncio.TaskGroup() as group:
            finishing = [group.create_task(self._finish(task, episode)) for task, episode in begun]
        return [each.result() for each in finishing]

    async def _finish(self, task: TrainingTask, episode: ClusterEpisode) -> OracleEpisode | None:
        if episode.is_over:
            return None
        by_policy = len(episode.answers)
        advice = await episode.advise()
        if advice is None or advice.problem:
            return None
        script = SearchingScript.of(advice.plan, task.situation, self._priors)
        script.take_over(episode.player.observer.situation, episode.player.steps)
        await finish(episode, script)
        return successful(episode, by_policy)


def _batch_seed(seed: int, number: int, at: int) -> int:
    """Seed of what the policy samples in a part of a round."""
    return int(np.random.SeedSequence((seed, _STREAM, number, at)).generate_state(1)[0])
