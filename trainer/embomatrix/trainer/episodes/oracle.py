"""Oracle episodes: what the searching oracle answers and is told, for imitation.

They are played once, on the cluster, and kept in the folder of the run.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import wait
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.scripts.searching import PlacePriors, SearchingScript
from embomatrix.skills.parse import DONE
from embomatrix.skills.prompt import Prompt, plan_in_names
from embomatrix.trainer.cluster.gateway import result_of
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.episodes.players import ClusterEpisode, EpisodePlayers, EpisodeStart
from embomatrix.trainer.policy.protocol import Example
from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    import numpy as np

    from embomatrix.trainer.data.tasks import TrainingTask
    from embomatrix.trainer.policy.tiny import TinyPolicy

ORACLE_EPISODES: Final = "oracle_episodes.json"
_REPORT_S: Final = 0.5
_SCENES: Final = 4
"""Scenes whose episodes are played at a time: with more, workers would load them again and again."""


@dataclass(frozen=True, slots=True)
class OracleEpisode:
    """Successful episode of a task: its opening, and the oracle's answers, each with what it was told then."""

    opening: str
    turns: tuple[tuple[str, str], ...]

    def example(self, policy: TinyPolicy) -> Example:
        """Return the episode's tokens. What the policy is told is not imitated."""
        tokens: list[int] = []
        told: list[bool] = []
        for answer, observation in self.turns:
            own = policy.encode_plan("" if answer == DONE else answer)
            after = policy.encode_told(observation)
            tokens += (*own, *after)
            told += [False] * len(own) + [True] * len(after)
        last = len(policy.encode_told(self.turns[-1][1]))
        end = len(tokens) - last
        return Example(policy.encode(Prompt("", self.opening)), tuple(tokens[:end]), tuple(told[:end]))


class OracleExamples:
    """Examples for imitation from oracle episodes, those of ``tasks`` that have one."""

    def __init__(
        self, episodes: Mapping[str, OracleEpisode], policy: TinyPolicy, tasks: Sequence[TrainingTask]
    ) -> None:
        self._examples = {name: episode.example(policy) for name, episode in episodes.items()}
        self.tasks = tuple(task for task in tasks if task.task.task_id in self._examples)

    def example(self, task: TrainingTask, rng: np.random.Generator) -> Example:
        """Return the task's episode. Episodes are not varied."""
        return self._examples[task.task.task_id]

    def plain_example(self, task: TrainingTask) -> Example:
        """Return the task's episode."""
        return self._examples[task.task.task_id]


def oracle_episodes(
    folder: Path,
    starts: Sequence[EpisodeStart],
    players: EpisodePlayers,
    report: Callable[[int, int], None],
) -> dict[str, OracleEpisode]:
    """Return the oracle's episodes by task: those in ``folder``, or new ones, which are kept there.

    Episodes without success, and those that were lost, are left out. ``report`` gets finished and all episodes. Raises
    TrainerError if the cluster fails or no episode succeeds.
    """
    path = folder / ORACLE_EPISODES
    if path.exists():
        return read_episodes(path)
    priors = PlacePriors([start.task.situation for start in starts])
    by_scene: dict[str, list[EpisodeStart]] = {}
    for start in starts:
        by_scene.setdefault(start.task.bundle_digest, []).append(start)
    found: dict[str, OracleEpisode] = {}
    finished = 0

    async def play_scene(own: Sequence[EpisodeStart], gate: asyncio.Semaphore) -> None:
        nonlocal finished
        async with gate:
            for played in asyncio.as_completed([_play(start, players, priors) for start in own]):
                task_id, episode = await played
                if episode is not None:
                    found[task_id] = episode
                finished += 1

    async def play_all() -> None:
        gate = asyncio.Semaphore(_SCENES)
        async with asyncio.TaskGroup() as group:
            for own in by_scene.values():
                group.create_task(play_scene(own, gate))

    playing = players.run(play_all())
    while not playing.done():
        report(finished, len(starts))
        wait([playing], timeout=_REPORT_S)
    result_of(playing)
    report(finished, len(starts))
    if not found:
        raise TrainerError(
            f"the oracle succeeds in none of {len(starts)} training tasks: check the dataset with `embomatrix eval "
            "--interactive --baseline oracle`"
        )
    in_order = {start.task.task.task_id: found.get(start.task.task.task_id) for start in starts}
    kept = {task_id: episode for task_id, episode in in_order.items() if episode is not None}
    rows = {task_id: [episode.opening, *episode.turns] for task_id, episode in kept.items()}
    write_whole(path, json.dumps(rows).encode("utf-8"))
    return kept


async def _play(
    start: EpisodeStart, players: EpisodePlayers, priors: PlacePriors
) -> tuple[str, OracleEpisode | None]:
    """Play the oracle's episode of a task, None without success."""
    task = start.task
    [episode] = await players.begin_all([start])
    script = SearchingScript.of(task.oracle, task.situation, priors)
    turns: list[tuple[str, str]] = []
    while not episode.is_over:
        answer = _answer(script, episode, start)
        turns.append((answer, await episode.answer(answer)))
    succeeded = episode.lost is None and episode.player.reward.tiers.success
    opening = episode.opening
    if not succeeded or opening is None:
        return task.task.task_id, None
    return task.task.task_id, OracleEpisode(opening.user, tuple(turns))


def _answer(script: SearchingScript, episode: ClusterEpisode, start: EpisodeStart) -> str:
    """Return the script's next call in the policy's words."""
    known = episode.player.observer.situation
    steps = episode.player.steps
    call = script.next_call(known, steps[-1] if steps else None)
    return DONE if call is None else plan_in_names((call,), known)


def read_episodes(path: Path) -> dict[str, OracleEpisode]:
    """Read kept episodes by task. Raises TrainerError if the file is damaged."""
    try:
        rows = parse_json(path.read_bytes())
        return {
            str(task_id): OracleEpisode(str(opening), tuple((str(a), str(b)) for a, b in turns))
            for task_id, (opening, *turns) in rows.items()
        }
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise TrainerError(
            f"{path} is damaged ({error}): remove it, and the episodes are played again"
        ) from error
