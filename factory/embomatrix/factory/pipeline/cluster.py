"""Cluster as a second check: its slots execute the oracle's plans before their tasks are admitted."""

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
"""Name of the run on the manager's pages."""


class ClusterCheck:
    """Context manager of one event loop and one run on the cluster. ``token`` and ``ca`` (PEM) are those of a client."""

    def __init__(self, address: str, token: str = "", ca: bytes = b"") -> None:
        self._client = ClusterClient(address, token, ca=ca)
        self._runner = asyncio.Runner()
        self._run_id = ""

    def __enter__(self) -> Self:
        """Open the run. Raise ClusterError."""
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

    def check(self, variant: VariantYield) -> VariantYield:
        """Return the variant with the tasks that the cluster admits.

        Raise ClusterError, or DatasetError if a slot can't execute a plan.
        """
        if not variant.result.records:
            return variant
        return admitted_by(variant, self._runner.run(self._execute(variant)))

    async def _open(self) -> str:
        await self._client.__aenter__()
        return await self._client.open_run(RUN)

    async def _close(self) -> None:
        try:
            await self._client.close_run(self._run_id)
        finally:
            await self._client.__aexit__(None, None, None)

    async def _execute(self, variant: VariantYield) -> dict[str, RolloutResult]:
        records = variant.result.records
        await self._client.put_bundles({records[0].bundle_digest: variant.bundle})
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
        batch = Batch(
            self._run_id, f"{variant.result.split}-{variant.result.number}", variant.result.number, rollouts
        )
        return {result.rollout_id: result async for result in self._client.execute(batch)}


def admitted_by(variant: VariantYield, results: Mapping[str, RolloutResult]) -> VariantYield:
    """Return the variant without the tasks whose plans failed. ``results`` are keyed by task id.

    Raise DatasetError if a plan was not executed, since that says nothing about its task.
    """
    kept: list[TaskRecord] = []
    rejected: list[Rejection] = []
    for record in variant.result.records:
        sentence = _cluster_objection(results[record.task.task_id])
        if sentence:
            rejected.append(_rejection(record, sentence))
        else:
            kept.append(record)
    rejections = (*variant.result.rejections, *rejected)
    result = dataclasses.replace(variant.result, records=tuple(kept), rejections=rejections)
    return dataclasses.replace(variant, result=result)


def _cluster_objection(result: RolloutResult) -> str:
    """Return the cluster's objection to a task; empty if its plan reaches the goal."""
    if not isinstance(result.outcome, Completed):
        raise DatasetError(
            f"the cluster could not execute {result.rollout_id}: {result.outcome}; finished variants are kept: check "
            "`embomatrix cluster workers`, then run the same command again"
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
