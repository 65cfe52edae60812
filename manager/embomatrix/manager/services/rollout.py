"""RolloutService: runs, look-ahead, batches, and result streams."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Sequence
from typing import TYPE_CHECKING, Final, TypeVar

from grpc.aio import ServicerContext as Context

from embomatrix.manager.observe.training_reports import TrainingBook
from embomatrix.manager.runtime.open_turns import OpenTurns
from embomatrix.manager.runtime.results import BatchLog
from embomatrix.manager.runtime.runs import BATCH_ROLLOUTS, Runs
from embomatrix.proto.v1 import rollout_service_pb2 as pb
from embomatrix.proto.v1 import rollout_service_pb2_grpc, types_pb2
from embomatrix.rpc.logs import bind
from embomatrix.rpc.status import NotFoundError, TrimmedError, translated
from embomatrix.rpc.versions import SPOKEN, VersionRange, agree, software_version
from embomatrix.rpc.wire.codec import each
from embomatrix.rpc.wire.outcome import rollout_result_to_proto
from embomatrix.rpc.wire.rollout import batch_with, checked_turns, rollout_from_proto, turn_from_proto
from embomatrix.rpc.wire.run import (
    group_done_to_proto,
    lookahead_answer_to_proto,
    lookahead_entry_from_proto,
    run_stats_to_proto,
    run_terms_from_proto,
)
from embomatrix.rpc.wire.training import training_report_from_proto
from embomatrix.rpc.wire.values import Batch, Rollout
from embomatrix.world.inflation import DEFAULT_LIMITS

if TYPE_CHECKING:
    from embomatrix.manager.access.gate import Gate

SLICE: Final = 128
"""Rollouts of a batch converted without a pause, which takes about 2 ms."""
ResultsT = TypeVar("ResultsT", pb.ExecuteResponse, pb.WaitExecutionResponse)


@translated
class RolloutServicer(rollout_service_pb2_grpc.RolloutServiceServicer):
    """``authority`` is the PEM certificate of the signing authority; empty without TLS."""

    def __init__(
        self, runs: Runs, turns: OpenTurns, training: TrainingBook, gate: Gate, *, authority: bytes = b""
    ) -> None:
        self._runs = runs
        self._turns = turns
        self._training = training
        self._gate = gate
        self._authority = authority.decode("ascii")

    async def GetCapabilities(
        self, request: pb.GetCapabilitiesRequest, context: Context
    ) -> pb.GetCapabilitiesResponse:
        return pb.GetCapabilitiesResponse(
            protocol_low=SPOKEN.oldest,
            protocol_high=SPOKEN.newest,
            version=software_version(),
            batch_rollouts=BATCH_ROLLOUTS,
            bundle_bytes=DEFAULT_LIMITS.compressed_bytes,
            ca_certificate=self._authority,
        )

    async def OpenRun(self, request: pb.OpenRunRequest, context: Context) -> pb.OpenRunResponse:
        spoken = request.protocol_version
        agree(SPOKEN, VersionRange(spoken, spoken), us="this manager", them="the trainer")
        run_id = await self._runs.open_run(request.name, request.run_id, run_terms_from_proto(request))
        return pb.OpenRunResponse(run_id=run_id)

    async def AnnounceLookahead(
        self, request: pb.AnnounceLookaheadRequest, context: Context
    ) -> pb.AnnounceLookaheadResponse:
        bind("run", request.run_id)
        entries = each("entries", lookahead_entry_from_proto, request.entries)
        answers = self._runs.announce(request.run_id, request.version, entries)
        return pb.AnnounceLookaheadResponse(answers=map(lookahead_answer_to_proto, answers))

    async def Execute(
        self, request: pb.ExecuteRequest, context: Context
    ) -> AsyncIterator[pb.ExecuteResponse]:
        bind("run", request.run_id)
        bind("batch", request.batch_id)
        log = await self._runs.submit(await _batch(request))
        async for message in self._results(context, log, 0, pb.ExecuteResponse):
            yield message

    async def WaitExecution(
        self, request: pb.WaitExecutionRequest, context: Context
    ) -> AsyncIterator[pb.WaitExecutionResponse]:
        bind("run", request.run_id)
        bind("batch", request.batch_id)
        log = self._runs.log_of(request.run_id, request.batch_id)
        async for message in self._results(context, log, request.after_cursor, pb.WaitExecutionResponse):
            yield message

    async def CancelBatch(self, request: pb.CancelBatchRequest, context: Context) -> pb.CancelBatchResponse:
        bind("run", request.run_id)
        bind("batch", request.batch_id)
        self._runs.cancel(request.run_id, request.batch_id)
        return pb.CancelBatchResponse()

    async def Step(self, request: pb.StepRequest, context: Context) -> pb.StepResponse:
        bind("run", request.run_id)
        turns = checked_turns(await _sliced("turns", turn_from_proto, request.turns))
        results = await self._turns.step(request.run_id, turns)
        return pb.StepResponse(results=[rollout_result_to_proto(result) for result in results])

    async def ReportTraining(
        self, request: pb.ReportTrainingRequest, context: Context
    ) -> pb.ReportTrainingResponse:
        bind("run", request.run_id)
        report = training_report_from_proto(request)
        name = self._runs.touch(request.run_id).name
        self._training.note(request.run_id, name, report, at_s=time.time())
        return pb.ReportTrainingResponse()

    async def CloseRun(self, request: pb.CloseRunRequest, context: Context) -> pb.CloseRunResponse:
        bind("run", request.run_id)
        stats = await self._runs.close_run(request.run_id)
        return pb.CloseRunResponse(stats=run_stats_to_proto(stats))

    async def _results(
        self, context: Context, log: BatchLog, cursor: int, kind: type[ResultsT]
    ) -> AsyncIterator[ResultsT]:
        """Yield stored results after the cursor, and the groups that end with them, until the batch ends."""
        if cursor > log.last_cursor and log.ended:
            raise TrimmedError(
                f"batch {log.batch_id!r} ends at cursor {log.last_cursor}: {cursor} lies beyond it"
            )
        async for rows in log.messages(cursor):
            self._gate.caller_of(context)  # A revoked token reads no further results.
            message = kind()
            for row in rows:
                message.results.add().MergeFromString(row.payload)
            message.groups.extend(map(group_done_to_proto, log.ends.among(rows)))
            yield message
        if log.dropped:
            raise NotFoundError(f"batch {log.batch_id!r} was discarded: its run was closed")


async def _batch(request: pb.ExecuteRequest) -> Batch:
    return batch_with(request, await _sliced("rollouts", rollout_from_proto, request.rollouts))


async def _sliced(
    field: str, convert: Callable[[types_pb2.Rollout], Rollout], messages: Sequence[types_pb2.Rollout]
) -> tuple[Rollout, ...]:
    """Return the rollouts of a request. Many are converted in slices, so that other calls are not delayed."""
    rollouts: list[Rollout] = []
    for start in range(0, len(messages), SLICE):
        if start:
            await asyncio.sleep(0)
        rollouts += each(field, convert, messages[start : start + SLICE], first=start)
    return tuple(rollouts)
