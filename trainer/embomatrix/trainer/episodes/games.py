"""Episodes of tasks, played by the learners on the cluster: all episodes of a game advance together, turn by turn.

A learner plays several games at a time. While the cluster executes the answers of one, it samples those of the next.
"""

from __future__ import annotations

import functools
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from embomatrix.skills.parse import DONE
from embomatrix.skills.prompt import Prompt
from embomatrix.trainer.cluster.gateway import result_of
from embomatrix.trainer.episodes.players import ClusterEpisode, EpisodePlayers, EpisodeStart

if TYPE_CHECKING:
    from embomatrix.trainer.cluster.gateway import PlanOutcome
    from embomatrix.trainer.learning.data_parallel import DataParallelWorkers, RemoteLearner
    from embomatrix.trainer.learning.learner import Learner, SamplingRule
    from embomatrix.trainer.policy.protocol import Policy, Samples, Tokens

T = TypeVar("T")
_NOTHING = Prompt("", "task")
"""Prompt of a task whose episodes were all lost before they began."""


@dataclass(frozen=True, slots=True)
class Game:
    """Tasks whose episodes are played together. ``index`` decides which learner plays, ``seed`` what it samples."""

    index: int
    starts: Sequence[EpisodeStart]
    seed: int


@dataclass(frozen=True, slots=True, eq=False)
class PlayedGame:
    """Result of a game: the prompt of each task, and samples and episodes in the order of the tasks, equally many for each."""

    game: Game
    prompts: tuple[Tokens, ...]
    samples: Samples
    episodes: tuple[ClusterEpisode, ...]
    waited_s: float
    """Seconds in which the learner waited for the cluster."""

    def outcomes(self) -> list[tuple[PlanOutcome, ...]]:
        """Return the outcomes of each task's episodes."""
        group = len(self.episodes) // len(self.prompts)
        found = [
            episode.outcome(text) for episode, text in zip(self.episodes, self.samples.texts, strict=True)
        ]
        return [tuple(found[at : at + group]) for at in range(0, len(found), group)]


def play_games(
    games: Sequence[Game],
    workers: DataParallelWorkers,
    players: EpisodePlayers,
    policy: Policy,
    rule: SamplingRule,
) -> list[PlayedGame]:
    """Play games on the learners that own them. Raises TrainerError if the cluster or a process failed.

    A game's samples depend on its seed and the weights alone, not on the process or on which worker was faster.
    """
    by_learner: dict[RemoteLearner | None, list[Game]] = {}
    for game in games:
        by_learner.setdefault(workers.remote(game.index), []).append(game)

    def play(own: Sequence[Game], learner: Learner | RemoteLearner) -> list[PlayedGame]:
        return _play(own, learner, players, policy, rule)

    jobs = [(own[0].index, functools.partial(play, own)) for own in by_learner.values()]
    played = {each.game.index: each for part in workers.map(jobs) for each in part}
    return [played[game.index] for game in games]


def _play(
    games: Sequence[Game],
    learner: Learner | RemoteLearner,
    players: EpisodePlayers,
    policy: Policy,
    rule: SamplingRule,
) -> list[PlayedGame]:
    tables = [_Table(game, learner, players, policy, rule) for game in games]
    waiting = deque(tables)
    while waiting:
        table = waiting.popleft()
        if table.take_turn():
            waiting.append(table)
    return [table.result() for table in tables]


class _Table:
    """One game while it is played."""

    def __init__(
        self,
        game: Game,
        learner: Learner | RemoteLearner,
        players: EpisodePlayers,
        policy: Policy,
        rule: SamplingRule,
    ) -> None:
        self._game, self._rule = game, rule
        self._learner, self._players, self._policy = learner, players, policy
        starts = [start for start in game.starts for _ in range(rule.group)]
        self._beginning: Future[list[ClusterEpisode]] | None = players.begin(starts)
        self._episodes: list[ClusterEpisode] = []
        self._prompts: tuple[Tokens, ...] = ()
        self._answered: list[int] = []
        self._told: Future[list[str]] | None = None
        self._waited_s = 0.0

    def take_turn(self) -> bool:
        """Wait for what happened, and answer. Return False if every episode is over."""
        if self._beginning is not None:
            self._begin(self._beginning)
            rows, told = [*range(len(self._episodes))], None
        else:
            assert self._told is not None
            rows, told = self._answered, self._wait(self._told)
        going = [place for place, row in enumerate(rows) if not self._episodes[row].is_over]
        playing = [rows[place] for place in going]
        if not playing:
            return False
        texts = [] if told is None else [told[place] for place in going]
        self._answer(playing, self._learner.reply(self._game.index, playing, texts))
        return bool(self._answered)

    def _begin(self, beginning: Future[list[ClusterEpisode]]) -> None:
        self._episodes, self._beginning = self._wait(beginning), None
        group = self._rule.group
        openings = [
            next((each.opening for each in self._episodes[at : at + group] if each.opening), _NOTHING)
            for at in range(0, len(self._episodes), group)
        ]
        self._prompts = tuple(self._policy.encode(opening) for opening in openings)
        self._learner.converse(self._game.index, self._prompts, self._game.seed, self._rule)

    def _answer(self, rows: Sequence[int], answers: Sequence[str | None]) -> None:
        for row, answer in zip(rows, answers, strict=True):
            if answer is None:
                self._episodes[row].stop()
        given = [(row, answer) for row, answer in zip(rows, answers, strict=True) if answer is not None]
        self._answered = [row for row, _ in given]
        episodes = [self._episodes[row] for row in self._answered]
        self._told = self._players.answer(episodes, [answer or DONE for _, answer in given])

    def _wait(self, future: Future[T]) -> T:
        began_s = time.monotonic()
        try:
            return result_of(future)
        finally:
            self._waited_s += time.monotonic() - began_s

    def result(self) -> PlayedGame:
        samples = self._learner.end_conversation(self._game.index)
        return PlayedGame(self._game, self._prompts, samples, tuple(self._episodes), self._waited_s)
