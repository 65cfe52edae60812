"""Batches of episodes, played by the learners on the cluster: all episodes of a batch advance together, call by call.

A learner plays several batches at a time. While the cluster executes the calls of one, it samples those of the next.
"""

from __future__ import annotations

import concurrent.futures
import functools
import itertools
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from embomatrix.skills.prompt import Prompt
from embomatrix.trainer.cluster.gateway import result_of
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.episodes.client import ClusterEpisode, EpisodeClient, PlannedEpisode
from embomatrix.trainer.learning.data_parallel import RemoteLearner

if TYPE_CHECKING:
    from embomatrix.trainer.cluster.gateway import PlanOutcome
    from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
    from embomatrix.trainer.learning.learner import Learner, SamplingParams
    from embomatrix.trainer.policy.protocol import Policy, Samples, Tokens

T = TypeVar("T")
_EMPTY_PROMPT = Prompt("", "task")
"""Prompt of a task whose episodes were all lost before they began."""
_CONCURRENT_BATCHES = 2
"""Batches that a learner plays at a time: one is sampled while the cluster executes the other's calls. Each has a cache."""
_POLL_S = 0.5
"""Seconds between two checks whether the trainer has ended, while its process waits for the cluster."""


@dataclass(frozen=True, slots=True)
class EpisodeBatch:
    """Tasks whose episodes are played together. ``index`` decides which learner plays, ``seed`` what it samples."""

    index: int
    planned: Sequence[PlannedEpisode]
    """One for each task; ``SamplingParams.group`` episodes are played of each."""
    seed: int


@dataclass(frozen=True, slots=True, eq=False)
class PlayedBatch:
    """Played batch: the prompt of each task, and samples and episodes in the order of the tasks, equally many for each."""

    batch: EpisodeBatch
    prompts: tuple[Tokens, ...]
    samples: Samples
    episodes: tuple[ClusterEpisode, ...]
    waited_s: float
    """Seconds in which the learner waited for the cluster."""

    def of_task(self, number: int) -> tuple[ClusterEpisode, ...]:
        """Return the episodes of a task."""
        group = len(self.episodes) // len(self.prompts)
        return self.episodes[number * group : (number + 1) * group]

    def outcomes(self) -> list[tuple[PlanOutcome, ...]]:
        """Return the outcomes of each task's episodes."""
        return [
            tuple(episode.outcome() for episode in self.of_task(number))
            for number in range(len(self.prompts))
        ]


def play_batches(
    batches: Sequence[EpisodeBatch],
    workers: DataParallelWorkers,
    client: EpisodeClient,
    policy: Policy,
    rule: SamplingParams,
) -> list[PlayedBatch]:
    """Play batches on the learners that own them. Raises TrainerError if the cluster or a process failed.

    Samples of a batch follow from its seed, the weights, and what its episodes are told: not from the process that plays it,
    nor from which worker was faster.
    """
    by_learner: dict[RemoteLearner | None, list[EpisodeBatch]] = {}
    for batch in batches:
        by_learner.setdefault(workers.remote(batch.index), []).append(batch)

    def play(own: Sequence[EpisodeBatch], learner: Learner | RemoteLearner) -> list[PlayedBatch]:
        coming = (_RunningBatch(batch, learner, client, policy, rule) for batch in own)
        waiting = deque(itertools.islice(coming, _CONCURRENT_BATCHES))
        done = []
        while waiting:
            first = waiting.popleft()
            if first.advance():
                waiting.append(first)
            else:
                done.append(first.result())
                waiting.extend(itertools.islice(coming, 1))
        return done

    jobs = [(own[0].index, functools.partial(play, own)) for own in by_learner.values()]
    played = {each.batch.index: each for part in workers.map(jobs) for each in part}
    return [played[batch.index] for batch in batches]


class _RunningBatch:
    """One batch while a learner plays it."""

    def __init__(
        self,
        batch: EpisodeBatch,
        learner: Learner | RemoteLearner,
        client: EpisodeClient,
        policy: Policy,
        rule: SamplingParams,
    ) -> None:
        self._batch, self._rule = batch, rule
        self._learner, self._client, self._policy = learner, client, policy
        planned = [each for each in batch.planned for _ in range(rule.group)]
        self._beginning: Future[list[ClusterEpisode]] | None = client.begin(planned)
        self._episodes: list[ClusterEpisode] = []
        self._prompts: tuple[Tokens, ...] = ()
        self._answered: list[int] = []
        self._observations: Future[list[str]] | None = None
        self._waited_s = 0.0

    def advance(self) -> bool:
        """Wait for what happened, and answer. Return False once the policy answers in no episode any more."""
        if self._beginning is not None:
            self._begin(self._beginning)
            rows, observations = [*range(len(self._episodes))], None
        else:
            assert self._observations is not None
            rows, observations = self._answered, self._wait(self._observations)
        going = [place for place, row in enumerate(rows) if self._episodes[row].is_for_policy]
        playing = [rows[place] for place in going]
        if not playing:
            return False
        texts = [] if observations is None else [observations[place] for place in going]
        self._answer(playing, self._learner.answer_episodes(self._batch.index, playing, texts))
        return bool(self._answered)

    def _begin(self, beginning: Future[list[ClusterEpisode]]) -> None:
        self._episodes, self._beginning = self._wait(beginning), None
        group = self._rule.group
        openings = [
            next((each.opening for each in self._episodes[at : at + group] if each.opening), _EMPTY_PROMPT)
            for at in range(0, len(self._episodes), group)
        ]
        self._prompts = tuple(self._policy.encode(opening) for opening in openings)
        self._learner.begin_episodes(self._batch.index, self._prompts, self._batch.seed, self._rule)

    def _answer(self, rows: Sequence[int], answers: Sequence[str | None]) -> None:
        for row, answer in zip(rows, answers, strict=True):
            if answer is None:
                self._episodes[row].stop()
            elif self._episodes[row].has_handover and self._episodes[row].player.says_done(answer):
                self._episodes[row].hand_over()
        given = [
            (row, answer)
            for row, answer in zip(rows, answers, strict=True)
            if answer is not None and self._episodes[row].is_for_policy
        ]
        self._answered = [row for row, _ in given]
        episodes = [self._episodes[row] for row in self._answered]
        self._observations = self._client.answer(episodes, [answer for _, answer in given])

    def _wait(self, future: Future[T]) -> T:
        """Wait for the cluster. The thread of a remote learner gives up once that is closed, or Ctrl-C would wait too."""
        began_s = time.monotonic()
        try:
            while not concurrent.futures.wait([future], timeout=_POLL_S).done:
                if isinstance(self._learner, RemoteLearner) and self._learner.closed:
                    raise TrainerError("the trainer has ended")
            return result_of(future)
        finally:
            self._waited_s += time.monotonic() - began_s

    def result(self) -> PlayedBatch:
        """Return the episodes, all of which are over or handed over."""
        samples = self._learner.end_episodes(self._batch.index)
        return PlayedBatch(self._batch, self._prompts, samples, tuple(self._episodes), self._waited_s)
