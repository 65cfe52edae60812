"""Results that the manager has not acknowledged yet: kept across broken streams, sent again on the next one."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

from embomatrix.rpc.wire.leases import LeaseClaim

if TYPE_CHECKING:
    from embomatrix.rpc.wire.leases import LeaseRef, LeaseResult

logger = logging.getLogger(__name__)

LIMIT: Final = 10_000
"""Results kept at most: more means that nobody has listened for very long."""


class ResultOutbox:
    """Results in the order in which they came."""

    def __init__(self) -> None:
        self._results: dict[LeaseRef, LeaseResult] = {}
        self._unsent: dict[LeaseRef, LeaseResult] = {}

    def __len__(self) -> int:
        return len(self._results)

    def put(self, result: LeaseResult) -> None:
        """Keep a result until it is acknowledged. Past the limit the oldest is dropped: its lease has long expired."""
        if len(self._results) >= LIMIT:
            oldest = next(iter(self._results))
            del self._results[oldest]
            self._unsent.pop(oldest, None)
            logger.warning("result dropped, nobody took it lease=%s", oldest.lease_id)
        self._results[result.ref] = result
        self._unsent[result.ref] = result

    def acknowledge(self, ref: LeaseRef) -> None:
        """Forget a result; one that is not kept is ignored."""
        self._results.pop(ref, None)
        self._unsent.pop(ref, None)

    def claims(self) -> tuple[LeaseClaim, ...]:
        """What the results that are kept are for."""
        return tuple(
            LeaseClaim(result.ref, result.origin)
            for result in self._results.values()
            if result.origin is not None
        )

    def take_unsent(self, count: int) -> tuple[LeaseResult, ...]:
        """Up to ``count`` results that this stream has not carried yet."""
        refs = list(self._unsent)[:count]
        return tuple(self._unsent.pop(ref) for ref in refs)

    @property
    def has_unsent(self) -> bool:
        return bool(self._unsent)

    def begin_stream(self) -> None:
        """Nothing has been carried by the new stream."""
        self._unsent = dict(self._results)
