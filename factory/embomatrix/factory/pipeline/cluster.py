"""A cluster's slots as a second judge: the oracle's plans are executed there as well before their tasks are kept."""

from __future__ import annotations

import asyncio
import dataclasses
from typing import TYPE_CHECKING, Final, Self

from embomatrix.factory.admission import SEED, RefusalReason
from embomatrix.factory.pipeline.store import Rejection
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.values import Batch, Completed, Rollout, RolloutResult
from embomatrix.skills.parse import plan_from_json
from embomatrix.world.dataset import DatasetError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.factory.pipeline.variants import VariantYield
    from embomatrix.world.dataset import TaskRecord

RUN: Final = "factory"
"""Name of the run on the cluster's pages."""


class ClusterCheck:
    """Context manager over one event loop and one run of the cluster. ``token`` and ``ca`` (PEM) as clients have them."""

    def __init__(self, address: str, token: str = "", ca: bytes = b"") -> None:
        self._client = ClusterClient(address, token, ca=ca)
        self._runner = asyncio.Runner()
        self._run_id = ""

    def __enter__(self) -> Self:
        """Open the run. Raises ClusterError."""
        try:
            self._run_id = self._runner.run(self._open())
        except BaseException:
            self._runner.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._runner.run(self._close())
        finally:
            self._runner.close()

    def check(self, made: VariantYield) -> VariantYield:
        """What the cluster's slots admit of a variant. Raises ClusterError, DatasetError where a slot could not execute."""
        if not made.result.records:
            return made
        return admitted_by(made, self._runner.run(self._execute(made)))

    async def _open(self) -> str:
        await self._client.__aenter__()
        return await self._client.open_run(RUN)

    async def _close(self) -> None:
        try:
            await self._client.close_run(self._run_id)
        finally:
            await self._client.__aexit__(None, None, None)

    async def _execute(self, made: VariantYield) -> dict[str, RolloutResult]:
        records = made.result.records
        await self._client.put_bundles({records[0].bundle_digest: made.bundle})
        rollouts = tuple(
            Rollout(
                rollout_id=record.task.task_id,
                group_id=record.task.task_id,
                bundle_digest=record.bundle_digest,
                task_id=record.task.task_id,
                plan=plan_from_json(list(record.oracle), record.task.profile),
                seed=SEED,
            )
            for record in records
        )
        batch = Batch(self._run_id, f"{made.result.split}-{made.result.number}", made.result.number, rollouts)
        return {result.rollout_id: result async for result in self._client.execute(batch)}


def admitted_by(made: VariantYield, results: Mapping[str, RolloutResult]) -> VariantYield:
    """What is left of a variant after its plans were executed; ``results`` by task id.

    Raises DatasetError where a plan was not executed at all: that says nothing about its task.
    """
    kept: list[TaskRecord] = []
    rejected: list[Rejection] = []
    for record in made.result.records:
        sentence = _objection(results[record.task.task_id])
        if sentence:
            rejected.append(_rejection(record, sentence))
        else:
            kept.append(record)
    rejections = (*made.result.rejections, *rejected)
    result = dataclasses.replace(made.result, records=tuple(kept), rejections=rejections)
    return dataclasses.replace(made, result=result)


def _objection(result: RolloutResult) -> str:
    """What the cluster has against a task; empty where its plan reaches the goal there too."""
    if not isinstance(result.outcome, Completed):
        raise DatasetError(
            f"the cluster could not execute {result.rollout_id}: {result.outcome}; what was built is kept: see "
            "`embomatrix cluster workers`, then call the same command again"
        )
    reward = result.outcome.reward
    if reward.success:
        return ""
    return f"on the cluster's worker {result.outcome.worker_id} the oracle's plan earns {reward.total:.1f}"


def _rejection(record: TaskRecord, sentence: str) -> Rejection:
    task = record.task
    return Rejection(
        task.scene_id,
        task.category.value,
        task.instruction,
        task.goal_bddl,
        RefusalReason.ORACLE_FAILED,
        sentence,
    )
