"""How a cluster does, in one sentence: the first thing that is wrong, or that all is well."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from embomatrix.manager.observe.meter import FAILURES_KEPT

if TYPE_CHECKING:
    from embomatrix.manager.web.views import Overview

RECENT_S: Final = 300.0
"""A failure concerns an operator for so long."""
MANY: Final = 0.2
"""More than this share of the workers lost comes before all that follows from it: the bound of the alarm, too …"""
FEWEST: Final = 3
"""… from so many on."""


class Mood(StrEnum):
    """How much somebody should care."""

    GOOD = "good"
    IDLE = "idle"
    WARNING = "warning"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Health:
    """How the cluster does, in a word and in a sentence."""

    mood: Mood
    sentence: str


def health(seen: Overview, *, paused: bool, now_s: float) -> Health:
    """What an operator would want to hear first. ``now_s`` is wall time, as that of the failures."""
    working = seen.workers.get("ready", 0) + seen.workers.get("suspect", 0)
    if seen.store:
        return Health(Mood.BAD, f"Nothing can be written down, so nothing goes on: {seen.store}.")
    if paused:
        return Health(Mood.WARNING, "Dispatch is paused: nothing new is executed until somebody resumes it.")
    # Who left in order is nobody's trouble, unless nobody else is there.
    every = sum(seen.workers.values()) - seen.workers.get("left", 0)
    if not every:
        return _deserted(seen)
    if not working:
        return Health(Mood.BAD, f"None of {every} workers works.")
    if lost := seen.workers.get("quarantined", 0):
        return Health(Mood.BAD, f"{_workers(lost)} in quarantine: results did not agree with others'.")
    gone = seen.workers.get("lost", 0)
    if gone >= FEWEST and gone > MANY * every:
        return Health(
            Mood.BAD, f"{gone} of {every} workers were lost a moment ago; what they held went to others."
        )
    return _of_work(seen, working, now_s)


def _deserted(seen: Overview) -> Health:
    if seen.queued:
        return Health(Mood.BAD, f"{seen.queued} rollouts wait, and no worker is there.")
    return Health(Mood.IDLE, "Every worker has left." if seen.workers else "No worker has joined yet.")


def _of_work(seen: Overview, working: int, now_s: float) -> Health:
    """Where most workers are well: what goes wrong with rollouts, or that nothing does."""
    recent = [note for note in seen.failures if now_s - note.at_s < RECENT_S]
    if recent:
        # The meter keeps no more of them.
        count = f"{len(recent)} or more" if len(recent) == FAILURES_KEPT else f"{len(recent)}"
        were, of = ("rollout was", "") if len(recent) == 1 else ("rollouts were", "the last ")
        return Health(
            Mood.WARNING,
            f"{count} {were} given up in the last {RECENT_S / 60:.0f} minutes, {of}for {recent[0].code}.",
        )
    if stuck := seen.unplaceable:
        what = "1 announced scene" if stuck == 1 else f"{stuck} announced scenes"
        return Health(Mood.WARNING, f"No worker can hold {what}: the look-ahead page says why.")
    if lost := seen.workers.get("lost", 0):
        return Health(
            Mood.WARNING,
            f"{_workers(lost)} lost a moment ago; what {'it' if lost == 1 else 'they'} held went to others.",
        )
    if seen.queued and not seen.leased:
        return Health(Mood.WARNING, f"{seen.queued} rollouts wait and none runs: no scene is warm yet.")
    if not seen.runs:
        return Health(
            Mood.IDLE, f"Ready: {_workers(working)} {'waits' if working == 1 else 'wait'} for a run."
        )
    return Health(Mood.GOOD, "All is well.")


def _workers(count: int) -> str:
    return f"{count} worker{'' if count == 1 else 's'}"
