"""Calls of a plan under construction: each call is executed, and kept if it succeeds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.skills.check import within_reach
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.library import NO_PLACE
from embomatrix.skills.syntax import MAX_STEPS, PlaceRelation, Plan, Skill, SkillCall
from embomatrix.skills.trace import Step
from embomatrix.world.task import Task

if TYPE_CHECKING:
    from embomatrix.sim.executor import Simulator

NEIGHBOURS: Final = 6
"""Neighbours of an object to try as standing places when the object's own standing poses do not serve."""
OUT_OF_ARM: Final = frozenset(
    {
        FailureReason.NO_STANDING_POSE,
        FailureReason.NO_PATH,
        FailureReason.OUT_OF_REACH,
        FailureReason.NO_LINE_OF_APPROACH,
    }
)
"""Failures that another standing place may avoid."""


class StuckError(Exception):
    """Raised when a routine can't continue. The message names the call and the reason."""


class TooLongError(StuckError):
    """Raised when the plan has more steps than a simulator executes."""


class PlanCalls:
    """Calls of one attempt at a task. A failed call is reported to the caller and left out of the plan.

    Every method raises StuckError if a call names an object outside the table, or if the plan grows too long. A ``thrifty``
    plan contains no move to an object that is already in reach.
    """

    def __init__(self, simulator: Simulator, task: Task, *, thrifty: bool = False) -> None:
        """Begin in the simulator's present state."""
        self._simulator = simulator
        self._world = simulator.world
        self._task = task
        self._thrifty = thrifty
        self._at = ""
        self._calls: list[SkillCall] = []

    @property
    def plan(self) -> Plan:
        """Calls so far. Of consecutive moves only the last is kept, and none at the end."""
        pairs = zip(self._calls, [*self._calls[1:], None], strict=True)
        return tuple(
            call
            for call, following in pairs
            if call.skill is not Skill.MOVE or (following is not None and following.skill is not Skill.MOVE)
        )

    def place(self, target: str, relation: PlaceRelation) -> Step:
        """Place the held object. If there is no free pose within reach, try from beside neighbours of the target too."""
        call = self._call(Skill.PLACE, target, relation)
        step = self.use(Skill.PLACE, target, relation)
        if step.failure in NO_PLACE:
            for other in self._neighbours(target):
                again = self._from_beside(other, call, target)
                if again is not None and again.ok:
                    return again
        return step

    def use(self, skill: Skill, name: str, relation: PlaceRelation | None = None) -> Step:
        """Use the object from its own standing pose, else from beside a neighbour."""
        return self._attempt(self._call(skill, name, relation), name)

    def use_on(self, skill: Skill, name: str, source: str, at: str) -> Step:
        """Use a source or a tool on an object, from beside ``at``."""
        return self._attempt(self._call(skill, name, source=source), at)

    def _attempt(self, call: SkillCall, name: str) -> Step:
        if self._stands_at(name):
            return self._run(call)
        step = self._go_to(name)
        step = self._run(call) if step.ok else step
        if step.failure in OUT_OF_ARM:
            for other in self._neighbours(name):
                again = self._from_beside(other, call, name)
                if again is not None:
                    return again
        return step

    def _from_beside(self, other: str, call: SkillCall, name: str) -> Step | None:
        """Run a call about ``name`` from beside another object; None if the robot can't stand there or reach from there."""
        if self._go_to(other).ok and within_reach(self._world, name) is None:
            return self._run(call)
        return None

    def _neighbours(self, name: str) -> list[str]:
        """Return the rows nearest to an object."""
        x, y, _ = self._world.relations.body(name).center_m

        def squared_distance(other: str) -> float:
            ox, oy, _ = self._world.relations.body(other).center_m
            return (ox - x) ** 2 + (oy - y) ** 2

        others = [item for item in self._task.table if item != name and item not in self._world.carried]
        return sorted(others, key=squared_distance)[:NEIGHBOURS]

    def _go_to(self, name: str) -> Step:
        step = self._run(self._call(Skill.MOVE, name))
        if step.ok:
            self._at = name
        return step

    def _stands_at(self, name: str) -> bool:
        """True if the object is in reach and the plan need not move: thrifty, or just sent to it or to its container."""
        inside = self._world.relations.inside
        sent = (
            self._thrifty
            or name == self._at
            or (self._at and (inside(name, self._at) or inside(self._at, name)))
        )
        return bool(sent) and within_reach(self._world, name) is None

    def _call(
        self, skill: Skill, name: str, relation: PlaceRelation | None = None, source: str = ""
    ) -> SkillCall:
        return SkillCall(
            skill,
            object_index=self._row(name),
            source_index=self._row(source) if source else None,
            relation=relation,
        )

    def _row(self, name: str) -> int:
        row = self._task.index_of.get(name)
        if row is None:
            raise StuckError(f"{name} is not in the object table: no plan can name it")
        return row

    def _run(self, call: SkillCall) -> Step:
        """Execute a call and add it to the plan if it succeeds."""
        step = self._simulator.run_step(call)
        if step.ok:
            self._calls.append(call)
            if len(self.plan) > MAX_STEPS:
                raise TooLongError(f"the plan needs more than {MAX_STEPS} steps")
        return step
