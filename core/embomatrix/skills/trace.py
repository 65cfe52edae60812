"""Traces: the executed steps of a plan and the state reached, as data that travels with the result."""

from dataclasses import dataclass

from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import Plan, SkillCall


@dataclass(frozen=True, slots=True)
class Step:
    """One executed call.

    ``message`` tells people what happened, or why the call failed. ``blocker`` names the object at fault in a failure, as
    `SkillRefusal.blocker` defines it.
    """

    call: SkillCall
    failure: FailureReason | None
    message: str
    blocker: str = ""

    @property
    def ok(self) -> bool:
        return self.failure is None


@dataclass(frozen=True, slots=True)
class Trace:
    """Steps up to and including the first failure, and the state reached.

    ``touched`` are the names of the objects on which a call succeeded. ``final`` describes the task's objects, one line each.
    ``digest`` is a hash of every pose and state after every step: equal (bundle, plan, seed) on equal platforms give equal
    digests.
    """

    plan: Plan
    steps: tuple[Step, ...]
    touched: frozenset[str]
    final: tuple[str, ...]
    digest: str

    @property
    def failure(self) -> FailureReason | None:
        """Reason of the step that stopped the plan, None if every step succeeded."""
        return self.steps[-1].failure if self.steps else None
