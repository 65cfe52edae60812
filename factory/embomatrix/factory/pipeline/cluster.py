"""Cluster as a second check: its slots execute the oracle's plans before their tasks are admitted."""

import asyncio
import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Final

from embomatrix.factory.admission import SEED, RefusalReason, oracle_plan
from embomatrix.factory.pipeline.store import Rejection, VariantYield
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.values import Batch, Completed, Rollout, RolloutResult
from embomatrix.world.dataset import DatasetError, TaskRecord

RUN: Final = "factory"
"""Name of the run on the manager's pages."""


@contextlib.contextmanager
def cluster_check(
    address: str, token: str = "", ca: bytes = b""
) -> Iterator[Callable[[VariantYield], VariantYield]]:
    """Yield a check that executes a variant's plans in one run on the cluster. Raise ClusterError.

    ``token`` and ``ca`` (PEM) are those of a client. The check raises DatasetError if a slot can't execute a plan.
    """
    with asyncio.Runner() as runner, contextlib.ExitStack() as stack:
        client = runner.run(ClusterClient(address, token, ca=ca).__aenter__())
        stack.callback(lambda: runner.run(client.__aexit__(None, None, None)))
        run_id = runner.run(client.open_run(RUN))
        stack.callback(lambda: runner.run(client.close_run(run_id)))

        def check(variant: VariantYield) -> VariantYield:
            if not variant.result.records:
                return variant
            return admitted_by(variant, runner.run(_execute(client, run_id, variant)))

        yield check


async def _execute(client: ClusterClient, run_id: str, variant: VariantYield) -> dict[str, RolloutResult]:
    records = variant.result.records
    await client.put_bundles({records[0].bundle_digest: variant.bundle})
    rollouts = tuple(
        Rollout(
            rollout_id=record.task.task_id,
            group_id=record.task.task_id,
            bundle_digest=record.bundle_digest,
            task_id=record.task.task_id,
            plan=oracle_plan(record),
            seed=SEED,
        )
        for record in records
    )
    batch = Batch(run_id, f"{variant.result.split}-{variant.result.number}", variant.result.number, rollouts)
    return {result.rollout_id: result async for result in client.execute(batch)}


def admitted_by(variant: VariantYield, results: Mapping[str, RolloutResult]) -> VariantYield:
    """Return the variant without the tasks whose plans failed. ``results`` are keyed by task id.

    Raise DatasetError if a plan was not executed, since that says nothing about its task.
    """
    kept: list[TaskRecord] = []
    rejected: list[Rejection] = []
    for record in variant.result.records:
        task = record.task
        sentence = _cluster_objection(results[task.task_id])
        if not sentence:
            kept.append(record)
            continue
        rejected.append(
            Rejection(
                task.scene_id,
                task.category.value,
                task.instruction,
                task.goal_bddl,
                RefusalReason.ORACLE_FAILED,
                sentence,
            )
        )
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
