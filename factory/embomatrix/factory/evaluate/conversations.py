"""Episodes of the searching script as conversations: a prompt, and answers and observations in turns, for supervised tuning."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from embomatrix.envs.rules import Visibility
from embomatrix.envs.turns import LocalEpisodes
from embomatrix.factory.evaluate.scripts import by_bundle, in_processes, situations_of
from embomatrix.factory.evaluate.search import PlayedSearch, play_search
from embomatrix.scripts.searching import PlacePriors
from embomatrix.skills.episode_text import FORMAT, answer_text
from embomatrix.skills.prompt import Codec
from embomatrix.world.dataset import Dataset, TaskRecord

Row = dict[str, Any]
_TEXTS: Final = ("task_id", "split", "scene_id", "category", "visibility", "codec")
_COUNTS: Final = ("format", "calls", "hidden")


@dataclass(frozen=True, slots=True)
class ConversationForm:
    """Form of conversations: what the robot shows, and how calls are written."""

    visibility: Visibility
    codec: Codec


def conversations(
    dataset: Dataset,
    records: Sequence[TaskRecord],
    form: ConversationForm,
    learned: Dataset,
    *,
    jobs: int,
    progress: Callable[[int], None] = lambda _done: None,
) -> list[Row]:
    """Return a row for each task that the script solves, in the order of the records.

    The script learns from the training tasks of ``learned`` where things usually are. ``messages`` of a row are a chat. Raises
    DatasetError if a bundle can't be read or a process dies.
    """
    priors = PlacePriors(situations_of(learned, learned.train).values())
    groups, work = list(by_bundle(records).values()), partial(_talk, dataset.folder, priors, form)
    rows: dict[str, Row] = {}
    done = 0
    for group, found in zip(
        groups, in_processes(work, groups, jobs=jobs, doing="plays episodes"), strict=True
    ):
        rows |= {row["task_id"]: row for row in found}
        done += len(group)
        progress(done)
    return [rows[record.task.task_id] for record in records if record.task.task_id in rows]


def _talk(
    folder: Path, priors: PlacePriors, form: ConversationForm, records: Sequence[TaskRecord]
) -> list[Row]:
    """Play the tasks of one bundle."""
    bundle = Dataset(folder, ()).read_bundle(records[0].bundle_digest)
    rows = []
    with LocalEpisodes(lambda _digest: bundle) as episodes:
        for record in records:
            played = asyncio.run(
                play_search(episodes, bundle.scene, record, priors, form.visibility, form.codec)
            )
            if played.player.reward.tiers.success:
                rows.append(_row(record, played, form))
    return rows


def _row(record: TaskRecord, played: PlayedSearch, form: ConversationForm) -> Row:
    messages = [{"role": "system", "content": played.prompt.system}]
    for text, call in zip(played.told, played.calls, strict=True):
        messages.append({"role": "user", "content": text})
        answer = answer_text(call, played.player.observer.situation, form.codec)
        messages.append({"role": "assistant", "content": answer})
    return {
        "task_id": record.task.task_id,
        "split": record.split,
        "scene_id": record.task.scene_id,
        "category": record.task.category.value,
        "visibility": form.visibility.value,
        "codec": form.codec.value,
        "format": FORMAT,
        "calls": played.player.reward.calls,
        "hidden": played.hidden,
        "messages": messages,
    }


def conversation_schema(arrow: Any) -> Any:
    """Return the schema of the rows for a module ``pyarrow``."""
    text = arrow.string()
    message = arrow.struct([("role", text), ("content", text)])
    kinds: Mapping[str, Any] = {
        **dict.fromkeys(_TEXTS, text),
        **dict.fromkeys(_COUNTS, arrow.int32()),
        "messages": arrow.list_(message),
    }
    return arrow.schema(list(kinds.items()))
