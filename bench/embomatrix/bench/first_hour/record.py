"""Record of the demo's seeds: success by task, cost and learning curve of each, bound to dataset, code and machine."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from pydantic import TypeAdapter

from embomatrix.bench.report.figures import BenchError
from embomatrix.pages.figures import Better, Figure, Interval
from embomatrix.trainer.evaluation.intervals import differences, over_seeds_and_tasks, paired_difference
from embomatrix.world.whole_file import write_whole

RECORD: Final = Path(__file__).parents[1] / "data" / "first_hour.json"
"""Seeds that were recorded for the package."""
LEAST_GAIN: Final = 0.08
"""Goal of the smallest lower bound of the gain over imitation that goes on."""
MOST_MINUTES: Final = 15.0


@dataclass(frozen=True, slots=True)
class Arm:
    """One training run. ``rates``: success by held-out task. ``core_s``: CPU seconds of all its processes."""

    rates: Mapping[str, float]
    imitation_steps: int
    grpo_steps: int
    wall_s: float
    core_s: float


@dataclass(frozen=True, slots=True)
class SeedRun:
    """Seed of the demo: with GRPO, and with imitation that goes on for as long. ``curve`` is a digest of GRPO's figures."""

    seed: int
    dataset: str
    commit: str
    platform: str
    curve: str
    imitated: Mapping[str, float]
    trained: Arm
    continued: Arm

    @property
    def gain(self) -> Interval:
        """Success with GRPO minus success with continued imitation, paired by task, with its 95 % interval over tasks."""
        return paired_difference(self.continued.rates, self.trained.rates)

    @property
    def gains(self) -> Mapping[str, float]:
        """The same difference of each task."""
        return differences(self.continued.rates, self.trained.rates)


def add_to_record(path: Path, seeds: Sequence[SeedRun]) -> Sequence[SeedRun]:
    """Add seeds to those in a file, and return all in their order. Raise OSError, and BenchError for those of other tasks."""
    kept = read_record(path)
    datasets = sorted({seed.dataset for seed in (*kept, *seeds)})
    if len(datasets) > 1:
        raise BenchError(
            f"the seeds in {path} and the new ones are of different datasets ({', '.join(datasets)}): name another file with "
            "--record"
        )
    merged = {seed.seed: seed for seed in (*kept, *seeds)}
    ordered = [merged[number] for number in sorted(merged)]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, (json.dumps([asdict(seed) for seed in ordered], indent=1) + "\n").encode("ascii"))
    return ordered


def read_record(path: Path = RECORD) -> tuple[SeedRun, ...]:
    """Read what `add_to_record` wrote; none if there is no file. Raise BenchError for any other content."""
    if not path.exists():
        return ()
    try:
        return TypeAdapter(tuple[SeedRun, ...]).validate_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise BenchError(
            f"{path} is no record of the demo's seeds ({error}): remove it, and run `embomatrix bench first-hour --seeds 10`"
        ) from error


def figures_of(seeds: Sequence[SeedRun]) -> tuple[Figure, ...]:
    """Return the gain with its interval over seeds and tasks, success of each arm, and the longest time.

    ``demo_gain_lower_min`` is the smallest lower bound of one seed's interval over tasks. Raise BenchError for no seed.
    """
    if not seeds:
        raise BenchError(
            "no seed of the demo has run: expected at least one; run `embomatrix bench first-hour`"
        )
    count = len(seeds)
    tasks = len(seeds[0].trained.rates)
    gain = over_seeds_and_tasks([seed.gains for seed in seeds])

    def success(name: str, arms: Sequence[Mapping[str, float]]) -> Figure:
        rates = [rate for arm in arms for rate in arm.values()]
        return Figure(
            f"demo_success {name}", 100 * sum(rates) / len(rates), "%", Better.NEITHER, count * tasks
        )

    return (
        Figure(
            "demo_gain_lower_min", min(seed.gain.low for seed in seeds), "", Better.HIGHER, count, LEAST_GAIN
        ),
        Figure("demo_gain", gain.value, "", Better.NEITHER, count),
        Figure("demo_gain_low", gain.low, "", Better.NEITHER, count),
        Figure("demo_gain_high", gain.high, "", Better.NEITHER, count),
        success("after imitation", [seed.imitated for seed in seeds]),
        success("imitation continued", [seed.continued.rates for seed in seeds]),
        success("after GRPO", [seed.trained.rates for seed in seeds]),
        Figure(
            "demo_minutes",
            max(seed.trained.wall_s for seed in seeds) / 60,
            "min",
            Better.LOWER,
            count,
            MOST_MINUTES,
        ),
        Figure(
            "demo_cpu_time_ratio, continued imitation to GRPO",
            min(seed.continued.core_s / seed.trained.core_s for seed in seeds),
            "x",
            Better.NEITHER,
            count,
        ),
    )


def comparison(recorded: SeedRun, repeated: SeedRun) -> str:
    """Say in a sentence if a repeated seed is the recorded one."""
    now, then = (
        100 * sum(run.trained.rates.values()) / len(run.trained.rates) for run in (repeated, recorded)
    )
    figures = f"seed {repeated.seed}: success {now:.1f} % after GRPO, recorded {then:.1f} %"
    if recorded.dataset != repeated.dataset:
        return f"{figures}; the record is about other tasks ({recorded.dataset}, here {repeated.dataset})"
    if recorded.curve == repeated.curve:
        return f"{figures}; the learning curve is the recorded one, number by number"
    if recorded.platform == repeated.platform:
        return f"{figures}; the learning curve is another, on the same platform: the code changed since {recorded.commit}"
    return f"{figures}; the platform is another ({recorded.platform}, here {repeated.platform}), so the curve may differ"
