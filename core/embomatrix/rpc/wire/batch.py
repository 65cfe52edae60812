"""Batches to wire messages and back."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.proto.v1 import rollout_service_pb2
from embomatrix.rpc.wire.rollout import ConvertError, each, required, rollout_from_proto, write_rollout
from embomatrix.rpc.wire.values import Batch

if TYPE_CHECKING:
    from embomatrix.rpc.wire.values import Rollout


def batch_to_proto(batch: Batch) -> rollout_service_pb2.ExecuteRequest:
    message = rollout_service_pb2.ExecuteRequest(
        run_id=batch.run_id, batch_id=batch.batch_id, step=batch.step
    )
    for rollout in batch.rollouts:
        write_rollout(rollout, message.rollouts.add())
    return message


def batch_from_proto(message: rollout_service_pb2.ExecuteRequest) -> Batch:
    """The batch; two rollouts of one id are a ``ConvertError``, since each gets exactly one outcome."""
    return batch_with(message, each("rollouts", rollout_from_proto, message.rollouts))


def batch_with(message: rollout_service_pb2.ExecuteRequest, rollouts: tuple[Rollout, ...]) -> Batch:
    """The batch of a message whose rollouts are converted already."""
    seen: set[str] = set()
    for index, rollout in enumerate(rollouts):
        if rollout.rollout_id in seen:
            raise ConvertError(
                f"rollouts[{index}].rollout_id", f"{rollout.rollout_id!r} stands twice in the batch"
            )
        seen.add(rollout.rollout_id)
    batch = Batch(
        required("run_id", message.run_id), required("batch_id", message.batch_id), message.step, rollouts
    )
    object.__setattr__(batch, "wire", message.SerializeToString(deterministic=True))
    return batch
