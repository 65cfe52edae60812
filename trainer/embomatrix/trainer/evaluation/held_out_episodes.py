"""Evaluation of a policy on held-out tasks in episodes, during training."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from embomatrix.skills.parse import DONE
from embomatrix.trainer.cluster.gateway import refuse_without_workers
from embomatrix.trainer.episodes.games import Game, PlayedGame, play_games
from embomatrix.trainer.episodes.players import ClusterEpisode, EpisodePlayers, EpisodeStart
from embomatrix.trainer.evaluation.episodes import episode_verdict
from embomatrix.trainer.evaluation.held_out import HeldOutAnswer, HeldOutEvaluation, task_score
from embomatrix.trainer.evaluation.verdicts import AnswerVerdict
from embomatrix.trainer.learning.learner import SamplingRule

if TYPE_CHECKING:
    from embomatrix.trainer.data.tasks import TrainingTask
    from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
    from embomatrix.trainer.policy.protocol import Policy

_AT_A_TIME = 4
"""Games between two reports of the progress."""


def evaluate_in_episodes(
    workers: DataParallelWorkers,
    policy: Policy,
    starts: Sequence[EpisodeStart],
    players: EpisodePlayers,
    rule: SamplingRule,
    *,
    chunk: int,
    seed: int,
    report: Callable[[int, int], None],
) -> HeldOutEvaluation:
    """Play ``rule.group`` episodes of each start. ``report`` gets finished and total tasks.

    A chunk of tasks is one game with its own seed. Raises TrainerError if the cluster failed, or no worker took any turn.
    """
    parts = [starts[at : at + chunk] for at in range(0, len(starts), chunk)]
    games = [Game(index, part, _seed_of(seed, index)) for index, part in enumerate(parts)]
    played: list[PlayedGame] = []
    done = 0
    report(0, len(starts))
    for at in range(0, len(games), _AT_A_TIME):
        batch = games[at : at + _AT_A_TIME]
        played += play_games(batch, workers, players, policy, rule)
        done += sum(len(game.starts) for game in batch)
        report(done, len(starts))
    outcomes = [each for game in played for of_task in game.outcomes() for each in of_task]
    refuse_without_workers(outcomes, f"the evaluation on {len(starts)} tasks")
    scores, answers = [], []
    for game in played:
        for number, (start, own) in enumerate(zip(game.game.starts, game.outcomes(), strict=True)):
            scores.append(task_score(start.task, own))
            episodes = game.episodes[number * rule.group : (number + 1) * rule.group]
            answers += [
                _answer(start.task, sample, outcome.text, episode)
                for sample, (outcome, episode) in enumerate(zip(own, episodes, strict=True))
            ]
    return HeldOutEvaluation(tuple(scores), tuple(answers))


def _seed_of(seed: int, chunk: int) -> int:
    return int(np.random.SeedSequence((seed, chunk)).generate_state(1)[0])


def _answer(task: TrainingTask, sample: int, text: str, episode: ClusterEpisode) -> HeldOutAnswer:
    plan = tuple(step.call for step in episode.player.steps if step.ok)
    answers = json.dumps([answer or DONE for answer in text.split("\n")])
    return HeldOutAnswer(answers, _verdict(task, sample, episode), plan)


def _verdict(task: TrainingTask, sample: int, episode: ClusterEpisode) -> AnswerVerdict:
    if episode.lost is not None:
        return AnswerVerdict(task.task.task_id, sample, success=False, partial=0.0, lost=True)
    return episode_verdict(task.task, sample, episode.player)
