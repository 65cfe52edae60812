"""Batches, results, windows and reputes as bytes: what the store keeps, and what a result's stream sends without converting it
again.
"""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import asdict
from typing import TYPE_CHECKING, Final

from embomatrix.manager.control.events import LookaheadAnnounced
from embomatrix.manager.control.reputation import Reputation
from embomatrix.manager.store.protocol import BatchRow, ResultRow, ShelfRow
from embomatrix.proto.v1 import rollout_service_pb2, types_pb2
from embomatrix.rpc.wire.codec import each
from embomatrix.rpc.wire.outcome import rollout_result_to_proto
from embomatrix.rpc.wire.rollout import batch_from_proto, batch_to_proto
from embomatrix.rpc.wire.run import (
    lookahead_entry_from_proto,
    lookahead_entry_to_proto,
    run_terms_from_proto,
    run_terms_to_proto,
)
from embomatrix.rpc.wire.values import Cancelled, Completed, InfraFailure

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from embomatrix.manager.control.schedule.lookahead import LookaheadWindow
    from embomatrix.manager.store.protocol import RunRow
    from embomatrix.rpc.wire.values import Batch, Outcome, RolloutResult, RunTerms

_KINDS: Final[Mapping[str, type[Outcome]]] = {
    "completed": Completed,
    "infra_failure": InfraFailure,
    "cancelled": Cancelled,
}
"""By the name of the field that has it."""
_DOUBLE: Final = struct.Struct("<d")
_DELIVERED: Final = types_pb2.RolloutResult(
    completed=types_pb2.Completed(timings=types_pb2.Timings(deliver_s=1.0))
).SerializeToString()[: -_DOUBLE.size]
"""What stands before the number in a message that tells nothing but how long a delivery took."""


def batch_row(batch: Batch) -> BatchRow:
    """Equal batches give equal digests."""
    payload = batch.wire or batch_to_proto(batch).SerializeToString(deterministic=True)
    return BatchRow(batch.run_id, batch.batch_id, hashlib.sha256(payload).hexdigest(), payload)


def batch_of(row: BatchRow) -> Batch:
    return batch_from_proto(rollout_service_pb2.ExecuteRequest.FromString(row.payload))


def failed_rows(rows: Iterable[ResultRow]) -> int:
    """How many of these ended as a failure of the infrastructure."""
    results = (types_pb2.RolloutResult.FromString(row.payload) for row in rows)
    return sum(result.WhichOneof("outcome") == "infra_failure" for result in results)


def result_row(result: RolloutResult) -> ResultRow:
    return ResultRow(result.cursor, result.rollout_id, rollout_result_to_proto(result).SerializeToString())


def group_and_kind(row: ResultRow) -> tuple[str, type[Outcome]]:
    """Of which group the rollout was, and what kind of outcome it had."""
    message = types_pb2.RolloutResult.FromString(row.payload)
    return message.group_id, _KINDS[message.WhichOneof("outcome") or "cancelled"]


def timed_row(row: ResultRow, deliver_s: float) -> ResultRow:
    """A completed rollout's row with how long its way into the log took: known only then, so the store's row lacks it.

    Bytes of the same message that follow one another are one message (protobuf, "last one wins", merging nested ones),
    so a row of kilobytes isn't parsed for one number.
    """
    return ResultRow(row.cursor, row.rollout_id, row.payload + _DELIVERED + _DOUBLE.pack(deliver_s))


def repute_row(worker_id: str, repute: Reputation) -> ShelfRow:
    """Disputes end with the manager in which they are open: what they are about is executed again."""
    kept = {name: value for name, value in asdict(repute).items() if name != "disputed"}
    return ShelfRow(worker_id, json.dumps(kept, separators=(",", ":")).encode())


def repute_of(row: ShelfRow) -> Reputation:
    """What `repute_row` wrote."""
    return Reputation(**json.loads(row.payload))


def window_row(run_id: str, window: LookaheadWindow) -> ShelfRow:
    """What the run announced last, as far as it has not come."""
    entries = [lookahead_entry_to_proto(entry) for entry in window.entries]
    message = rollout_service_pb2.AnnounceLookaheadRequest(version=window.version, entries=entries)
    return ShelfRow(run_id, message.SerializeToString())


def announced_in(row: ShelfRow) -> LookaheadAnnounced:
    """What `window_row` wrote, as it was announced."""
    message = rollout_service_pb2.AnnounceLookaheadRequest.FromString(row.payload)
    entries = each("entries", lookahead_entry_from_proto, message.entries)
    return LookaheadAnnounced(row.key, message.version, entries)


def terms_payload(terms: RunTerms) -> bytes:
    return run_terms_to_proto(terms).SerializeToString(deterministic=True)


def terms_of(row: RunRow) -> RunTerms:
    """What a run asked for; the defaults for one that an older manager noted."""
    return run_terms_from_proto(rollout_service_pb2.OpenRunRequest.FromString(row.terms))
