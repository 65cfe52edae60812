"""Client of the trainer: submits plans and receives every outcome once, across reconnects and manager fail-over."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
import time
from collections.abc import AsyncGenerator, AsyncIterator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import grpc

from embomatrix.host.backoff import Backoff
from embomatrix.proto.v1 import (
    rollout_service_pb2,
    rollout_service_pb2_grpc,
    scene_service_pb2,
    scene_service_pb2_grpc,
)
from embomatrix.rpc.admin_client import AdminClient, of_the_leader
from embomatrix.rpc.channel import DEFAULT_ADDRESS, chunks_of
from embomatrix.rpc.managers import FAILOVER_S
from embomatrix.rpc.status import (
    ClusterError,
    DeadlineError,
    InternalError,
    NotFoundError,
    OverloadedError,
    UnavailableError,
    cluster_error,
    cluster_errors,
)
from embomatrix.rpc.versions import MERGING_VERSION, SPOKEN, agree, capabilities_of
from embomatrix.rpc.wire.codec import each, inside
from embomatrix.rpc.wire.outcome import rollout_result_from_proto
from embomatrix.rpc.wire.rollout import batch_to_proto, merged, turns_to_proto
from embomatrix.rpc.wire.run import (
    group_done_from_proto,
    lookahead_answer_from_proto,
    lookahead_entry_to_proto,
    run_stats_from_proto,
    run_terms_to_proto,
)
from embomatrix.rpc.wire.training import TrainingReport, training_report_to_proto
from embomatrix.rpc.wire.values import (
    Batch,
    GroupDone,
    LookaheadAnswer,
    LookaheadEntry,
    Rollout,
    RolloutResult,
    RunStats,
    RunTerms,
    Warmth,
)

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ClientLimits:
    """Time limits of a client, in seconds."""

    call_s: float = 10.0
    """Answer to a short call."""
    bundle_s: float = 60.0
    """Upload of one bundle."""
    batch_s: float = 600.0
    """Outcome of every rollout of a batch."""
    turn_s: float = 120.0
    """Result of one turn of an episode, with all retries."""
    retry_first_s: float = 0.1
    """First wait before a broken stream is attached again. It doubles with each attempt without progress."""
    retry_longest_s: float = 2.0
    failover_s: float = FAILOVER_S
    """Take-over by another manager, where several addresses are known."""


DEFAULT_LIMITS: Final = ClientLimits()
DEFAULT_TERMS: Final = RunTerms()
_TRANSIENT: Final = (UnavailableError, InternalError, OverloadedError)
"""Errors after which the same batch is attached again."""


class ClusterClient(AdminClient):
    """Opens runs, announces scenes, and executes batches."""

    def __init__(
        self,
        address: str = DEFAULT_ADDRESS,
        token: str = "",
        *,
        ca: bytes = b"",
        limits: ClientLimits = DEFAULT_LIMITS,
        merging: bool = True,
    ) -> None:
        """Connect to the first reachable of the addresses. Equal rollouts of a group are executed once with ``merging``."""
        super().__init__(address, token, ca=ca, call_s=limits.call_s, failover_s=limits.failover_s)
        self._limits = limits
        self._merging = merging
        self._merges = False
        """True once the manager is known to accept merged rollouts."""

    @property
    def limits(self) -> ClientLimits:
        return self._limits

    @property
    def _rollouts(self) -> rollout_service_pb2_grpc.RolloutServiceAsyncStub:
        return rollout_service_pb2_grpc.RolloutServiceStub(self._channel)

    @property
    def _scenes(self) -> scene_service_pb2_grpc.SceneServiceAsyncStub:
        return scene_service_pb2_grpc.SceneServiceStub(self._channel)

    @of_the_leader
    async def open_run(self, name: str, run_id: str = "", terms: RunTerms = DEFAULT_TERMS) -> str:
        """Open a run and return its id. An open run of the same id is attached to and keeps its terms."""
        request = run_terms_to_proto(terms)
        request.name, request.run_id = name, run_id
        found = await capabilities_of(self._rollouts, timeout_s=self._call_s)
        request.protocol_version = agree(
            SPOKEN,
            found.protocol,
            us="this trainer",
            them=f"the manager at {self._address}",
            their_release=found.release,
        )
        self._merges = self._merging and request.protocol_version >= MERGING_VERSION
        answer = await self._rollouts.OpenRun(request, timeout=self._call_s)
        return str(answer.run_id)

    async def announce_lookahead(
        self, run_id: str, version: int, entries: Iterable[LookaheadEntry]
    ) -> dict[str, Warmth]:
        """Replace the run's look-ahead window. Return the warmth of each scene by bundle digest."""
        answers = await self.announce_window(run_id, version, entries)
        return {answer.bundle_digest: answer.warmth for answer in answers}

    @of_the_leader
    async def announce_window(
        self, run_id: str, version: int, entries: Iterable[LookaheadEntry]
    ) -> tuple[LookaheadAnswer, ...]:
        """Replace the run's look-ahead window. Return the warmth and readiness forecast of each scene."""
        request = rollout_service_pb2.AnnounceLookaheadRequest(
            run_id=run_id, version=version, entries=map(lookahead_entry_to_proto, entries)
        )
        answer = await self._rollouts.AnnounceLookahead(request, timeout=self._call_s)
        return each("answers", lookahead_answer_from_proto, answer.answers)

    @of_the_leader
    async def put_bundles(self, bundles: Mapping[str, bytes]) -> tuple[str, ...]:
        """Upload the bundles (by digest) that the manager lacks. Return the uploaded digests."""
        request = scene_service_pb2.MissingBundlesRequest(bundle_digests=list(bundles))
        answer = await self._scenes.MissingBundles(request, timeout=self._call_s)
        missing = tuple(digest for digest in answer.bundle_digests if digest in bundles)
        for digest in missing:
            chunks = _bundle_chunks(digest, bundles[digest])
            await self._scenes.PutBundle(chunks, timeout=self._limits.bundle_s)
        return missing

    async def execute(
        self, batch: Batch, *, deadline_s: float | None = None
    ) -> AsyncGenerator[RolloutResult]:
        """Execute the batch. Yield the one outcome of each rollout as it arrives, as ``events`` does."""
        async with contextlib.aclosing(self.events(batch, deadline_s=deadline_s)) as events:
            async for event in events:
                if isinstance(event, RolloutResult):
                    yield event

    async def events(
        self, batch: Batch, *, deadline_s: float | None = None
    ) -> AsyncGenerator[RolloutResult | GroupDone]:
        """Execute the batch; yields each rollout's one outcome, and one event for each complete group.

        A broken stream is attached again from the last cursor, also across a restart of the manager, until
        every rollout has its outcome. After ``deadline_s`` seconds (by default the limit for a batch) it
        raises ``DeadlineError``.
        """
        within_s = self._limits.batch_s if deadline_s is None else deadline_s
        if self._merges:
            batch = dataclasses.replace(batch, rollouts=tuple(merged(batch.rollouts)))
        attached = _AttachedBatch(batch, within_s)
        backoff = Backoff(self._limits.retry_first_s, self._limits.retry_longest_s)
        while attached.missing:
            before, cursor = len(attached.missing), attached.cursor
            try:
                async with contextlib.aclosing(self._stream(attached)) as stream:
                    async for results, groups in stream:
                        for result in attached.new(results):
                            yield result
                        for group in attached.ended(groups):
                            yield group
                attached.submitted = True
                if attached.cursor == cursor:
                    # The batch ended although results are missing: a store that lost its last second has reused the
                    # cursors that were read before.
                    attached.cursor = 0
            except _TRANSIENT as error:
                logger.info("batch %s: attaching again after: %s", batch.batch_id, error)
                if isinstance(error, UnavailableError):
                    self.managers.move(error)
            except NotFoundError:
                # The manager lost or never received the batch: submit the same id and content again.
                if not attached.submitted:
                    raise
                attached.submitted, attached.cursor = False, 0
            if len(attached.missing) < before:
                backoff.reset()
            if attached.missing:
                await asyncio.sleep(min(backoff.next_s(), attached.time_left()))

    async def _stream(
        self, attached: _AttachedBatch
    ) -> AsyncGenerator[tuple[Sequence[RolloutResult], Sequence[GroupDone]]]:
        """Read one stream of the batch. The first stream submits the batch, later ones continue after the cursor."""
        timeout_s = attached.time_left()
        call: grpc.aio.UnaryStreamCall
        if attached.submitted:
            call = self._rollouts.WaitExecution(attached.wait_request(), timeout=timeout_s)
        else:
            call = self._rollouts.Execute(batch_to_proto(attached.batch), timeout=timeout_s)
        try:
            async for response in call:
                attached.submitted = True
                with cluster_errors(self._address):
                    results = each("results", rollout_result_from_proto, response.results)
                    groups = each("groups", group_done_from_proto, response.groups)
                yield results, groups
                if not attached.missing:
                    return  # the rest of the stream carries no results
        except grpc.aio.AioRpcError as error:
            raise attached.explain(cluster_error(error, self._address)) from error
        finally:
            call.cancel()

    @of_the_leader
    async def step(
        self, run_id: str, turns: Sequence[Rollout], *, timeout_s: float | None = None
    ) -> tuple[RolloutResult, ...]:
        """Execute turns of episodes, rollouts with a prefix, and return the one result of each in order.

        ``Episodes`` of ``embomatrix.rpc.episodes`` sends the turns of many episodes together, and again after errors.
        """
        limit_s = self._limits.turn_s if timeout_s is None else timeout_s
        answer = await self._rollouts.Step(turns_to_proto(run_id, turns), timeout=limit_s)
        results = each("results", rollout_result_from_proto, answer.results)
        if [result.rollout_id for result in results] != [turn.rollout_id for turn in turns]:
            raise InternalError("the manager sent results of other turns than it was asked for")
        return results

    @of_the_leader
    async def cancel(self, run_id: str, batch_id: str) -> None:
        """Cancel a batch: its rollouts without an outcome end as ``Cancelled``."""
        request = rollout_service_pb2.CancelBatchRequest(run_id=run_id, batch_id=batch_id)
        await self._rollouts.CancelBatch(request, timeout=self._call_s)

    @of_the_leader
    async def report_training(self, run_id: str, report: TrainingReport) -> None:
        """Send a training report, which the dashboard shows."""
        await self._rollouts.ReportTraining(training_report_to_proto(run_id, report), timeout=self._call_s)

    @of_the_leader
    async def close_run(self, run_id: str) -> RunStats:
        """Close a run and return its counters. The manager drops its results and look-ahead window."""
        request = rollout_service_pb2.CloseRunRequest(run_id=run_id)
        answer = await self._rollouts.CloseRun(request, timeout=self._call_s)
        return inside("stats", run_stats_from_proto, answer.stats)


class _AttachedBatch:
    """State of a batch between two streams."""

    def __init__(self, batch: Batch, within_s: float) -> None:
        self.batch = batch
        self.missing = {name for rollout in batch.rollouts for name in (rollout.rollout_id, *rollout.also)}
        self.submitted = False
        self.cursor = 0
        self._groups: set[str] = set()
        self._within_s = within_s
        self._ends_s = time.monotonic() + within_s

    def new(self, results: Sequence[RolloutResult]) -> Iterable[RolloutResult]:
        """Yield the results that were not seen before."""
        for result in results:
            self.cursor = max(self.cursor, result.cursor)
            for one in result.each():
                if one.rollout_id in self.missing:
                    self.missing.discard(one.rollout_id)
                    yield one

    def ended(self, groups: Sequence[GroupDone]) -> Iterable[GroupDone]:
        """Yield the groups whose end was not reported before."""
        for group in groups:
            if group.group_id not in self._groups:
                self._groups.add(group.group_id)
                yield group

    def wait_request(self) -> rollout_service_pb2.WaitExecutionRequest:
        return rollout_service_pb2.WaitExecutionRequest(
            run_id=self.batch.run_id, batch_id=self.batch.batch_id, after_cursor=self.cursor
        )

    def time_left(self) -> float:
        """Return the seconds until the caller's deadline. Raise DeadlineError after it."""
        left_s = self._ends_s - time.monotonic()
        if left_s <= 0:
            raise self._late()
        return left_s

    def explain(self, error: ClusterError) -> ClusterError:
        """Return the error of a stream. For the caller's own deadline, list what is missing."""
        if isinstance(error, DeadlineError) and time.monotonic() >= self._ends_s - 0.05:
            return self._late()
        return error

    def _late(self) -> DeadlineError:
        return DeadlineError(
            f"batch {self.batch.batch_id}: {len(self.missing)} of {self.batch.count} rollouts "
            f"had no outcome within {self._within_s:g} s: are workers connected? (`embomatrix status`)"
        )


async def _bundle_chunks(digest: str, data: bytes) -> AsyncIterator[scene_service_pb2.PutBundleRequest]:
    for index, chunk in enumerate(chunks_of(data)):
        yield scene_service_pb2.PutBundleRequest(bundle_digest=digest if index == 0 else "", chunk=chunk)
