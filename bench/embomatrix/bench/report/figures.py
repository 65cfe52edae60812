"""Result of a benchmark: figures with their goals, the machine and the commit they were measured on."""

import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import psutil

from embomatrix.host.limits import MIB, usable_cores
from embomatrix.pages.figures import Better, Figure, figure_from_json, figure_to_json
from embomatrix.worker.host.gpu import find_gpu
from embomatrix.worker.host.resources import measure_score, versions

RESULT_MARK: Final = b'"bench": '
"""Part of the first bytes of each file of a result."""
BUSY_SHARE: Final = 0.25
"""Load of a core above which a machine counts as shared before a benchmark begins."""


class BenchError(Exception):
    """Benchmark that can't be run or has no result. The message names the remedy."""


@dataclass(frozen=True, slots=True)
class BenchResult:
    """Result of one benchmark. ``machine`` describes the machine as JSON-serialisable values."""

    bench: str
    commit: str
    machine: Mapping[str, Any]
    figures: tuple[Figure, ...]


def result_to_json(result: BenchResult) -> dict[str, Any]:
    """JSON-serialisable dict; numbers have six digits."""
    return {
        "bench": result.bench,
        "commit": result.commit,
        "machine": dict(result.machine),
        "figures": [figure_to_json(figure) for figure in result.figures],
    }


def read_result(path: Path) -> BenchResult:
    """Read a file that `embomatrix bench NAME --json` wrote. Raise BenchError if it is none."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
        machine = dict(value["machine"])
        float(machine["load_before"]), float(machine["cores"])
        figures = tuple(figure_from_json(item) for item in value["figures"])
        return BenchResult(str(value["bench"]), str(value["commit"]), machine, figures)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise BenchError(
            f"{path} holds no figures of a benchmark ({error}): expected a file that 'embomatrix bench NAME --json' wrote"
        ) from error


def merge_parts(results: Sequence[BenchResult]) -> list[BenchResult]:
    """Merge results of one benchmark that was measured in parts; the later figure of a name counts.

    Raise BenchError if parts of a benchmark were measured at different commits.
    """
    whole: dict[str, BenchResult] = {}
    for result in results:
        before = whole.get(result.bench, result)
        if before.commit != result.commit:
            raise BenchError(
                f"the files of benchmark {result.bench!r} are of the commits {before.commit} and {result.commit}: "
                "expected one commit; measure again"
            )
        figures = {figure.name: figure for figure in (*before.figures, *result.figures)}
        busiest = max((before.machine, result.machine), key=lambda machine: float(machine["load_before"]))
        whole[result.bench] = BenchResult(result.bench, result.commit, busiest, tuple(figures.values()))
    return list(whole.values())


def quantile(values: Sequence[float], share: float) -> float:
    """Value below which ``share`` of the measurements lie. Raise BenchError if there are none."""
    if not values:
        raise BenchError("nothing was measured: expected a workload with at least one plan")
    return float(np.quantile(np.asarray(values), share))


def quantile_figure(
    name: str, seconds: Sequence[float], share: float, unit: str, goal: float | None = None
) -> Figure:
    """Quantile of durations in ``unit``: "ms" or "µs"."""
    value = quantile(seconds, share) * {"ms": 1e3, "µs": 1e6}[unit]
    return Figure(f"{name}, p{share * 100:.0f}", value, unit, Better.LOWER, len(seconds), goal)


def describe_machine() -> dict[str, Any]:
    """Describe this machine and its load before the benchmark begins."""
    gpu = find_gpu().name
    return {
        "cpu": _cpu_model(),
        "cores": usable_cores(),
        "memory_gb": round(psutil.virtual_memory().total / MIB / 1024, 1),
        "gpu": gpu,
        "system": f"{platform.system()} {platform.machine()}",
        "speed": measure_score(),
        "load_before": round(os.getloadavg()[0], 2),
        **{name: text for name, text in versions().items() if name != "embomatrix"},
    }


def is_shared(machine: Mapping[str, Any]) -> bool:
    """Return whether the machine was busy before the benchmark began."""
    return bool(machine["load_before"] > BUSY_SHARE * machine["cores"])


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.processor() or "unknown")
