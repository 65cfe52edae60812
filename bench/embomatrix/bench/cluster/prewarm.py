"""What look-ahead is worth where scenes take seconds to load: hits, waste, and how soon a scene's first rollout starts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.bench.cluster.stepping import Stepping, take_steps
from embomatrix.bench.report.figures import BenchError
from embomatrix.pages.figures import Better, Figure

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from embomatrix.bench.cluster.load_generator import Pushed
    from embomatrix.bench.cluster.stepping import Stepped
    from embomatrix.bench.cluster.work import ClusterWorkload
    from embomatrix.rpc.wire.values import Rollout

HITS_GOAL: Final = 0.95
START_GOAL: Final = 0.05
WASTE_GOAL: Final = 0.1


@dataclass(frozen=True, slots=True)
class PrewarmSizes:
    """Steps of a training run with loading slowed to ``delay_s``."""

    delay_s: float = 2.0
    pause_s: float = 2.5
    """A language model writes the plans of one step for so long: enough to load a scene in each slot."""
    cold_scenes: int = 3
    """Scenes that come unannounced, to compare with."""
    slots: int = 2
    limit_s: float = 120.0


def bench_prewarm(
    work: ClusterWorkload, sizes: PrewarmSizes, on_step: Callable[[str], None]
) -> tuple[Figure, ...]:
    """Take one scene after another without look-ahead, then as many a step as there are slots with it.

    Raises BenchError when a process dies, the time is up, or there are too few scenes.
    """
    # One rollout of each scene: where there are as many as slots, none waits for another.
    singles = [rollouts[:1] for rollouts in work.steps(1)]
    cold, ahead = singles[: sizes.cold_scenes], singles[sizes.cold_scenes :]
    if not ahead:
        raise BenchError(
            f"the workload has too few scenes, {len(singles)}: expected more than {sizes.cold_scenes}"
        )
    on_step("taking steps that nobody announced, with loading slowed")
    unannounced = _take(work, tuple(cold), sizes, pause_s=0.0, lead=-1)
    starts = range(0, len(ahead), sizes.slots)
    steps = tuple(
        tuple(rollout for scene in ahead[start : start + sizes.slots] for rollout in scene)
        for start in starts
    )
    on_step("taking steps that were announced, with loading slowed")
    announced = _take(work, steps, sizes, pause_s=sizes.pause_s, lead=2)
    return _figures(unannounced, announced)


def _take(
    work: ClusterWorkload,
    steps: Sequence[tuple[Rollout, ...]],
    sizes: PrewarmSizes,
    *,
    pause_s: float,
    lead: int,
) -> Stepped:
    stepping = Stepping(tuple(steps), pause_s, lead)
    return take_steps(work.bundles, stepping, sizes.slots, sizes.delay_s, sizes.limit_s)


def _figures(unannounced: Stepped, announced: Stepped) -> tuple[Figure, ...]:
    cold_s, warm_s = _starts_s(unannounced.steps), _starts_s(announced.steps)
    stats = announced.stats
    demanded = stats.prewarm_hits + stats.prewarm_misses
    loaded = stats.prewarm_hits + stats.prewarm_wasted
    ratio = float(np.mean(warm_s) / np.mean(cold_s))
    return (
        Figure(
            "prewarm_hit_rate",
            stats.prewarm_hits / max(1, demanded),
            "share",
            Better.HIGHER,
            demanded,
            HITS_GOAL,
        ),
        Figure(
            "prewarm_waste",
            stats.prewarm_wasted / max(1, loaded),
            "share",
            Better.LOWER,
            max(1, loaded),
            WASTE_GOAL,
        ),
        Figure("start_latency_ratio", ratio, "share", Better.LOWER, len(warm_s), START_GOAL),
        Figure(
            "start of a scene, unannounced", float(np.mean(cold_s)) * 1e3, "ms", Better.LOWER, len(cold_s)
        ),
        Figure("start of a scene, announced", float(np.mean(warm_s)) * 1e3, "ms", Better.LOWER, len(warm_s)),
    )


def _starts_s(steps: Sequence[Pushed]) -> list[float]:
    """Seconds from a step's submission until each of its scenes executed."""
    return [arrival.start_s for pushed in steps for arrival in pushed.arrivals]
