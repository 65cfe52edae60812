"""Scorer for plan texts: the common base of all adapters to other trainers.

A scorer is one run of a cluster, opened on the first text. It serves threads and event loops, as its client has a
dedicated event loop. Pickling a scorer drops its connection.
"""

from __future__ import annotations

import asyncio
import atexit
import dataclasses
import functools
import itertools
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.reward.settings import PAPER, RewardSettings, RewardSettingsError
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.cluster_address import cluster_named
from embomatrix.rpc.status import ClusterError
from embomatrix.rpc.wire.values import GroupPolicy, RunTerms
from embomatrix.skills.prompt import Codec
from embomatrix.skills.seeds import training_seed
from embomatrix.trainer.cluster.gateway import Gateway, PlanGroup, PlanOutcome
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.data.tasks import TaskSet, TrainingTask, load_tasks

RUN_NAME: Final = "adapter"
REWARD_VARIABLE: Final = "EMBOMATRIX_REWARD"
"""Environment variable with coefficients of the reward, as ``reward_named`` reads them."""
GROUPING_S: Final = 0.005
"""Wait of a single text for others of its task: trainers that score one by one would otherwise send batches of one."""

ATTEMPTS: Final = 3
"""Attempts at a lost plan, for trainers that need a number. The manager retries each attempt three times itself."""


@dataclass(frozen=True, slots=True)
class OpenRun:
    """Gateway and tasks of an open scorer."""

    gateway: Gateway
    tasks: Mapping[str, TrainingTask]


class PlanScorer:
    """Scores plans for the tasks of one dataset.

    ``load`` reads the tasks and ``open_cluster`` connects; both must be picklable if the scorer is. Rollouts of a task share a
    seed derived from ``seed``, as in our own trainer.
    """

    def __init__(
        self,
        load: Callable[[], TaskSet],
        open_cluster: Callable[[], AbstractAsyncContextManager[ClusterClient]],
        *,
        seed: int = 0,
        reward: RewardSettings = PAPER,
    ) -> None:
        self._load = load
        self._open_cluster = open_cluster
        self._seed = seed
        # The caller decides about groups with a lost rollout, so the others must finish.
        self._terms = RunTerms(GroupPolicy.PARTIAL, reward=reward)
        self._reset()

    def _reset(self) -> None:
        self._lock = threading.Lock()
        self._opened: OpenRun | None = None
        self._numbers = itertools.count()
        self._pending: dict[tuple[str, int], _PendingGroup] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("_load", "_open_cluster", "_seed", "_terms")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._reset()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> OpenRun:
        """Read the tasks and open the run, once. Raises TrainerError."""
        with self._lock:
            if self._opened is None:
                tasks = self._load()
                gateway = Gateway(
                    self._open_cluster,
                    tasks.bundle_bytes,
                    run_name=RUN_NAME,
                    terms=self._terms,
                )
                try:
                    gateway.__enter__()
                except ClusterError as error:
                    raise TrainerError(str(error)) from error
                by_id = {task.task.task_id: task for task in (*tasks.train, *tasks.heldout)}
                self._opened = OpenRun(gateway, by_id)
                # Scripts of other trainers end without closing the scorer.
                atexit.register(self.close)
            return self._opened

    def close(self) -> None:
        """End the run at the manager. The next score opens another."""
        with self._lock:
            opened, self._opened = self._opened, None
        if opened is not None:
            atexit.unregister(self.close)
            opened.gateway.__exit__()

    def submit(
        self, task_ids: Sequence[str], texts: Sequence[str], seed: int | None = None
    ) -> list[tuple[list[int], Future[tuple[PlanOutcome, ...]]]]:
        """Start the rollouts of these texts as one batch with a group for each task. Raises TrainerError for an unknown task.

        Return the indices of each group's texts, and the future of their outcomes. ``seed`` is that of the rollouts, by default
        each task's.
        """
        opened = self.open()
        members: dict[str, list[int]] = {}
        for index, task_id in enumerate(task_ids):
            members.setdefault(task_id, []).append(index)
        tasks = {task_id: self._task(opened, task_id) for task_id in members}
        groups = [
            PlanGroup(
                task,
                task.situation,
                [texts[index] for index in members[task_id]],
                self._seed_of(task_id, seed),
            )
            for task_id, task in tasks.items()
        ]
        number = next(self._numbers)
        futures = opened.gateway.submit(f"score-{number}", number, groups, Codec.JSON)
        return list(zip(members.values(), futures, strict=True))

    async def score(
        self, task_ids: Sequence[str], texts: Sequence[str], seed: int | None = None
    ) -> list[PlanOutcome]:
        """Score texts and keep their order. Can be awaited on any event loop. Raises TrainerError."""
        pending = await asyncio.to_thread(self.submit, task_ids, texts, seed)
        outcomes: dict[int, PlanOutcome] = {}
        for indices, future in pending:
            try:
                found = await asyncio.wrap_future(future)
            except ClusterError as error:
                raise TrainerError(str(error)) from error
            outcomes |= zip(indices, found, strict=True)
        return [outcomes[index] for index in range(len(texts))]

    async def score_one(self, task_id: str, text: str, seed: int | None = None) -> PlanOutcome:
        """Score one text, grouped with others of its task and seed within ``GROUPING_S``. Use one event loop at a time."""
        key = task_id, self._seed_of(task_id, seed)
        group = self._pending.get(key)
        if group is None:
            group = self._pending[key] = _PendingGroup([], asyncio.create_task(self._score_pending(*key)))
        index = len(group.texts)
        group.texts.append(text)
        return (await asyncio.shield(group.work))[index]

    async def reward_of(self, task_id: str, text: str, seed: int | None = None) -> RewardBreakdown:
        """Return the reward of one text, for trainers that need a number. Texts of a task are grouped as in ``score_one``.

        A lost rollout is repeated; after ``ATTEMPTS``, a TrainerError is raised.
        """
        for _attempt in range(ATTEMPTS):
            outcome = await self.score_one(task_id, text, seed)
            if outcome.reward is not None:
                return outcome.reward
        raise TrainerError(
            f"the cluster lost a plan of the task {task_id!r} {ATTEMPTS} times: check its workers with `embomatrix status`"
        )

    async def _score_pending(self, task_id: str, seed: int) -> list[PlanOutcome]:
        try:
            await asyncio.sleep(GROUPING_S)
        finally:
            texts = self._pending.pop((task_id, seed)).texts
        return await self.score([task_id] * len(texts), texts, seed)

    def _seed_of(self, task_id: str, seed: int | None) -> int:
        return training_seed(self._seed, task_id) if seed is None else seed

    def announce(self, steps: Sequence[Sequence[str]], group: int) -> None:
        """Announce the tasks of this step and the next ones to the cluster, with ``group`` plans each."""
        opened = self.open()
        known = [[self._task(opened, task_id) for task_id in step] for step in steps]
        opened.gateway.announce(dict(enumerate(known)), group)

    @staticmethod
    def _task(opened: OpenRun, task_id: str) -> TrainingTask:
        if task_id not in opened.tasks:
            raise TrainerError(
                f"the dataset has no task {task_id!r} among its {len(opened.tasks)}: score with the dataset that the prompts "
                "were written from"
            )
        return opened.tasks[task_id]


@dataclass(frozen=True, slots=True)
class _PendingGroup:
    """Texts of one task that wait to be sent together."""

    texts: list[str]
    work: asyncio.Task[list[PlanOutcome]]


def reward_named(given: str = "") -> RewardSettings:
    """Return the coefficients in a text such as ``goal=10,format=0``, by default that in ``EMBOMATRIX_REWARD``.

    Those that it leaves out have the paper's values. Raises TrainerError.
    """
    text = given or os.environ.get(REWARD_VARIABLE, "")
    names = [field.name for field in dataclasses.fields(RewardSettings)]
    values: dict[str, float] = {}
    for part in filter(None, map(str.strip, text.split(","))):
        name, _, number = map(str.strip, part.partition("="))
        try:
            values[names[names.index(name)]] = float(number)
        except ValueError:
            raise TrainerError(
                f"the reward's coefficients are {text!r}, found {part!r}: expected NAME=NUMBER with one of the names "
                f"{', '.join(names)}"
            ) from None
    try:
        return RewardSettings(**values)
    except RewardSettingsError as error:
        raise TrainerError(f"the reward's coefficients are {text!r}: {error}") from error


def scorer_for(
    dataset: str | Path,
    manager: str = "",
    token: str = "",
    ca: str | Path = "",
    *,
    seed: int = 0,
    reward: RewardSettings | None = None,
) -> PlanScorer:
    """Create a scorer for a cluster, given as in ``cluster_named``. Raises TrainerError.

    ``reward`` has the coefficients of the reward, by default those of ``reward_named``.
    """
    coefficients = reward_named() if reward is None else reward
    try:
        at = cluster_named(manager, token, ca)
    except ClusterError as error:
        raise TrainerError(str(error)) from error
    connect = functools.partial(ClusterClient, at.manager, at.token, ca=at.ca)
    return PlanScorer(functools.partial(load_tasks, Path(dataset)), connect, seed=seed, reward=coefficients)


shared_scorer = functools.cache(scorer_for)
"""The process's scorer for a dataset and a cluster, created by the first call."""
