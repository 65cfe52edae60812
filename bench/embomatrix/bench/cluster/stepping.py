"""Steps of a training run on workers that load slowly: announced ahead, a pause for generation, then executed."""

from __future__ import annotations

import asyncio
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from embomatrix.bench.cluster.load_generator import BenchTrainer, trainer_on
from embomatrix.bench.cluster.processes import bench_cluster

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence

    from embomatrix.bench.cluster.load_generator import Pushed
    from embomatrix.rpc.wire.values import Rollout, RunStats

    Push = Callable[[BenchTrainer, Sequence[Rollout]], Awaitable[Pushed]]
    Steps = tuple[tuple[Rollout, ...], ...]


@dataclass(frozen=True, slots=True)
class Stepping:
    """How a trainer takes its steps."""

    steps: Steps
    """The rollouts of each."""
    pause_s: float
    """Between the announcement of a step and its submission: a language model writes the plans meanwhile."""
    lead: int = 2
    """So many steps are announced beyond the one that comes next; with -1 nothing is announced."""
    push: Push = BenchTrainer.push
    """How a step's rollouts are submitted."""


@dataclass(frozen=True, slots=True)
class Stepped:
    """What came of every step, and the run's counters."""

    steps: tuple[Pushed, ...]
    stats: RunStats


def take_steps(
    bundles: Mapping[str, bytes], stepping: Stepping, slots: int, delay_s: float, limit_s: float
) -> Stepped:
    """Take the steps on a worker of its own that loads every scene ``delay_s`` seconds later.

    Raises BenchError when a process dies or the time is up.
    """
    deadline_s = time.monotonic() + limit_s
    with (
        tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name,
        bench_cluster(
            Path(name), workers=1, slots=slots, deadline_s=deadline_s, load_delay_s=delay_s
        ) as cluster,
    ):

        async def measure() -> Stepped:
            async with trainer_on(cluster, bundles, deadline_s - time.monotonic()) as trainer:
                return Stepped(await _take(trainer, stepping), await trainer.close())

        return asyncio.run(measure())


async def _take(trainer: BenchTrainer, stepping: Stepping) -> tuple[Pushed, ...]:
    taken = []
    numbered = dict(enumerate(stepping.steps))
    for number, rollouts in numbered.items():
        if stepping.lead >= 0:
            window = range(number, number + stepping.lead + 1)
            await trainer.announce({ahead: numbered[ahead] for ahead in window if ahead in numbered})
        await asyncio.sleep(stepping.pause_s)
        taken.append(await stepping.push(trainer, rollouts))
    return tuple(taken)
