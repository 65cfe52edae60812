"""Serialized rows of the state store: batches, results, look-ahead windows and reputations.

Result streams send the stored bytes without parsing them.
"""

import hashlib
import json
import struct
from collections.abc import Mapping
from dataclasses import asdict
from typing import Final

import msgspec

from embomatrix.manager.control.events import LookaheadAnnounced
from embomatrix.manager.control.reputation import Reputation
from embomatrix.manager.control.schedule.lookahead import LookaheadWindow
from embomatrix.manager.store.protocol import BatchRow, NamespaceRow, ResultRow, RunRow, readable
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
from embomatrix.rpc.wire.values import (
    Batch,
    Cancelled,
    Completed,
    InfraFailure,
    Outcome,
    RolloutResult,
    RunTerms,
)
from embomatrix.world.json_text import parse_json

_KINDS: Final[Mapping[str, type[Outcome]]] = {
    "completed": Completed,
    "infra_failure": InfraFailure,
    "cancelled": Cancelled,
}
"""Kind of outcome by the name of its protobuf field."""
_DOUBLE: Final = struct.Struct("<d")
_DELIVERED: Final = types_pb2.RolloutResult(
    completed=types_pb2.Completed(timings=types_pb2.Timings(deliver_s=1.0))
).SerializeToString()[: -_DOUBLE.size]
"""Tags and lengths that precede the delivery time in a message that holds nothing else."""


def batch_row(batch: Batch) -> BatchRow:
    """Return the batch's row. Equal batches give equal digests."""
    payload = batch.wire or batch_to_proto(batch).SerializeToString(deterministic=True)
    return BatchRow(batch.run_id, batch.batch_id, hashlib.sha256(payload).hexdigest(), payload)


def batch_of(row: BatchRow) -> Batch:
    """Return the batch of `batch_row`. Raises StateError."""
    with readable(f"batch {row.batch_id!r} of run {row.run_id!r}"):
        return batch_from_proto(rollout_service_pb2.ExecuteRequest.FromString(row.payload))


def result_row(result: RolloutResult) -> ResultRow:
    return ResultRow(result.cursor, result.rollout_id, rollout_result_to_proto(result).SerializeToString())


def group_and_kind(row: ResultRow) -> tuple[str, type[Outcome], int]:
    """Return the group, the kind of outcome, and the number of rollouts of a result. Raises StateError."""
    with readable(f"the result of rollout {row.rollout_id!r}"):
        message = types_pb2.RolloutResult.FromString(row.payload)
        kind = _KINDS[message.WhichOneof("outcome") or "cancelled"]
        return message.group_id, kind, 1 + len(message.also)


def timed_row(row: ResultRow, deliver_s: float) -> ResultRow:
    """Return a completed rollout's row with its delivery time, which is unknown when the row is stored.

    Concatenated bytes of protobuf messages merge, so the row is extended without parsing it.
    """
    return ResultRow(row.cursor, row.rollout_id, row.payload + _DELIVERED + _DOUBLE.pack(deliver_s))


def reputation_row(worker_id: str, worker_reputation: Reputation) -> NamespaceRow:
    """Return the row of a reputation. Open disputes are dropped, since their rollouts are executed again."""
    kept = {name: value for name, value in asdict(worker_reputation).items() if name != "disputed"}
    return NamespaceRow(worker_id, json.dumps(kept, separators=(",", ":")).encode())


def reputation_of(row: NamespaceRow) -> Reputation:
    """Return the reputation of `reputation_row`. Raises StateError."""
    with readable(f"the reputation of worker {row.key!r}"):
        fields = parse_json(row.payload)
        Reputation(**fields)  # refuses unknown fields
        return msgspec.convert(fields, Reputation)


def window_row(run_id: str, window: LookaheadWindow) -> NamespaceRow:
    """Return the row of a run's remaining look-ahead window."""
    entries = [lookahead_entry_to_proto(entry) for entry in window.entries]
    message = rollout_service_pb2.AnnounceLookaheadRequest(version=window.version, entries=entries)
    return NamespaceRow(run_id, message.SerializeToString())


def announced_in(row: NamespaceRow) -> LookaheadAnnounced:
    """Return the window of `window_row`, as an announcement. Raises StateError."""
    with readable(f"the look-ahead window of run {row.key!r}"):
        message = rollout_service_pb2.AnnounceLookaheadRequest.FromString(row.payload)
        entries = each("entries", lookahead_entry_from_proto, message.entries)
        return LookaheadAnnounced(row.key, message.version, entries)


def terms_payload(terms: RunTerms) -> bytes:
    return run_terms_to_proto(terms).SerializeToString(deterministic=True)


def terms_of(row: RunRow) -> RunTerms:
    """Return the terms of a stored run. Raises StateError."""
    with readable(f"the terms of run {row.run_id!r}"):
        return run_terms_from_proto(rollout_service_pb2.OpenRunRequest.FromString(row.terms))
