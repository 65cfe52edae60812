"""Histogram of durations with bounded memory, quantiles of known error, and Prometheus buckets."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Final

PER_DECADE: Final = 32
"""Buckets per power of ten. Each is 7.5 % wide, so a quantile at the middle of its bucket has an error of at most 4
%."""
LEAST_S: Final = 1e-5
MOST_S: Final = 1e3
"""Shorter durations share the first bucket, longer ones the last."""
_BUCKETS: Final = round(PER_DECADE * math.log10(MOST_S / LEAST_S))
BOUNDS_S: Final = tuple(10.0 ** (half / 2) for half in range(-8, 5))
"""Upper bounds of the Prometheus buckets, two per decade from 0.1 ms to 100 s. Each is also a bound of our
buckets."""


class Histogram:
    """Counts of durations in seconds."""

    __slots__ = ("count", "counts", "sum_s")

    def __init__(self) -> None:
        self.counts = [0] * (_BUCKETS + 2)
        self.count = 0
        self.sum_s = 0.0

    def observe(self, seconds: float) -> None:
        self.counts[_bucket(seconds)] += 1
        self.count += 1
        self.sum_s += seconds

    def add(self, other: Histogram) -> None:
        """Add the counts of another histogram."""
        self.counts = [mine + theirs for mine, theirs in zip(self.counts, other.counts, strict=True)]
        self.count += other.count
        self.sum_s += other.sum_s

    def quantile(self, share: float) -> float:
        """Return the duration in seconds that this share does not exceed, with an error of 4 %; 0 for an empty
        histogram.
        """
        wanted = share * self.count
        for bucket, total in enumerate(itertools.accumulate(self.counts)):
            if total and total >= wanted:
                return _middle_s(bucket)
        return 0.0

    def cumulative(self) -> list[int]:
        """Return the cumulative count at each of ``BOUNDS_S``."""
        totals = list(itertools.accumulate(self.counts))
        return [totals[round(PER_DECADE * math.log10(bound_s / LEAST_S))] for bound_s in BOUNDS_S]


def merged(histograms: Iterable[Histogram]) -> Histogram:
    """Return the sum of the histograms."""
    total = Histogram()
    for histogram in histograms:
        total.add(histogram)
    return total


def quantile(ordered: Sequence[float], share: float) -> float:
    """Return the value at that share of an ascending sequence; 0 for an empty one."""
    return ordered[min(int(share * len(ordered)), len(ordered) - 1)] if ordered else 0.0


def _bucket(seconds: float) -> int:
    """Return the bucket of a duration. Bucket b ends at ``LEAST_S * 10**(b / PER_DECADE)``, inclusive."""
    if seconds <= LEAST_S:
        return 0
    return min(math.ceil(PER_DECADE * math.log10(seconds / LEAST_S)), _BUCKETS + 1)


def _middle_s(bucket: int) -> float:
    """Return the geometric middle of a bucket; the first bucket counts as 0."""
    return LEAST_S * 10.0 ** ((bucket - 0.5) / PER_DECADE) if bucket else 0.0
