"""What the loss of one rollout means for the others: the run's policy, as one table."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.rpc.wire.values import GroupPolicy

if TYPE_CHECKING:
    from embomatrix.manager.control.dispatch.ledger import BatchRecord, GroupRecord, RolloutRecord


def attempts_allowed(policy: GroupPolicy, usual: int) -> int:
    """Started leases of a rollout before it ends as a failure of the infrastructure."""
    return 1 if policy is GroupPolicy.FAIL_FAST else usual


def failed_with(
    policy: GroupPolicy, batch: BatchRecord, group: GroupRecord
) -> tuple[list[GroupRecord], list[RolloutRecord]]:
    """The groups that can't be completed any more once a member of ``group`` is lost, and the rollouts to call off."""
    match policy:
        case GroupPolicy.PARTIAL:
            return [group], []
        case GroupPolicy.RETRY_THEN_FAIL_GROUP:
            return [group], list(group.open.values())
        case GroupPolicy.FAIL_FAST:
            others = [other for other in batch.groups.values() if other.open and other is not group]
            return [group, *others], list(batch.open.values())
