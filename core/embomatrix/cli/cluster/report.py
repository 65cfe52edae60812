"""The report of a run: one HTML file with everything in it. It loads nothing and runs no script."""

import dataclasses
import string
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Final

from embomatrix.cli.cluster.charts import busy_chart, phase_chart, throughput_chart
from embomatrix.host.durations import seconds_text
from embomatrix.pages.head import page_head
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.timeline import busy_share, slot_spans
from embomatrix.rpc.wire.run_log import EventKind, PhaseSummary, RolloutPhase, RunEvent, RunSummary

STEPS: Final = 240
"""Points of the chart of busy slots."""
NONE: Final = "–"
PHASES: Final[Mapping[RolloutPhase, str]] = {
    RolloutPhase.QUEUE: "waited for a lease",
    RolloutPhase.LEASE: "network, and wait for a slot behind another rollout",
    RolloutPhase.LOAD: "waited for the scene to be loaded",
    RolloutPhase.EXECUTE: "in the slot",
    RolloutPhase.DELIVER: "from the result's arrival to the trainer's log",
}


def report_page(summary: RunSummary, events: Sequence[RunEvent]) -> str:
    """Return the page. ``events`` is the kept part of the run's log; counts and quantiles cover the whole run."""
    template = files("embomatrix.cli.cluster").joinpath("report.html").read_text(encoding="utf-8")
    run = summary.run
    return string.Template(template).substitute(
        head=page_head(f"{run.name or run.run_id} · EmboMatrix run"),
        title=escape(run.name or run.run_id),
        about=escape(_about(summary)),
        tiles=_tiles(summary),
        throughput=throughput_chart(summary.series),
        busy=_busy(summary, events),
        phases=phase_chart(summary.phases),
        phase_rows=_phase_rows(summary),
        prewarm_rows=_prewarm_rows(summary),
        worker_rows=_worker_rows(summary),
        failures=_failures(summary),
        kept=escape(_kept(summary, events)),
    )


def _about(summary: RunSummary) -> str:
    run = summary.run
    opened = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(run.opened_s))
    state = "closed" if run.closed_s else "still open"
    length = seconds_text(_length_s(summary))
    return (
        f"run {run.run_id} · opened {opened} · {length} · {state} · {_reward_text(run.reward)} · "
        f"EmboMatrix {summary.version}"
    )


def _reward_text(reward: RewardSettings) -> str:
    """Name the coefficients that differ from the paper's."""
    coefficients = dataclasses.asdict(reward)
    own = [
        f"{name} {coefficients[name]:g}"
        for name, usual in dataclasses.asdict(PAPER).items()
        if coefficients[name] != usual
    ]
    return f"reward: {', '.join(own)}, else the paper's" if own else "reward: the paper's"


def _length_s(summary: RunSummary) -> float:
    """Return the length of the run; of an open run, up to its last outcome."""
    if summary.run.closed_s:
        return summary.run.closed_s - summary.run.opened_s
    return len(summary.series.completed) * summary.series.step_s


def _tiles(summary: RunSummary) -> str:
    stats = summary.run.stats
    completed = sum(summary.series.completed)
    active_s = summary.series.step_s * sum(count > 0 for count in summary.series.completed)
    execute = summary.phases[RolloutPhase.EXECUTE]
    asked = stats.prewarm_hits + stats.prewarm_misses
    tiles = (
        (
            "Completed",
            f"{completed:,}",
            f"{stats.infra_failures:,} failed, {stats.redispatched:,} re-dispatch{'' if stats.redispatched == 1 else 'es'}",
        ),
        ("Throughput", f"{completed / active_s:,.0f}/s" if active_s else NONE, "while there was work"),
        ("Execute p50", seconds_text(execute.p50_s), f"p99 {seconds_text(execute.p99_s)}"),
        ("Prewarm hits", _share(stats.prewarm_hits, asked), f"{stats.prewarm_hits:,} of {asked:,} scenes"),
        (
            "Prewarm waste",
            _share(stats.prewarm_wasted, asked + stats.prewarm_wasted),
            f"{stats.prewarm_wasted:,} loads unused",
        ),
        (
            "Shared steps",
            _share(stats.shared_steps, stats.steps),
            f"{stats.shared_steps:,} of {stats.steps:,} were not executed",
        ),
        (
            "Manager overhead",
            NONE if summary.overhead is None else _share(summary.overhead, 1.0),
            "share of all CPU time, manager and slots",
        ),
    )
    return "".join(
        f'<section class="tile"><h2>{escape(name)}</h2><b>{escape(value)}</b><span>{escape(note)}</span></section>'
        for name, value, note in tiles
    )


def _share(part: float, whole: float) -> str:
    return f"{100 * part / whole:.3g} %" if whole else NONE


def _busy(summary: RunSummary, events: Sequence[RunEvent]) -> str:
    spans = slot_spans(events)
    if not spans:
        return '<p class="none">No rollout has run.</p>'
    length_s = max(_length_s(summary), 1e-3)
    step_s = length_s / STEPS
    return busy_chart(busy_share(spans, summary.run.opened_s, step_s, STEPS), step_s)


def _phase_rows(summary: RunSummary) -> str:
    whole_s = sum(found.sum_s for found in summary.phases.values())
    rows = []
    for phase in RolloutPhase:
        found = summary.phases[phase]
        quantiles = (found.p50_s, found.p95_s, found.p99_s)
        share = found.sum_s / whole_s if whole_s else 0.0
        cells = [escape(seconds_text(value)) for value in quantiles]
        name = f"{phase.value}<small>{escape(PHASES[phase])}</small>"
        rows.append(_row([name, *cells, _bar(share)], figures=3))
    return "".join(rows)


def _prewarm_rows(summary: RunSummary) -> str:
    stats = summary.run.stats
    rows = [
        ("scenes that were warm when their batch came", f"{stats.prewarm_hits:,}"),
        ("scenes that were not", f"{stats.prewarm_misses:,}"),
        ("loads ahead of demand that no rollout used", f"{stats.prewarm_wasted:,}"),
        ("rollouts that began warm", f"{stats.warm_starts:,}"),
        ("rollouts that waited for a scene", f"{stats.cold_starts:,}"),
        ("lead: warm before it was needed", _quantiles(summary.prewarm_lead)),
        ("loading a scene, on all workers", _quantiles(summary.scene_load)),
    ]
    return "".join(_row([escape(name), escape(value)], figures=1) for name, value in rows)


def _quantiles(found: PhaseSummary) -> str:
    if not found.count:
        return NONE
    return f"p50 {seconds_text(found.p50_s)}, p95 {seconds_text(found.p95_s)}"


def _worker_rows(summary: RunSummary) -> str:
    total_s = sum(worker.execute_s for worker in summary.workers)
    rows = []
    for worker in sorted(summary.workers, key=lambda worker: -worker.completed):
        mean = seconds_text(worker.execute_s / worker.completed) if worker.completed else NONE
        figures = (f"{worker.completed:,}", f"{worker.failed:,}", mean, seconds_text(worker.load_s))
        share = worker.execute_s / total_s if total_s else 0.0
        rows.append(_row([escape(worker.worker_id), *map(escape, figures), _bar(share)], figures=4))
    return "".join(rows) or '<tr><td colspan="6" class="none">No worker has finished anything.</td></tr>'


def _failures(summary: RunSummary) -> str:
    if not summary.failures:
        again = summary.run.stats.redispatched
        if again:
            times = "1 time" if again == 1 else f"{again:,} times"
            return (
                f'<p class="none">No lease failed. Rollouts were leased again {times}, because their workers left, drained '
                "or fell silent before they had a result.</p>"
            )
        return '<p class="none">None: every lease brought a result.</p>'
    codes = Counter(event.code for event in summary.failures)
    counts = ", ".join(f"{code} ({count})" for code, count in codes.most_common())
    alike: dict[tuple[object, ...], list[RunEvent]] = {}
    for event in reversed(summary.failures):
        cause = (event.kind, event.code, event.attempt, event.worker_id, event.bundle_digest, event.message)
        alike.setdefault(cause, []).append(event)
    rows = "".join(_failure_row(events[0], len(events)) for events in alike.values())
    names = ("latest (UTC)", "what", "reason", "attempt", "rollout", "worker", "scene")
    head = "".join(f"<th>{name}</th>" for name in names)
    table = f"<table><tr>{head}</tr>{rows}</table>"
    attempts = sum(event.kind is EventKind.FAILED for event in summary.failures)
    rollouts = len(summary.failures) - attempts
    kinds = [
        f"{count:,} failed {noun}{'' if count == 1 else 's'}"
        for count, noun in ((attempts, "lease"), (rollouts, "rollout"))
        if count
    ]
    latest = f"Latest: {' and '.join(kinds)}, with the reasons {counts}."
    return f'<p class="note">{escape(latest)}</p><div class="scroll">{table}</div>'


def _failure_row(event: RunEvent, count: int) -> str:
    """Return two rows: the latest of ``count`` failures of one cause, and its message."""
    what = "lease failed" if event.kind is EventKind.FAILED else "rollout given up"
    at = time.strftime("%H:%M:%S", time.gmtime(event.at_s))
    scene = event.bundle_digest.removeprefix("sha256:")[:8] or NONE
    rollout = event.rollout_id if count == 1 else f"{event.rollout_id} and {count - 1:,} more"
    words = (at, what, event.code, str(event.attempt), rollout, event.worker_id or NONE, scene)
    cells = "".join(f"<td>{escape(word)}</td>" for word in words)
    message = f'<tr class="words"><td colspan="{len(words)}">{escape(event.message)}</td></tr>'
    return f'<tr class="failure">{cells}</tr>{message}'


def _row(cells: Iterable[str], *, figures: int) -> str:
    """Return a table row of markup; the ``figures`` cells after the first are numbers."""
    return (
        "<tr>"
        + "".join(
            f'<td class="n">{cell}</td>' if 0 < at <= figures else f"<td>{cell}</td>"
            for at, cell in enumerate(cells)
        )
        + "</tr>"
    )


def _bar(share: float) -> str:
    return f'<div class="share"><div class="bar"><i style="width:{100 * share:.1f}%"></i></div><span>{share:.0%}</span></div>'


def _kept(summary: RunSummary, events: Sequence[RunEvent]) -> str:
    if not summary.events_dropped:
        return f"All {len(events):,} events of the run are kept."
    return (
        f"The latest {len(events):,} events are kept, {summary.events_dropped:,} earlier ones were dropped: busy slots are "
        f"known for the end of the run only; all other figures cover the whole run."
    )
