"""Plans written while they are executed: household routines that emit the skill calls which the present state needs.

A routine goes to a thing before it uses it, unless the robot was just sent to that thing or to the container that it
lies in. So whether a plan has a move follows from what the plan says, not from distances that no planner is told: but for
plans that would be too long otherwise.
A call that fails changes nothing and is left out of the plan: where there is a remedy, the routine takes it and tries again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.sim.planner.calls import PlanCalls, StuckError
from embomatrix.skills.appliances import cold_source, heat_source, starts_closed
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import PlaceRelation, Skill
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterator

    from embomatrix.sim.executor import Simulator
    from embomatrix.sim.planner.wishes import GoalLiterals
    from embomatrix.skills.syntax import Plan
    from embomatrix.skills.trace import Step
    from embomatrix.world.task import Task

DEPTH: Final = 8
"""Things that are taken off, out of or from before one another at most before the last of them is moved."""
SURFACES_TRIED: Final = 8
"""Surfaces that are tried for a thing that is in the way."""
BLOCKERS: Final = 3
"""Things that are taken from before a door at most."""


class PlanScript:
    """One attempt at a task, from its start. Every routine raises StuckError when a call of it fails for good."""

    def __init__(
        self, simulator: Simulator, task: Task, seed: int, wishes: GoalLiterals, *, thrifty: bool = False
    ) -> None:
        """A ``thrifty`` attempt goes nowhere for what is in reach already."""
        self._calls = PlanCalls(simulator, task, seed, thrifty=thrifty)
        self._world = simulator.world
        self._task = task
        self._wishes = wishes

    @property
    def plan(self) -> Plan:
        """The calls so far. Of several moves in a row the last is kept, and none at the end."""
        return self._calls.plan

    @property
    def rows(self) -> tuple[str, ...]:
        """The task's object table."""
        return self._task.table

    def transfer(
        self, name: str, target: str, relation: PlaceRelation, depth: int = 0, *, near: str = ""
    ) -> None:
        """Carry an object to its place, beside ``near`` if can be. What must be open is opened while the hand is empty.

        When there is no room, other things are taken from the place first, as long as there are any.
        """
        while True:
            self._prepare(target, relation)
            self._take(name, depth)
            step = self._calls.place(target, relation, near)
            if step.ok or (
                step.failure is FailureReason.NO_FREE_POSE and self._piled(name, target, relation)
            ):
                return
            burden = self._in_the_way_at(target, relation, name)
            if step.failure is not FailureReason.NO_FREE_POSE or not burden or depth == DEPTH:
                raise StuckError(_sentence(step))
            self._set_down(name, frozenset((name, target)))
            self.put_away(burden, frozenset((burden, name, target)), depth + 1)

    def _piled(self, name: str, target: str, relation: PlaceRelation) -> bool:
        """Whether what the hand holds could be put on something that lies in the target, and so lies in it as well."""
        if relation is not PlaceRelation.INSIDE:
            return False
        for other in self._task.table:
            lies_there = other != name and self._world.relations.inside(other, target)
            if lies_there and self._calls.use(Skill.PLACE, other, PlaceRelation.ONTOP).ok:
                if self.holds(Relation.INSIDE, name, target):
                    return True
                self._take(name, DEPTH)
        return False

    def open(self, name: str, depth: int = 0) -> None:
        """Open it, unless it is open. An appliance that must be closed while it runs is switched off first."""
        if self._world.is_open(name):
            return
        self.clear_way_to(name)
        if self._world.is_on(name) and starts_closed(self._world.asset(name)):
            self.switch_off(name)
        self._swing(Skill.OPEN, name, depth)

    def close(self, name: str, depth: int = 0) -> None:
        """Close it, unless it is closed."""
        if self._world.is_open(name):
            self.clear_way_to(name)
            self._swing(Skill.CLOSE, name, depth)

    def switch_on(self, name: str) -> None:
        """Switch it on, unless it is on, closed if it must be."""
        if self._world.is_on(name):
            return
        self.clear_way_to(name)
        if starts_closed(self._world.asset(name)):
            self.close(name)
        self._use(Skill.TOGGLE_ON, name)

    def switch_off(self, name: str) -> None:
        """Switch it off, unless it is off."""
        if self._world.is_on(name):
            self.clear_way_to(name)
            self._use(Skill.TOGGLE_OFF, name)

    def put_away(self, name: str, avoid: frozenset[str], depth: int = 0) -> None:
        """Carry an object to the first surface with room that is none of ``avoid``; those of its own room come first."""
        if not any(self._surfaces(name, avoid)):
            raise StuckError(f"there is no free surface in the object table to put {name} on")
        self._take(name, depth)
        self._set_down(name, avoid)

    def holds(self, relation: Relation, a: str, b: str) -> bool:
        """Whether the relation holds in the state reached."""
        return self._world.relations.holds(relation, a, b)

    def take(self, name: str) -> None:
        """Take an object into the hand, unless it is there."""
        if name not in self._world.carried[:1]:
            self._take(name, 0)

    def lay_down(self, avoid: frozenset[str]) -> None:
        """Leave what the hand holds on the first surface with room that is none of ``avoid``."""
        held = self._world.carried[0]
        self._set_down(held, avoid | {held})

    def use_on(self, skill: Skill, name: str, source: str, at: str) -> None:
        """Use a source or a tool on an object, from beside ``at``."""
        step = self._calls.use_on(skill, name, source, at)
        if not step.ok:
            raise StuckError(_sentence(step))

    def unload(self, name: str) -> None:
        """Take off what rests on an object."""
        while burden := self._world.burden(name):
            self._unload(burden, name, 0)

    def clear_way_to(self, name: str) -> None:
        """Open the closed containers around an object, the outermost first."""
        around = [item.name for item in self._world.relations.enclosing(name) if item.closed]
        for container in reversed(around):
            self.open(container)

    def _set_down(self, name: str, avoid: frozenset[str]) -> None:
        """Place what the hand holds on the first surface with room."""
        reason = ""
        for _, surface in zip(range(SURFACES_TRIED), self._surfaces(name, avoid), strict=False):
            step = self._calls.use(Skill.PLACE, surface, PlaceRelation.ONTOP)
            if step.ok:
                return
            reason = reason or _sentence(step)
        raise StuckError(reason or f"there is no free surface in the object table to put {name} on")

    def _surfaces(self, name: str, avoid: frozenset[str]) -> Iterator[str]:
        """Where a thing may be left: plain furniture before what has doors, works or can be carried itself."""
        room = self._world.room_of(name)

        def rank(surface: str) -> tuple[bool, ...]:
            asset = self._world.asset(surface)
            source = heat_source(asset) is not None or cold_source(asset) is not None
            fixed = self._world.is_fixed(surface)
            return (source, not fixed, self._world.room_of(surface) != room, bool(asset.joints))

        return iter(
            sorted(
                (
                    item
                    for item in self._task.table
                    if item not in avoid
                    and item not in self._world.carried
                    and self._world.asset(item).supports
                    and self._wishes.may_lie_on(name, item, self._world.room_of(item))
                ),
                key=rank,
            )
        )

    def _prepare(self, target: str, relation: PlaceRelation) -> None:
        self.clear_way_to(target)
        if relation is PlaceRelation.INSIDE and self._world.asset(target).joints:
            self.open(target)

    def _in_the_way_at(self, target: str, relation: PlaceRelation, name: str) -> str:
        """A thing that can be carried and takes room on or in the target, "" when there is none."""
        wanted = Relation(relation.value)
        return next(
            (
                other
                for other in self._task.table
                if other != name
                and not self._world.is_fixed(other)
                and self._world.relations.holds(wanted, other, target)
                and not self._wishes.belongs_at(other, target)
            ),
            "",
        )

    def _take(self, name: str, depth: int) -> None:
        self.clear_way_to(name)
        while burden := self._world.burden(name):
            self._unload(burden, name, depth)
        step = self._calls.use(Skill.PICK_UP, name)
        while step.failure is FailureReason.TOO_HEAVY and len(cargo := self._world.cargo(name)) > 1:
            self._unload(cargo[1], name, depth)
            step = self._calls.use(Skill.PICK_UP, name)
        if not step.ok:
            raise StuckError(_sentence(step))

    def _unload(self, burden: str, name: str, depth: int) -> None:
        if depth == DEPTH:
            raise StuckError(f"too many things are stacked on {name}")
        self.put_away(burden, frozenset((name, burden)), depth + 1)
        self.clear_way_to(name)

    def _swing(self, skill: Skill, name: str, depth: int) -> None:
        """Move a door or a lid; what can be carried away from before it is, or else the thing itself to where it opens."""
        for _ in range(BLOCKERS):
            step = self._calls.use(skill, name)
            if step.ok:
                return
            blocked = step.failure is FailureReason.DOOR_BLOCKED and step.blocker in self._world.scene.by_name
            blocker = step.blocker if blocked and step.blocker != name else ""
            moved = next((item for item in (blocker, name) if item and not self._world.is_fixed(item)), "")
            if not blocker or not moved or depth == DEPTH:
                raise StuckError(_sentence(step))
            self.put_away(moved, frozenset((blocker, name)), depth + 1)
        self._use(skill, name)

    def _use(self, skill: Skill, name: str) -> None:
        step = self._calls.use(skill, name)
        if not step.ok:
            raise StuckError(_sentence(step))


def _sentence(step: Step) -> str:
    return f"{step.call.skill.value} fails: {step.message}"
