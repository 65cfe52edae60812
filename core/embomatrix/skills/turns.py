"""Turns of a closed-loop episode: the prefix that a turn builds on, and the observation that it gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from embomatrix.skills.syntax import MAX_STEPS

if TYPE_CHECKING:
    from embomatrix.skills.syntax import Plan
    from embomatrix.skills.trace import Step


class PrefixMismatchError(Exception):
    """Prefix that another execution does not reproduce: other failures, or another digest."""


class EpisodeOverError(ValueError):
    """More calls than one episode may have."""


@dataclass(frozen=True, slots=True)
class EpisodePrefix:
    """The first ``length`` calls of a plan, which the episode has made before, and what the client knows about them."""

    length: int = 0
    failed: tuple[int, ...] = ()
    """Indices of the calls that failed, rising. The episode went on after them."""
    digest: str = ""
    """Digest of the episode after these calls; empty if unknown, which is not checked."""

    def check(self, steps: Sequence[Step], digest: str) -> None:
        """Raise PrefixMismatchError unless these steps of the prefix, and the digest after them, are the expected ones."""
        for index, step in enumerate(steps):
            if step.ok == (index in self.failed):
                expected, found = ("to fail", "it succeeds") if step.ok else ("to succeed", "it fails")
                reason = "" if step.failure is None else f" ({step.failure}: {step.message})"
                raise PrefixMismatchError(
                    f"call {index} of the prefix, {step.call.skill}: expected {expected} as recorded, found that {found}"
                    f"{reason}; begin the episode again"
                )
        if self.digest not in ("", digest):
            raise PrefixMismatchError(
                f"the digest after {self.length} calls of the prefix: expected {self.digest[:100]!r}, found {digest!r}; "
                "the platforms or releases of two workers differ, or the calls do: begin the episode again"
            )

    def after(self, steps: Sequence[Step], digest: str) -> EpisodePrefix:
        """Return the prefix that these further steps and the digest after them lead to."""
        failed = (self.length + index for index, step in enumerate(steps) if not step.ok)
        return replace(self, length=self.length + len(steps), failed=(*self.failed, *failed), digest=digest)


@dataclass(frozen=True, slots=True)
class Advice:
    """Advice of the oracle, which sees the goal and the whole state: how it would go on from here."""

    plan: Plan = ()
    """Calls that reach the goal; none if it holds, or if no plan was found."""
    problem: str = ""
    """Sentence about why no plan was found; empty if one was, or if the goal holds."""


@dataclass(frozen=True, slots=True)
class TurnObservation:
    """State that a turn leads to, in words. The outcome of each call is in the turn's steps."""

    room: str
    """Room of the robot; empty between rooms."""
    held: tuple[str, ...]
    """Object in the robot's hand, then its contents; empty for an empty hand."""
    changes: tuple[str, ...]
    """One line for each object of the task's table that the turn has changed or moved, in the table's order."""
    looked: bool = False
    """True in episodes with sight: ``sees`` is set."""
    sees: tuple[int, ...] = ()
    """Rows of the task's table that the robot sees, rising."""
    advice: Advice | None = None
    """The oracle's advice, in a turn that asked for it. No part of what a policy is told."""


def check_length(prefix: Plan, calls: Plan, *, only_looks: bool = False) -> None:
    """Raise EpisodeOverError unless an episode may go on with these calls. A turn that ``only_looks`` may have none."""
    if not calls and not only_looks:
        raise EpisodeOverError("a turn has no call: expected at least one skill call")
    if len(prefix) + len(calls) > MAX_STEPS:
        raise EpisodeOverError(
            f"the episode has {len(prefix)} calls, and {len(calls)} more are too many: expected at most {MAX_STEPS} in all; "
            "begin another episode"
        )
