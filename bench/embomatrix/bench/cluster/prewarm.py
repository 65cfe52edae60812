"""Value of look-ahead if scenes take seconds to load: hits, waste, and the start of a scene's first rollout."""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.bench.cluster.load_generator import LoadGenerator, Submission, load_generator
from embomatrix.bench.cluster.processes import bench_cluster
from embomatrix.bench.report.figures import BenchError
from embomatrix.pages.figures import Better, Figure
from embomatrix.rpc.wire.values import Rollout, RunStats

if TYPE_CHECKING:
    from embomatrix.bench.engine.workload import Workload


Submit = Callable[[LoadGenerator, Sequence[Rollout]], Awaitable[Submission]]

HITS_GOAL: Final = 0.95
START_GOAL: Final = 0.05
WASTE_GOAL: Final = 0.1


@dataclass(frozen=True, slots=True)
class SlowSteps:
    """Steps of a training run on one worker whose scenes load ``delay_s`` seconds later.

    ``pause_s`` is the time between the announcement of a step and its submission, in which a language model would write the
    plans. ``lookahead`` steps beyond the next one are announced; with -1 none is.
    """

    steps: tuple[tuple[Rollout, ...], ...]
    pause_s: float
    delay_s: float
    slots: int
    limit_s: float
    lookahead: int = 2

    def take(self, bundles: Mapping[str, bytes], submit: Submit) -> tuple[tuple[Submission, ...], RunStats]:
        """Take all steps. Raise BenchError if a process ends or the time is up."""
        deadline_s = time.monotonic() + self.limit_s
        with (
            tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name,
            bench_cluster(
                Path(name), workers=1, slots=self.slots, deadline_s=deadline_s, load_delay_s=self.delay_s
            ) as cluster,
        ):

            async def measure() -> tuple[tuple[Submission, ...], RunStats]:
                async with load_generator(cluster, bundles, deadline_s - time.monotonic()) as load:
                    taken = tuple(
                        [await self._step(load, number, submit) for number in range(len(self.steps))]
                    )
                    return taken, await load.close()

            return asyncio.run(measure())

    async def _step(self, load: LoadGenerator, number: int, submit: Submit) -> Submission:
        window = range(number, min(number + self.lookahead + 1, len(self.steps)))
        if window:
            await load.announce({step: self.steps[step] for step in window})
        await asyncio.sleep(self.pause_s)
        return await submit(load, self.steps[number])


@dataclass(frozen=True, slots=True)
class PrewarmSizes:
    """Loading delay, generation time of a step, and the number of unannounced scenes to compare with."""

    delay_s: float = 2.0
    pause_s: float = 2.5
    cold_scenes: int = 3
    slots: int = 2
    limit_s: float = 120.0


def bench_prewarm(
    workload: Workload, sizes: PrewarmSizes, on_step: Callable[[str], None]
) -> tuple[Figure, ...]:
    """Take single scenes without look-ahead, then one scene for each slot with it.

    Raise BenchError if a process ends, the time is up, or there are too few scenes.
    """
    # One rollout of each scene, so that no rollout waits for another.
    single = workload.first(1).rollouts
    cold, announced = single[: sizes.cold_scenes], single[sizes.cold_scenes :]
    if not announced:
        raise BenchError(
            f"the workload has too few scenes, {len(single)}: expected more than {sizes.cold_scenes}"
        )
    on_step("taking steps without look-ahead, with slowed loading")
    common = (sizes.delay_s, sizes.slots, sizes.limit_s)
    steps = SlowSteps(tuple((rollout,) for rollout in cold), 0.0, *common, lookahead=-1)
    unannounced, _ = steps.take(workload.bundles, LoadGenerator.submit)
    on_step("taking steps with look-ahead, with slowed loading")
    starts = range(0, len(announced), sizes.slots)
    grouped = tuple(announced[start : start + sizes.slots] for start in starts)
    steps = SlowSteps(grouped, sizes.pause_s, *common)
    return _figures(unannounced, *steps.take(workload.bundles, LoadGenerator.submit))


def _figures(
    unannounced: Sequence[Submission], announced: Sequence[Submission], stats: RunStats
) -> tuple[Figure, ...]:
    cold_s, warm_s = _starts_s(unannounced), _starts_s(announced)
    demanded = stats.prewarm_hits + stats.prewarm_misses
    loaded = max(1, stats.prewarm_hits + stats.prewarm_wasted)
    hits, waste = stats.prewarm_hits / max(1, demanded), stats.prewarm_wasted / loaded
    cold_ms, warm_ms = (float(np.mean(seconds)) * 1e3 for seconds in (cold_s, warm_s))
    lower = Better.LOWER
    return (
        Figure("prewarm_hit_rate", hits, "share", Better.HIGHER, demanded, HITS_GOAL),
        Figure("prewarm_waste", waste, "share", lower, loaded, WASTE_GOAL),
        Figure("start_latency_ratio", warm_ms / cold_ms, "share", lower, len(warm_s), START_GOAL),
        Figure("start of a scene, unannounced", cold_ms, "ms", lower, len(cold_s)),
        Figure("start of a scene, announced", warm_ms, "ms", lower, len(warm_s)),
    )


def _starts_s(steps: Sequence[Submission]) -> list[float]:
    """Seconds from a step's submission until each of its rollouts executed."""
    return [arrival.start_s for submission in steps for arrival in submission.arrivals]
