"""Evaluation of a policy on held-out tasks in episodes, during training."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from embomatrix.trainer.cluster.gateway import refuse_without_workers
from embomatrix.trainer.episodes.batches import EpisodeBatch, PlayedBatch, play_batches
from embomatrix.trainer.episodes.client import ClusterEpisode, EpisodeClient, PlannedEpisode
from embomatrix.trainer.evaluation.episodes import episode_verdict
from embomatrix.trainer.evaluation.held_out import HeldOutAnswer, HeldOutEvaluation, chunk_seed, task_score
from embomatrix.trainer.evaluation.verdicts import AnswerVerdict
from embomatrix.trainer.learning.learner import SamplingParams

if TYPE_CHECKING:
    from embomatrix.trainer.data.tasks import TrainingTask
    from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
    from embomatrix.trainer.policy.protocol import Policy

_EACH = 2
"""Batches that each learner plays between two reports of the progress."""


def evaluate_in_episodes(
    workers: DataParallelWorkers,
    policy: Policy,
    planned: Sequence[PlannedEpisode],
    client: EpisodeClient,
    rule: SamplingParams,
    *,
    chunk: int,
    seed: int,
    report: Callable[[int, int], None],
) -> HeldOutEvaluation:
    """Play ``rule.group`` episodes of each planned one. ``report`` gets finished and total tasks.

    ``chunk`` tasks are a batch with a seed of its own. Raises TrainerError if the cluster failed, or no worker took any turn.
    """
    parts = [planned[at : at + chunk] for at in range(0, len(planned), chunk)]
    batches = [EpisodeBatch(index, part, chunk_seed(seed, index)) for index, part in enumerate(parts)]
    size = _EACH * workers.count
    found = HeldOutEvaluation(())
    report(0, len(planned))
    for at in range(0, len(batches), size):
        played = play_batches(batches[at : at + size], workers, client, policy, rule)
        outcomes = [each for batch in played for of_task in batch.outcomes() for each in of_task]
        refuse_without_workers(outcomes, f"the evaluation on {len(planned)} tasks")
        for batch in played:
            found = _with_batch(found, batch)
        report(len(found.scores), len(planned))
    return found


def _with_batch(found: HeldOutEvaluation, played: PlayedBatch) -> HeldOutEvaluation:
    scores, answers = [*found.scores], [*found.answers]
    for number, (planned, outcomes) in enumerate(zip(played.batch.planned, played.outcomes(), strict=True)):
        scores.append(task_score(planned.task, outcomes))
        answers += [
            _answer(planned.task, sample, episode) for sample, episode in enumerate(played.of_task(number))
        ]
    return HeldOutEvaluation(tuple(scores), tuple(answers))


def _answer(task: TrainingTask, sample: int, episode: ClusterEpisode) -> HeldOutAnswer:
    plan = tuple(step.call for step in episode.player.steps if step.ok)
    return HeldOutAnswer(json.dumps(episode.answers), _verdict(task, sample, episode), plan)


def _verdict(task: TrainingTask, sample: int, episode: ClusterEpisode) -> AnswerVerdict:
    if episode.lost is not None:
        return AnswerVerdict(task.task.task_id, sample, success=False, partial=0.0, lost=True)
    return episode_verdict(task.task, sample, episode.player)
