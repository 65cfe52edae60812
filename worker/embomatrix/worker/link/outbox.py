"""Outbox of unacknowledged results: they survive broken streams and are sent again on the next one."""

import logging
from typing import Final

from embomatrix.rpc.wire.leases import LeaseClaim, LeaseRef, LeaseResult

logger = logging.getLogger(__name__)

LIMIT: Final = 10_000
"""Most results kept: more mean that no manager has listened for very long."""


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
        """Take up to ``count`` results that this stream has not sent yet."""
        refs = list(self._unsent)[:count]
        return tuple(self._unsent.pop(ref) for ref in refs)

    @property
    def has_unsent(self) -> bool:
        return bool(self._unsent)

    def begin_stream(self) -> None:
        """Mark all results as unsent for a new stream."""
        self._unsent = dict(self._results)
