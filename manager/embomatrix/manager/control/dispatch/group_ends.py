"""The ends of groups in a batch's stream of results: told once, with the last result of each, from whatever cursor."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

from embomatrix.rpc.wire.values import Cancelled, Completed, GroupDone, InfraFailure

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from embomatrix.manager.store.protocol import ResultRow
    from embomatrix.rpc.wire.values import Batch, Outcome

_PLACE: Final[Mapping[type[Outcome], int]] = {Completed: 0, InfraFailure: 1, Cancelled: 2}
"""Where each kind of outcome stands among the counts of a group, in the order of `GroupDone`."""


def group_sizes(batch: Batch) -> dict[str, int]:
    """How many rollouts each group of the batch has."""
    return dict(Counter(rollout.group_id for rollout in batch.rollouts))


class GroupEnds:
    """Counts the outcomes of one batch in the order of their cursors, from the first on.

    Which result ends a group follows from that order alone: whoever reads on from a cursor is told of each end once.
    """

    def __init__(self, sizes: Mapping[str, int]) -> None:
        self._sizes = sizes
        self._counts: dict[str, list[int]] = {}
        """Of the groups that have begun and not ended."""
        self._ended: dict[int, GroupDone] = {}
        """By the cursor of the result that ended each."""

    def take(self, cursor: int, group_id: str, outcome: type[Outcome]) -> None:
        """The next result in the order of cursors."""
        counts = self._counts.get(group_id)
        if counts is None:
            counts = self._counts[group_id] = [0, 0, 0]
        counts[_PLACE[outcome]] += 1
        if sum(counts) == self._sizes.get(group_id):
            del self._counts[group_id]
            self._ended[cursor] = GroupDone(group_id, *counts)

    def among(self, rows: Iterable[ResultRow]) -> list[GroupDone]:
        """The groups that end with these results."""
        return [self._ended[row.cursor] for row in rows if row.cursor in self._ended]
