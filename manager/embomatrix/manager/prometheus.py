"""The metrics page, in Prometheus' text format. No label ever carries an id of a run, rollout or scene."""

from __future__ import annotations

from collections import Counter
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from embomatrix.manager.histogram import BOUNDS_S
from embomatrix.manager.registry import Standing
from embomatrix.manager.views import overview
from embomatrix.rpc.values import InfraCode, ResidentState

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.manager.histogram import Histogram
    from embomatrix.manager.runtime import ManagerRuntime
    from embomatrix.rpc.run_log import Phase


class _Page:
    """Lines of the page, one family after the other."""

    def __init__(self) -> None:
        self._lines: list[str] = []

    def family(self, name: str, kind: str, text: str, values: Mapping[str, float]) -> None:
        """One metric; ``values`` by label set as it stands between the braces, "" for none."""
        self._lines += [f"# HELP {name} {text}", f"# TYPE {name} {kind}"]
        self._lines += [
            f"{name}{{{labels}}} {value:g}" if labels else f"{name} {value:g}"
            for labels, value in values.items()
        ]

    def histogram(self, name: str, text: str, phases: Mapping[Phase, Histogram]) -> None:
        self._lines += [f"# HELP {name} {text}", f"# TYPE {name} histogram"]
        for phase, histogram in phases.items():
            for bound_s, total in zip(BOUNDS_S, histogram.cumulative(), strict=True):
                self._lines.append(f'{name}_bucket{{phase="{phase}",le="{bound_s:.6g}"}} {total}')
            self._lines.append(f'{name}_bucket{{phase="{phase}",le="+Inf"}} {histogram.count}')
            self._lines.append(f'{name}_sum{{phase="{phase}"}} {histogram.sum_s:g}')
            self._lines.append(f'{name}_count{{phase="{phase}"}} {histogram.count}')

    def text(self) -> str:
        return "\n".join(self._lines) + "\n"


def metrics_page(runtime: ManagerRuntime) -> str:
    """What Prometheus scrapes."""
    view, page = overview(runtime), _Page()
    states = {f'state="{s.value}"': float(view.workers.get(s.value, 0)) for s in Standing}
    outcomes = ("completed", "cancelled", *(code.value for code in InfraCode))
    page.family("embo_build_info", "gauge", "Version of the manager.", {f'version="{_version()}"': 1})
    page.family("embo_workers", "gauge", "Workers by state.", states)
    slots = {'state="busy"': view.slots_busy, 'state="idle"': view.slots - view.slots_busy}
    page.family("embo_slots", "gauge", "Slots of connected workers.", slots)
    page.family("embo_residents", "gauge", "Scenes on workers by state.", _resident_states(runtime))
    page.family("embo_queue_depth", "gauge", "Rollouts that wait for a lease.", {"": view.queued})
    page.family("embo_leases", "gauge", "Live leases.", {"": view.leased})
    page.family("embo_runs", "gauge", "Open runs.", {"": view.runs})
    page.family(
        "embo_rollouts_total",
        "counter",
        "Rollouts by outcome.",
        {f'outcome="{name}"': view.outcomes.get(name, 0) for name in outcomes},
    )
    page.histogram("embo_rollout_seconds", "Time of completed rollouts by phase.", runtime.chronicle.phases())
    lead = {"": view.prewarm_lead_s}
    page.family(
        "embo_prewarm_lead_seconds", "gauge", "Median time between a scene being warm and its demand.", lead
    )
    for name, text, value in (
        ("embo_prewarm_hits_total", "Scenes that were warm when their batch came.", view.prewarm_hits),
        (
            "embo_prewarm_misses_total",
            "Scenes that were not warm when their batch came.",
            view.prewarm_misses,
        ),
        ("embo_prewarm_wasted_total", "Loads ahead of demand that were never used.", view.prewarm_wasted),
        ("embo_redispatched_total", "Leases that were given again.", view.redispatched),
        ("embo_stale_results_total", "Late results that were fenced off.", view.stale_results),
    ):
        page.family(name, "counter", text, {"": value})
    return page.text()


def _resident_states(runtime: ManagerRuntime) -> dict[str, float]:
    scheduler = runtime.cluster.scheduler
    states = Counter(r.state for name in runtime.registry.sessions for r in scheduler.residents(name))
    return {f'state="{state.value}"': float(states[state]) for state in ResidentState}


def _version() -> str:
    try:
        return version("embomatrix")
    except PackageNotFoundError:
        return "unknown"
