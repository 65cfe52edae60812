"""The ends of groups in a batch's stream of results: told once, with the last result of each, from whatever cursor."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from embomatrix.proto.v1 import rollout_service_pb2

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from embomatrix.proto.v1 import types_pb2
    from embomatrix.rpc.values import Batch


def group_sizes(batch: Batch) -> dict[str, int]:
    """How many rollouts each group of the batch has."""
    return dict(Counter(rollout.group_id for rollout in batch.rollouts))


class GroupEnds:
    """Counts the outcomes of one batch in the order of their cursors, from the first on.

    Which result ends a group follows from that order alone: whoever reads on from a cursor is told of each end once.
    """

    def __init__(self, sizes: Mapping[str, int]) -> None:
        self._sizes = sizes
        self._counts: dict[str, rollout_service_pb2.GroupDone] = {}

    def take(self, results: Iterable[types_pb2.RolloutResult]) -> list[rollout_service_pb2.GroupDone]:
        """The groups that end with these results."""
        ended: list[rollout_service_pb2.GroupDone] = []
        for result in results:
            group = self._counts.get(result.group_id)
            if group is None:
                group = self._counts[result.group_id] = rollout_service_pb2.GroupDone(
                    group_id=result.group_id
                )
            match result.WhichOneof("outcome"):
                case "completed":
                    group.completed += 1
                case "infra_failure":
                    group.infra_failures += 1
                case "cancelled":
                    group.cancelled += 1
            if group.completed + group.infra_failures + group.cancelled == self._sizes.get(result.group_id):
                ended.append(group)
        return ended
