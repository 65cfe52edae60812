"""Plan texts in, rewards out: what every adapter to another trainer stands on.

A scorer is one run of a cluster, opened when the first text is to be scored. It serves threads and event loops alike, for its
client has an event loop of its own, and it can be pickled: what is open stays behind.
"""

from __future__ import annotations

import asyncio
import atexit
import functools
import itertools
import os
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from embomatrix.reward.settings import PAPER
from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.status import ClusterError
from embomatrix.rpc.trust import read_ca, read_token
from embomatrix.rpc.wire.values import GroupPolicy, RunTerms
from embomatrix.skills.prompt import Codec
from embomatrix.trainer.cluster.gateway import Gateway
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.data.tasks import TaskSet, load_tasks

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from concurrent.futures import Future
    from contextlib import AbstractAsyncContextManager

    from embomatrix.reward.settings import RewardSettings
    from embomatrix.trainer.cluster.gateway import Cluster, PlanOutcome
    from embomatrix.trainer.data.tasks import TrainingTask

RUN_NAME: Final = "adapter"
GATHER_S: Final = 0.005
"""How long a single text waits for others of its task: trainers that score one by one would send batches of one."""

ATTEMPTS: Final = 3
"""At a plan that the infrastructure lost, for trainers that must have a number. The manager tries each three times itself."""


@dataclass(frozen=True, slots=True)
class Opened:
    """What a scorer holds while its run is open."""

    gateway: Gateway
    tasks: Mapping[str, TrainingTask]


class PlanScorer:
    """Scores plans for the tasks of one dataset.

    ``load`` reads the tasks and ``open_cluster`` connects; both must be picklable where the scorer is pickled. Rollouts of a
    task share a seed derived from ``seed``, as in our own trainer.
    """

    def __init__(
        self,
        load: Callable[[], TaskSet],
        open_cluster: Callable[[], AbstractAsyncContextManager[Cluster]],
        *,
        seed: int = 0,
        reward: RewardSettings = PAPER,
    ) -> None:
        self._load = load
        self._open_cluster = open_cluster
        self._seed = seed
        # Whoever asks decides what a group with a lost rollout is worth: the others go on.
        self._terms = RunTerms(GroupPolicy.PARTIAL, reward=reward)
        self._begin()

    def _begin(self) -> None:
        self._lock = threading.Lock()
        self._opened: Opened | None = None
        self._numbers = itertools.count()
        self._gathering: dict[str, _Gathering] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("_load", "_open_cluster", "_seed", "_terms")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> Opened:
        """Read the tasks and open the run, once. Raises TrainerError where either can't be."""
        with self._lock:
            if self._opened is None:
                tasks = self._load()
                gateway = Gateway(
                    self._open_cluster,
                    tasks.bundle_bytes,
                    run_name=RUN_NAME,
                    run_seed=self._seed,
                    terms=self._terms,
                )
                try:
                    gateway.__enter__()
                except ClusterError as error:
                    raise TrainerError(str(error)) from error
                by_id = {task.task.task_id: task for task in (*tasks.train, *tasks.heldout)}
                self._opened = Opened(gateway, by_id)
                # Scripts of other trainers end without a word.
                atexit.register(self.close)
            return self._opened

    def close(self) -> None:
        """End the run at the manager; the next score opens another."""
        with self._lock:
            opened, self._opened = self._opened, None
        if opened is not None:
            atexit.unregister(self.close)
            opened.gateway.__exit__()

    def submit(self, task_ids: Sequence[str], texts: Sequence[str]) -> list[ScoredTexts]:
        """Start the rollouts of these texts, one batch for each task. Raises TrainerError for an unknown task."""
        opened = self.open()
        members: dict[str, list[int]] = {}
        for index, task_id in enumerate(task_ids):
            members.setdefault(task_id, []).append(index)
        tasks = {task_id: self._task(opened, task_id) for task_id in members}
        shares = []
        for task_id, indices in members.items():
            number = next(self._numbers)
            chosen = [texts[index] for index in indices]
            task = tasks[task_id]
            future = opened.gateway.submit(
                f"score-{number}", number, task, task.situation, chosen, Codec.JSON
            )
            shares.append(ScoredTexts(tuple(indices), future))
        return shares

    async def score(self, task_ids: Sequence[str], texts: Sequence[str]) -> list[PlanOutcome]:
        """What became of each text, in their order. From any event loop. Raises TrainerError."""
        shares = await asyncio.to_thread(self.submit, task_ids, texts)
        outcomes: dict[int, PlanOutcome] = {}
        for share in shares:
            try:
                found = await asyncio.wrap_future(share.future)
            except ClusterError as error:
                raise TrainerError(str(error)) from error
            outcomes |= zip(share.indices, found, strict=True)
        return [outcomes[index] for index in range(len(texts))]

    async def score_one(self, task_id: str, text: str) -> PlanOutcome:
        """The same for one text, together with others of its task that come within ``GATHER_S``. From one event loop."""
        group = self._gathering.get(task_id)
        if group is None:
            group = self._gathering[task_id] = _Gathering([], asyncio.create_task(self._gathered(task_id)))
        index = len(group.texts)
        group.texts.append(text)
        return (await asyncio.shield(group.work))[index]

    async def _gathered(self, task_id: str) -> list[PlanOutcome]:
        await asyncio.sleep(GATHER_S)
        texts = self._gathering.pop(task_id).texts
        return await self.score([task_id] * len(texts), texts)

    def announce(self, steps: Sequence[Sequence[str]], group: int) -> None:
        """Tell the cluster which tasks this step and those after it need, ``group`` plans of each."""
        opened = self.open()
        known = [[self._task(opened, task_id) for task_id in step] for step in steps]
        opened.gateway.announce(dict(enumerate(known)), group)

    @staticmethod
    def _task(opened: Opened, task_id: str) -> TrainingTask:
        if task_id not in opened.tasks:
            raise TrainerError(
                f"the dataset has no task {task_id!r} among its {len(opened.tasks)}: score with the dataset that the prompts "
                "were written from"
            )
        return opened.tasks[task_id]


@dataclass(frozen=True, slots=True)
class ScoredTexts:
    """One task's texts: where they stood among all, and what becomes of them."""

    indices: tuple[int, ...]
    future: Future[tuple[PlanOutcome, ...]]


@dataclass(frozen=True, slots=True)
class _Gathering:
    """Texts of one task that wait to be sent together."""

    texts: list[str]
    work: asyncio.Task[list[PlanOutcome]]


def given_up(task_id: str) -> TrainerError:
    """What to raise after the last of the attempts."""
    return TrainerError(
        f"the cluster lost a plan of the task {task_id!r} {ATTEMPTS} times: look at its workers with `embomatrix status`"
    )


def scorer_for(
    dataset: str | Path,
    manager: str = "",
    token: str = "",
    ca: str | Path = "",
    *,
    seed: int = 0,
    reward: RewardSettings = PAPER,
) -> PlanScorer:
    """A scorer on the cluster at ``manager`` (HOST:PORT). What is not told comes from ``EMBOMATRIX_MANAGER``,
    ``EMBOMATRIX_TOKEN`` (or @FILE) and ``EMBOMATRIX_CA``, as for our commands. Raises TrainerError."""
    address = manager or os.environ.get("EMBOMATRIX_MANAGER", "") or DEFAULT_ADDRESS
    authority = str(ca) or os.environ.get("EMBOMATRIX_CA", "")
    try:
        secret = read_token(token or os.environ.get("EMBOMATRIX_TOKEN", ""))
        trusted = read_ca(Path(authority) if authority else None)
    except ClusterError as error:
        raise TrainerError(str(error)) from error
    connect = functools.partial(ClusterClient, address, secret, ca=trusted)
    return PlanScorer(functools.partial(load_tasks, Path(dataset)), connect, seed=seed, reward=reward)
