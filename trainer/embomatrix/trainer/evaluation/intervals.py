"""Confidence intervals over tasks: samples of one task are not independent."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from embomatrix.pages.figures import Interval, wilson

RESAMPLES: Final = 4000
LEVEL: Final = 0.95


class IntervalMethod(StrEnum):
    """Method of an interval."""

    BOOTSTRAP = "bootstrap"
    WILSON = "wilson"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class Estimate:
    """Mean over tasks. ``tasks`` counts the tasks with a known value."""

    interval: Interval
    method: IntervalMethod
    tasks: int


NOTHING: Final = Interval(math.nan, math.nan, math.nan)


def bootstrap(values: Sequence[float], seed: int = 0) -> Interval:
    """Mean and percentile bootstrap interval. NaN values are left out."""
    known = np.array([value for value in values if value == value])
    if not known.size:
        return NOTHING
    draws = np.random.default_rng(seed).integers(known.size, size=(RESAMPLES, known.size))
    means = known[draws].mean(axis=1)  # (resamples,)
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(float(known.mean()), float(low), float(high))


def over_seeds_and_tasks(rows: Sequence[Mapping[str, float]], seed: int = 0) -> Interval:
    """Mean over seeds and tasks, with an interval over both. ``rows`` has the tasks' values for each seed.

    Pigeonhole bootstrap, Owen 2007 (*The pigeonhole bootstrap*): seeds and tasks are each drawn anew, because the values of a
    seed share its chance, and those of a task its difficulty. Only tasks that all seeds know count.
    """
    tasks = sorted(set.intersection(*(set(row) for row in rows))) if rows else []
    values = np.array([[row[task] for task in tasks] for row in rows])  # (seeds, tasks)
    known = values[:, ~np.isnan(values).any(axis=0)] if tasks else values.reshape(len(rows), 0)
    if not known.size:
        return NOTHING
    draws = np.random.default_rng(seed)
    drawn = [draws.multinomial(size, np.full(size, 1 / size), RESAMPLES) for size in known.shape]  # counts
    means = np.einsum("rs,st,rt->r", drawn[0], known, drawn[1], optimize=True) / known.size
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(float(known.mean()), float(low), float(high))


def paired_difference(before: Mapping[str, float], after: Mapping[str, float]) -> Interval:
    """Mean of after minus before over the tasks in both. NaN rates are left out."""
    return mean_difference(list(differences(before, after).values()))


def differences(before: Mapping[str, float], after: Mapping[str, float]) -> dict[str, float]:
    """Return after minus before of each task in both."""
    return {task: rate - before[task] for task, rate in after.items() if task in before}


def mean_difference(values: Sequence[float]) -> Interval:
    """Mean of the tasks' differences in [-1, 1], with a bootstrap over tasks; NaN is left out.

    If all n differences are equal, the bootstrap would be falsely certain. A share of up to 1 - 0.025 ** (1/n) of all tasks may
    then have another difference (Clopper and Pearson 1934, none of n).
    """
    known = [each for each in values if each == each]
    if not known or min(known) < max(known):
        return bootstrap(known)
    share, value = 1 - ((1 - LEVEL) / 2) ** (1 / len(known)), known[0]
    return Interval(value, value - share * (1 + value), value + share * (1 - value))


def mean_over_tasks(shares: Sequence[float]) -> Estimate:
    """Mean of the tasks' shares in [0, 1]; NaN shares are left out.

    The interval is a bootstrap over tasks. If all shares are equal, the bootstrap would be falsely certain, so a Wilson
    interval with the tasks as trials is used.
    """
    known = [share for share in shares if share == share]
    if not known:
        return Estimate(NOTHING, IntervalMethod.NONE, 0)
    if min(known) == max(known):
        return Estimate(wilson(known[0], len(known)), IntervalMethod.WILSON, len(known))
    return Estimate(bootstrap(known), IntervalMethod.BOOTSTRAP, len(known))


def pass_at(k: int, samples: int, successes: int) -> float:
    """Probability that at least one of ``k`` samples succeeds, drawn without replacement: Chen et al. 2021, eq. 1.

    NaN if there are fewer than ``k`` samples.
    """
    if k > samples:
        return math.nan
    return 1.0 - math.comb(samples - successes, k) / math.comb(samples, k)
