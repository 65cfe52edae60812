"""Tasks as searches: what a robot sees of them at the start, and whether a script finds the rest.

The searching script knows what to do and with which objects, but not where those are that the robot has not seen. A task is a
search if the first look lacks an object that its oracle plan handles: then no plan that is written at the start can name it.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from embomatrix.envs.player import EpisodePlayer
from embomatrix.envs.rules import EpisodeRules, Visibility
from embomatrix.envs.turns import LocalEpisodes
from embomatrix.factory.admission import oracle_plan
from embomatrix.factory.evaluate.scripts import by_bundle, held_out_of, in_processes, situations_of
from embomatrix.factory.metrics.figures import EvaluationFigures
from embomatrix.pages.figures import Better, Figure, wilson
from embomatrix.scripts.searching import PlacePriors, SearchingScript
from embomatrix.skills.prompt import Codec, Prompt, situation_of
from embomatrix.skills.syntax import MAX_STEPS, SkillCall
from embomatrix.world.dataset import Dataset, TaskRecord
from embomatrix.world.scene import Scene

CALLS_FACTOR: Final = 2
CALLS_MORE: Final = 12
"""Budget of a search: so many times the calls of an oracle that sees everything, and so many more."""
BLIND_GOAL: Final = 0.35
SEARCH_GOAL: Final = 0.95


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Search for the objects of one task."""

    hidden: int
    """Objects of the oracle plan that the first look lacks."""
    found: bool
    """The script reached the goal within the budget."""
    calls: int
    """Calls of the script, failed ones included."""

    @property
    def is_search(self) -> bool:
        return self.hidden > 0


SearchResults = Mapping[str, SearchResult]
"""Results by task id."""


def search_tasks(
    dataset: Dataset,
    records: Sequence[TaskRecord],
    training: Dataset,
    *,
    jobs: int,
    progress: Callable[[int], None] = lambda _done: None,
) -> SearchResults:
    """Play an episode of each task with the searching script, which learns from ``training`` where things usually are.

    Calls ``progress`` with the number of finished tasks. Raises DatasetError if a bundle can't be read or a process dies.
    """
    priors = PlacePriors(situations_of(training, training.train).values())
    found: dict[str, SearchResult] = {}
    work = partial(_search_bundle, dataset.folder, priors)
    for results in in_processes(work, by_bundle(records).values(), jobs=jobs, doing="searches"):
        found |= results
        progress(len(found))
    return found


def _search_bundle(
    folder: Path, priors: PlacePriors, records: Sequence[TaskRecord]
) -> dict[str, SearchResult]:
    bundle = Dataset(folder, ()).read_bundle(records[0].bundle_digest)
    with LocalEpisodes(lambda _digest: bundle) as episodes:
        return {
            record.task.task_id: asyncio.run(_search(episodes, bundle.scene, record, priors))
            for record in records
        }


async def _search(
    episodes: LocalEpisodes, scene: Scene, record: TaskRecord, priors: PlacePriors
) -> SearchResult:
    played = await play_search(episodes, scene, record, priors)
    return SearchResult(played.hidden, played.player.reward.tiers.success, played.player.reward.calls)


@dataclass(frozen=True, slots=True)
class PlayedSearch:
    """Episode of the searching script: its texts, the player at its end, and the objects that the first look lacked.

    ``told`` are the observations, the task first; ``calls`` answer them, None for the end.
    """

    prompt: Prompt
    told: tuple[str, ...]
    calls: tuple[SkillCall | None, ...]
    player: EpisodePlayer
    hidden: int


async def play_search(
    episodes: LocalEpisodes,
    scene: Scene,
    record: TaskRecord,
    priors: PlacePriors,
    visibility: Visibility = Visibility.SEEN,
    codec: Codec = Codec.LINES,
) -> PlayedSearch:
    """Play an episode of a task with the searching script, within the budget of a search."""
    situation, plan = situation_of(scene, record.task), oracle_plan(record)
    used = {index for call in plan for index in (call.object_index, call.source_index)}
    script = SearchingScript.of(plan, situation, priors)
    budget = min(MAX_STEPS, CALLS_FACTOR * len(plan) + CALLS_MORE)
    sight = visibility is Visibility.SEEN
    running = episodes.begin(record.bundle_digest, record.task.task_id, sight=sight)
    player = EpisodePlayer(running, situation, EpisodeRules(visibility, calls=budget), codec)
    prompt = await player.begin()
    hidden = used - player.observer.memory.keys() - {None}
    told, calls = [prompt.user], []
    while player.end is None:
        last = player.steps[-1] if player.steps else None
        call = script.next_call(player.observer.situation, last)
        calls.append(call)
        told.append((await player.act(() if call is None else (call,), done=call is None)).text)
    return PlayedSearch(prompt, tuple(told[: len(calls)]), tuple(calls), player, len(hidden))


def searches(records: Sequence[TaskRecord], results: SearchResults) -> list[TaskRecord]:
    """Return the tasks that are searches and that the script solves."""
    return [
        record
        for record in records
        if (result := results.get(record.task.task_id)) is not None and result.is_search and result.found
    ]


def evaluation_of(results: SearchResults, conditions: Mapping[str, str | int]) -> EvaluationFigures:
    """Return the success of the searching script, of all tasks and of the searches, and the share of tasks without a search.

    Only the success of the searches has a goal: a task that needs no search says nothing about searching.
    """
    held = list(results.values())
    hidden = [result for result in held if result.is_search]
    oracle = sum(result.found for result in held) / len(held)
    blind = 1 - len(hidden) / len(held)
    spread = wilson(oracle, len(held))
    found = [result.found for result in hidden]
    note = (
        f"`search_oracle_success` {oracle:.3f} [{spread.low:.3f}, {spread.high:.3f}], a Wilson interval over tasks. "
        f"`search_blind_success` is the share of tasks whose first look has all objects of the oracle plan. The script takes "
        f"{sum(result.calls for result in held) / len(held):.1f} calls on average."
    )
    figures: tuple[Figure, ...] = (
        Figure("search_blind_success", blind, "", Better.LOWER, len(held), BLIND_GOAL),
        Figure("search_oracle_success", oracle, "", Better.HIGHER, len(held)),
    )
    if found:
        share, name = sum(found) / len(found), "search_oracle_success of searches"
        figures = (*figures, Figure(name, share, "", Better.HIGHER, len(found), SEARCH_GOAL))
    return EvaluationFigures("search", conditions, figures, (note,))


def evaluate_search(
    folder: Path,
    training: Path | None,
    *,
    jobs: int,
    counter: Callable[[str, int], contextlib.AbstractContextManager[Callable[[int], None]]],
) -> EvaluationFigures:
    """Measure searches on the held-out split of a dataset. Raises EvaluationError for one without held-out tasks."""
    dataset, learned, conditions = held_out_of(folder, training)
    with counter("tasks", len(dataset.heldout)) as count:
        results = search_tasks(dataset, dataset.heldout, learned, jobs=jobs, progress=count)
    return evaluation_of(results, conditions)
