"""Execution of an evaluation's plans on a cluster."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, Protocol

from embomatrix.rpc.wire.values import Batch, GroupPolicy, Outcome, Rollout, RunTerms

if TYPE_CHECKING:
    from embomatrix.rpc.client import ClusterClient


OnResult = Callable[[str, Outcome], None]

CONCURRENT_BATCHES: Final = 4
"""Batches in flight. The manager loads the scenes of the next ones meanwhile, so no look-ahead is needed."""
RUN_NAME: Final = "eval"


class Executor(Protocol):
    """Executes plans, on a cluster or in processes of this machine. Both give equal outcomes."""

    def execute(self, rollouts: Sequence[Rollout], on_result: OnResult) -> None:
        """Execute each rollout once. ``on_result`` gets its id and its outcome. Raises ClusterError."""
        ...


class ClusterExecutor:
    """Executes each scene's plans as one batch of a cluster run. An unreachable manager is retried until the batch timeout."""

    def __init__(self, connect: Callable[[], ClusterClient], bundle_bytes: Callable[[str], bytes]) -> None:
        self._connect = connect
        self._bundle_bytes = bundle_bytes

    def execute(self, rollouts: Sequence[Rollout], on_result: OnResult) -> None:
        """Execute each rollout once. Raises ClusterError."""
        asyncio.run(self._run(rollouts, on_result))

    async def _run(self, rollouts: Sequence[Rollout], on_result: OnResult) -> None:
        by_bundle: dict[str, list[Rollout]] = {}
        for rollout in rollouts:
            by_bundle.setdefault(rollout.bundle_digest, []).append(rollout)
        async with self._connect() as client:
            run_id = await client.open_run(RUN_NAME, terms=RunTerms(GroupPolicy.PARTIAL))
            try:
                work = iter(list(enumerate(by_bundle.items())))

                async def execute_scenes() -> None:
                    for step, (digest, members) in work:
                        await client.put_bundles({digest: self._bundle_bytes(digest)})
                        await _batch(client, run_id, step, members, on_result)

                await _run_concurrently(execute_scenes)
            finally:
                await client.close_run(run_id)


async def _run_concurrently(work: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run ``CONCURRENT_BATCHES`` copies of a coroutine. The first error cancels the others and is raised unwrapped."""
    try:
        async with asyncio.TaskGroup() as tasks:
            for _ in range(CONCURRENT_BATCHES):
                tasks.create_task(work())
    except ExceptionGroup as errors:
        raise errors.exceptions[0] from errors


async def _batch(
    client: ClusterClient, run_id: str, step: int, group: Sequence[Rollout], on_result: OnResult
) -> None:
    # Rollout ids are unique per manager, so two evaluations must use different ones.
    sent = {f"{run_id}/{rollout.rollout_id}": rollout.rollout_id for rollout in group}
    batch = Batch(
        run_id,
        f"{RUN_NAME}-{step}",
        step,
        tuple(
            replace(rollout, rollout_id=name, group_id=f"{run_id}/{rollout.group_id}")
            for name, rollout in zip(sent, group, strict=True)
        ),
    )
    async for result in client.execute(batch):
        on_result(sent[result.rollout_id], result.outcome)
