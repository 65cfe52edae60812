"""Oracle episodes: what the searching oracle answers and is told, for imitation.

They are played once, on the cluster, and kept in the folder of the run.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from embomatrix.rpc.status import ClusterError
from embomatrix.scripts.searching import PlacePriors, SearchingScript
from embomatrix.skills.episode_text import FORMAT, answer_text
from embomatrix.skills.prompt import Prompt
from embomatrix.trainer.cluster.gateway import PlanOutcome, refuse_without_workers, result_of
from embomatrix.trainer.config.errors import TrainerError, first_of
from embomatrix.trainer.episodes.client import ClusterEpisode, EpisodeClient, PlannedEpisode
from embomatrix.trainer.policy.protocol import ImitationExample
from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    import numpy as np

    from embomatrix.trainer.data.tasks import TrainingTask
    from embomatrix.trainer.policy.protocol import Policy

T = TypeVar("T")
ORACLE_EPISODES: Final = "oracle_episodes.json"
_FILE_VERSION: Final[Mapping[str, object]] = {"format": FORMAT, "file": 3}
"""Versions of the texts of episodes, and of the files that keep them.

Files of version 1 did not say who gave an answer, and neither they nor those of version 2 had system texts.
"""
_REPORT_S: Final = 0.5
_CONCURRENT_SCENES: Final = 4
"""Scenes whose episodes are played at a time: with more, workers would load them again and again."""
ATTEMPTS: Final = 2
"""Times that an episode is played at most, if the infrastructure loses it."""


@dataclass(frozen=True, slots=True)
class OracleEpisode:
    """Successful episode of a task: its opening, and the answers, each with the observation that followed.

    The policy gave the first ``policy_answers`` answers, the oracle all others.
    """

    opening: Prompt
    turns: tuple[tuple[str, str], ...]
    policy_answers: int = 0

    def example(self, policy: Policy) -> ImitationExample:
        """Return the episode's tokens. Only the oracle's answers are imitated."""
        tokens: list[int] = []
        observed: list[bool] = []
        policy_tokens = 0
        for number, (answer, observation) in enumerate(self.turns, start=1):
            own = policy.encode_answer(answer)
            after = policy.encode_observation(observation) if number < len(self.turns) else ()
            tokens += (*own, *after)
            observed += [False] * len(own) + [True] * len(after)
            if number == self.policy_answers:
                policy_tokens = len(tokens)
        return ImitationExample(policy.encode(self.opening), tuple(tokens), tuple(observed), policy_tokens)


class OracleExamples:
    """Examples for imitation from oracle episodes: those of ``tasks`` that have one which fits the policy's context.

    A task may get further episodes, of which each is imitated as often as its first.
    """

    def __init__(
        self, episodes: Mapping[str, OracleEpisode], policy: Policy, tasks: Sequence[TrainingTask]
    ) -> None:
        """Raises TrainerError if no task has one."""
        self._policy = policy
        self._examples: dict[str, list[ImitationExample]] = {}
        self.add(episodes)
        self.tasks = tuple(task for task in tasks if task.task.task_id in self._examples)
        if not self.tasks:
            raise TrainerError(
                f"none of {len(tasks)} training tasks has an oracle episode of at most {policy.context} tokens to imitate: "
                "pass --imitate-steps 0"
            )

    def add(self, episodes: Mapping[str, OracleEpisode]) -> None:
        """Add an episode for each of some tasks, as far as it fits the policy's context."""
        for name, episode in episodes.items():
            example = episode.example(self._policy)
            context = self._policy.context
            if context is None or len(example.prompt) + len(example.plan) <= context:
                self._examples.setdefault(name, []).append(example)

    def example(self, task: TrainingTask, rng: np.random.Generator) -> ImitationExample:
        """Return one of the task's episodes. Episodes are not varied."""
        episodes = self._examples[task.task.task_id]
        return episodes[int(rng.integers(len(episodes)))] if len(episodes) > 1 else episodes[0]

    def plain_example(self, task: TrainingTask) -> ImitationExample:
        """Return the task's first episode, in which the oracle gave all answers."""
        return self._examples[task.task.task_id][0]


@dataclass(slots=True)
class _Progress:
    """Episodes so far: the successful ones by task, and the outcomes of all."""

    found: dict[str, OracleEpisode] = field(default_factory=dict)
    outcomes: list[PlanOutcome] = field(default_factory=list)


def oracle_episodes(
    folder: Path,
    identity: Mapping[str, object],
    planned: Sequence[PlannedEpisode],
    client: EpisodeClient,
    report: Callable[[int, int], None],
) -> dict[str, OracleEpisode]:
    """Return the oracle's successful episodes by task: those in ``folder``, or new ones, which are kept there.

    ``identity`` says what the episodes depend on; kept ones with another are played again. ``report`` gets finished and all
    episodes. Raises TrainerError if the cluster fails, no worker is there, or no episode succeeds.
    """
    path = folder / ORACLE_EPISODES
    known = read_episodes(path, identity)
    if known is not None:
        return known
    progress = _Progress()
    playing = client.run(_play_all(planned, client, progress))
    while not wait([playing], timeout=_REPORT_S).done:
        report(len(progress.outcomes), len(planned))
    result_of_all(playing)
    report(len(planned), len(planned))
    refuse_without_workers(progress.outcomes, "the oracle's episodes")
    if not progress.found:
        raise TrainerError(
            f"the oracle succeeds in none of {len(planned)} training tasks: check the dataset with `embomatrix eval "
            "--interactive --baseline oracle`"
        )
    in_order = [each.task.task.task_id for each in planned]
    kept = {task_id: progress.found[task_id] for task_id in in_order if task_id in progress.found}
    write_episodes(path, identity, kept)
    return kept


def result_of_all(future: Future[T]) -> T:
    """Return the result of episodes that are played side by side. Raises TrainerError for the first error of the cluster."""
    try:
        return result_of(future)
    except ExceptionGroup as errors:
        first = first_of(errors)
        raise (TrainerError(str(first)) if isinstance(first, ClusterError) else first) from errors


async def _play_all(planned: Sequence[PlannedEpisode], client: EpisodeClient, progress: _Progress) -> None:
    """Play all episodes, those of few scenes at a time. Ends early if no worker takes those of a scene."""
    priors = PlacePriors([each.task.situation for each in planned])
    by_scene: dict[str, list[PlannedEpisode]] = {}
    for each in planned:
        by_scene.setdefault(each.task.bundle_digest, []).append(each)
    gate = asyncio.Semaphore(_CONCURRENT_SCENES)

    async def play_scene(own: Sequence[PlannedEpisode]) -> None:
        async with gate:
            async with asyncio.TaskGroup() as group:
                playing = [group.create_task(_play(each, client, priors, progress)) for each in own]
            refuse_without_workers([each.result() for each in playing], "the oracle's episodes")

    async with asyncio.TaskGroup() as group:
        for own in by_scene.values():
            group.create_task(play_scene(own))


async def _play(
    planned: PlannedEpisode, client: EpisodeClient, priors: PlacePriors, progress: _Progress
) -> PlanOutcome:
    """Play the oracle's episode of a task, and keep it if it succeeds."""
    task = planned.task
    for _ in range(ATTEMPTS):
        [episode] = await client.begin_all([planned])
        await finish(episode, SearchingScript.of(task.oracle, task.situation, priors))
        if episode.lost is None:
            break
    outcome = episode.outcome()
    found = successful(episode)
    if found is not None:
        progress.found[task.task.task_id] = found
    progress.outcomes.append(outcome)
    return outcome


async def finish(episode: ClusterEpisode, script: SearchingScript) -> None:
    """Give the script's answers, in the policy's words, until the episode is over. Raises ClusterError."""
    steps = episode.player.steps
    begun = len(steps)
    while not episode.is_over:
        known = episode.player.observer.situation
        call = script.next_call(known, steps[-1] if len(steps) > begun else None)
        await episode.answer(answer_text(call, known, episode.player.codec))


def successful(episode: ClusterEpisode, policy_answers: int = 0) -> OracleEpisode | None:
    """Return an episode that is over as one to imitate; None if it failed, was lost, or has no answer of the oracle.

    The policy gave the first ``policy_answers`` answers.
    """
    if not episode.outcome().success or episode.opening is None or len(episode.answers) == policy_answers:
        return None
    return OracleEpisode(
        episode.opening, tuple((turn.answer, turn.observation) for turn in episode.turns), policy_answers
    )


def read_episodes(path: Path, version: Mapping[str, object]) -> dict[str, OracleEpisode] | None:
    """Read kept episodes by task; None if there are none of this version. Raises TrainerError if the file is damaged."""
    if not path.exists():
        return None
    try:
        value = parse_json(path.read_bytes())
        if value["version"] != {**version, **_FILE_VERSION}:
            return None
        systems = [str(text) for text in value["systems"]]
        return {
            str(task_id): OracleEpisode(
                Prompt(systems[system], str(opening)),
                tuple((str(answer), str(observation)) for answer, observation in turns),
                int(begun),
            )
            for task_id, (system, opening, begun, *turns) in value["episodes"].items()
        }
    except (OSError, ValueError, TypeError, AttributeError, LookupError) as error:
        raise TrainerError(
            f"{path} is damaged ({error}): remove it, and the episodes are played again"
        ) from error


def write_episodes(path: Path, version: Mapping[str, object], episodes: Mapping[str, OracleEpisode]) -> None:
    """Keep episodes by task, with what they depend on."""
    systems = [*dict.fromkeys(episode.opening.system for episode in episodes.values())]
    rows = {
        task_id: [
            systems.index(episode.opening.system),
            episode.opening.user,
            episode.policy_answers,
            *episode.turns,
        ]
        for task_id, episode in episodes.items()
    }
    content = {"version": {**version, **_FILE_VERSION}, "systems": systems, "episodes": rows}
    write_whole(path, json.dumps(content).encode("utf-8"))
