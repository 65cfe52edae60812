"""Story of a run in sentences, from its totals and its trainer's reports."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from typing import Final

from embomatrix.host.durations import seconds_text
from embomatrix.manager.observe.run_totals import ENDS, working_s
from embomatrix.manager.observe.training_reports import Curves, TrainingDetail
from embomatrix.rpc.wire.run_log import EventKind, RolloutPhase, RunSummary

FEWEST_STEPS: Final = 2
"""Steps from which a curve has two ends."""
PHASES: Final = {
    RolloutPhase.QUEUE: "waiting for a lease",
    RolloutPhase.LEASE: "on the network and behind other rollouts of the same slot",
    RolloutPhase.LOAD: "loading scenes",
    RolloutPhase.EXECUTE: "executing plans",
    RolloutPhase.DELIVER: "writing results",
}


def run_story(summary: RunSummary, training: TrainingDetail | None = None) -> list[str]:
    """Return sentences about a run: its time, outcomes, speed, scenes, and what its policy learned."""
    parts = (_time(summary), _outcomes(summary), _speed(summary), _scenes(summary), _learning(training))
    return [sentence for part in parts for sentence in part]


def _time(summary: RunSummary) -> Iterator[str]:
    run = summary.run
    name = f"The run {run.name or run.run_id}"
    if run.closed_s:
        yield (
            f"{name} was open from {_clock(run.opened_s)} to {_clock(run.closed_s)}, "
            f"for {seconds_text(run.closed_s - run.opened_s)}."
        )
    else:
        yield f"{name} has been open since {_clock(run.opened_s)}; {_pending(run.pending)}."
    if run.waits_for:
        yield f"No connected worker can execute some of its rollouts: {run.waits_for}."


def _outcomes(summary: RunSummary) -> Iterator[str]:
    stats, completed = summary.run.stats, sum(summary.series.completed)
    if not completed and not stats.infra_failures:
        yield "No rollout has an outcome."
        return
    workers = _counted(sum(worker.completed > 0 for worker in summary.workers), "worker")
    failed = stats.infra_failures
    ending = (
        f"; {_counted(failed, 'rollout')} ended in an infrastructure failure" if failed else "; none failed"
    )
    yield f"{workers} completed {_counted(completed, 'rollout')}{ending}."
    # A rollout whose scene does not load ends without an attempt.
    attempts = [event for event in summary.failures if event.kind is EventKind.FAILED]
    found, noun = (attempts, "attempt") if attempts else (summary.failures, "rollout")
    codes = Counter(event.code for event in found if event.code).most_common(1)
    if codes:
        code, count = codes[0]
        yield (
            f"One {noun} failed, with the reason {code}."
            if len(found) == 1
            else f"Of the latest {len(found):,} failed {noun}s, {count:,} had the reason {code}."
        )
    if stats.redispatched:
        yield (
            f"Rollouts were re-dispatched {_counted(stats.redispatched, 'time')}, after a lease that failed, expired or was "
            "withdrawn."
        )


def _speed(summary: RunSummary) -> Iterator[str]:
    completed, busy_s = sum(summary.series.completed), working_s(summary)
    execute = summary.phases.get(RolloutPhase.EXECUTE)
    if completed and busy_s:
        median = f" Half of them executed within {seconds_text(execute.p50_s)}" if execute else ""
        slowest = f", 99 % within {seconds_text(execute.p99_s)}." if execute else ""
        yield (
            f"While there was work, {completed / busy_s:,.1f} rollouts were completed per second.{median}{slowest}"
        )
    whole_s = sum(found.sum_s for found in summary.phases.values())
    if whole_s:
        phase, longest = max(summary.phases.items(), key=lambda entry: entry[1].sum_s)
        yield f"Most of a rollout's time, {longest.sum_s / whole_s:.0%}, passed {PHASES[phase]}."
    if summary.run.stats.shared_steps:
        yield f"{summary.run.stats.shared_share:.0%} of the steps were known from other plans and not executed."


def _scenes(summary: RunSummary) -> Iterator[str]:
    stats = summary.run.stats
    asked = stats.prewarm_hits + stats.prewarm_misses
    if not asked:
        return
    wasted = f"; {_counted(stats.prewarm_wasted, 'loaded scene')} had no use" if stats.prewarm_wasted else ""
    if asked == 1:
        whether = "was" if stats.prewarm_hits else "was not"
        yield f"Its scene {whether} loaded before the batch came{wasted}."
    else:
        yield f"{stats.prewarm_hits:,} of {asked:,} scenes were loaded before their batch came{wasted}."


def _learning(training: TrainingDetail | None) -> Iterator[str]:
    if training is None or not training.phases:
        return
    phases = {curves.phase: curves for curves in training.phases}
    steps = ", ".join(
        f"{_counted(curves.last_step, 'step')} of {name.replace('grpo', 'GRPO')}"
        for name, curves in phases.items()
        if not name.startswith("success ") and curves.steps
    )
    if steps:
        yield f"Its trainer reported {steps}."
    if "grpo" in phases:
        yield from _ends(phases["grpo"])
    held_out = [phases.get(f"success {when} GRPO") for when in ("before", "after")]
    values = [curves.latest("all", 1) if curves else None for curves in held_out]
    if None not in values:
        before, after = values
        yield f"Success on held-out tasks was {before:.0%} before GRPO and {after:.0%} after it."


def _ends(curves: Curves) -> Iterator[str]:
    """Yield the first and last means of reward and success."""
    for name, words, style in (("reward", "The mean reward", ",.2f"), ("success", "Success", ".0%")):
        values = [value for value in curves.figures.get(name, ()) if value is not None]
        ends = min(ENDS, len(values) // 2)
        if len(values) >= FEWEST_STEPS:
            first, last = sum(values[:ends]) / ends, sum(values[-ends:]) / ends
            where = "step" if ends == 1 else f"{ends} steps"
            yield f"{words} was {first:{style}} in the first {where} and {last:{style}} in the last."


def _pending(count: int) -> str:
    return "1 rollout waits or runs" if count == 1 else f"{count:,} rollouts wait or run"


def _clock(at_s: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(at_s))


def _counted(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"
