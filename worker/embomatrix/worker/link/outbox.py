"""Outbox of unacknowledged results: they survive broken streams and are sent again on the next one."""

import logging
from typing import Final

from embomatrix.rpc.wire.bounds import HELD_LEASES
from embomatrix.rpc.wire.leases import LeaseClaim, LeaseRef, LeaseResult
from embomatrix.rpc.wire.values import Completed

logger = logging.getLogger(__name__)

LIMIT: Final = HELD_LEASES
"""Most results kept: a manager accepts claims to this many, besides those to running leases."""
MESSAGE_BYTES: Final = 2 * 1024 * 1024
"""Bytes of the results in one message, half of the bound on the message."""


class ResultOutbox:
    """Results in order of arrival."""

    def __init__(self) -> None:
        self._results: dict[LeaseRef, LeaseResult] = {}
        self._unsent: dict[LeaseRef, LeaseResult] = {}

    def __len__(self) -> int:
        return len(self._results)

    def put(self, result: LeaseResult) -> None:
        """Keep a result until it is acknowledged. Beyond the limit drop the oldest, whose lease has long expired."""
        if len(self._results) >= LIMIT:
            oldest = next(iter(self._results))
            del self._results[oldest]
            self._unsent.pop(oldest, None)
            logger.warning("unacknowledged result dropped lease=%s", oldest.lease_id)
        self._results[result.ref] = result
        self._unsent[result.ref] = result

    def acknowledge(self, ref: LeaseRef) -> None:
        """Drop a result; an unknown one is ignored."""
        self._results.pop(ref, None)
        self._unsent.pop(ref, None)

    def claims(self) -> tuple[LeaseClaim, ...]:
        """Origins of the kept results."""
        return tuple(
            LeaseClaim(result.ref, result.origin)
            for result in self._results.values()
            if result.origin is not None
        )

    def take_unsent(self, count: int) -> tuple[LeaseResult, ...]:
        """Take up to ``count`` results that this stream has not sent yet, as far as they fit into one message."""
        taken: list[LeaseResult] = []
        size = 0
        for result in list(self._unsent.values())[:count]:
            size += _size(result)
            if taken and size > MESSAGE_BYTES:
                break
            taken.append(self._unsent.pop(result.ref))
        return tuple(taken)

    def unsent(self) -> tuple[LeaseRef, ...]:
        """Leases whose results this stream has not sent yet: for the manager they still run."""
        return tuple(self._unsent)

    @property
    def has_unsent(self) -> bool:
        return bool(self._unsent)

    def begin_stream(self) -> None:
        """Mark all results as unsent for a new stream."""
        self._unsent = dict(self._results)


def _size(result: LeaseResult) -> int:
    """Return about the bytes of the result on the wire."""
    outcome = result.outcome
    return 256 + len(outcome.wire if isinstance(outcome, Completed) else outcome.message)
