"""Household routines that write a plan while they execute it: they emit the calls that the present state needs.

A routine moves to an object before it uses it, unless the robot was just sent to that object or to its container. Moves thus
follow from the plan's own text, not from distances that a policy never sees. Thrifty plans are the exception.
A failed call changes nothing and is left out of the plan. If there is a remedy, the routine applies it and tries again.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from embomatrix.sim.planner.calls import PlanCalls, StuckError
from embomatrix.sim.planner.choices import Choice, belongs_at, may_lie_on
from embomatrix.skills.appliances import cold_source, heat_source, starts_closed
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import PlaceRelation, Plan, Skill
from embomatrix.skills.trace import Step
from embomatrix.world.state import Relation
from embomatrix.world.task import Task

if TYPE_CHECKING:
    from embomatrix.sim.executor import Simulator

DEPTH: Final = 8
"""Longest chain of objects that must be cleared away, each before the next."""
SURFACES_TRIED: Final = 8
"""Surfaces to try for an object that must be put away."""
BLOCKERS: Final = 3
"""Objects that are cleared from one door at most."""


class PlanScript:
    """One attempt at a task. Every routine raises StuckError if one of its calls fails without a remedy."""

    def __init__(
        self, simulator: Simulator, task: Task, choice: Choice = (), *, thrifty: bool = False
    ) -> None:
        """Begin an attempt in the simulator's present state to make the literals of ``choice`` true.

        ``thrifty``: no moves to objects in reach.
        """
        self._calls = PlanCalls(simulator, task, thrifty=thrifty)
        self._world = simulator.world
        self._task = task
        self._choice = choice

    @property
    def plan(self) -> Plan:
        """Calls so far, as `PlanCalls.plan` gives them."""
        return self._calls.plan

    def transfer(self, name: str, target: str, relation: PlaceRelation) -> None:
        """Carry an object to its place. Containers are opened while the hand is empty.

        If there is no room, other portable objects at that place are put away first.
        """
        while True:
            self._prepare(target, relation)
            self._take(name, 0)
            step = self._calls.place(target, relation)
            if step.ok or (
                step.failure is FailureReason.NO_FREE_POSE and self._place_on_contents(name, target, relation)
            ):
                return
            burden = self._removable_at(target, relation, name)
            if step.failure is not FailureReason.NO_FREE_POSE or not burden:
                raise StuckError(_sentence(step))
            self._set_down(name, frozenset((name, target)))
            self.put_away(burden, frozenset((burden, name, target)), 1)

    def _place_on_contents(self, name: str, target: str, relation: PlaceRelation) -> bool:
        """Place the held object on an object inside the target. True if it is then inside the target too."""
        if relation is not PlaceRelation.INSIDE:
            return False
        for other in self._task.table:
            is_inside = other != name and self._world.relations.inside(other, target)
            if is_inside and self._calls.use(Skill.PLACE, other, PlaceRelation.ONTOP).ok:
                if self._world.relations.holds(Relation.INSIDE, name, target):
                    return True
                self._take(name, DEPTH)
        return False

    def open(self, name: str, depth: int = 0) -> None:
        """Open an object unless it is open. An appliance that runs only when closed is switched off first."""
        if self._world.is_open(name):
            return
        self.open_containers_of(name)
        if self._world.is_on(name) and starts_closed(self._world.asset(name)):
            self.switch_off(name)
        self._swing(Skill.OPEN, name, depth)

    def close(self, name: str) -> None:
        """Close an object unless it is closed."""
        if self._world.is_open(name):
            self.open_containers_of(name)
            self._swing(Skill.CLOSE, name, 0)

    def switch_on(self, name: str) -> None:
        """Switch an object on unless it is on. Close it first if it runs only when closed."""
        if self._world.is_on(name):
            return
        self.open_containers_of(name)
        if starts_closed(self._world.asset(name)):
            self.close(name)
        self._use(Skill.TOGGLE_ON, name)

    def switch_off(self, name: str) -> None:
        """Switch an object off unless it is off."""
        if self._world.is_on(name):
            self.open_containers_of(name)
            self._use(Skill.TOGGLE_OFF, name)

    def put_away(self, name: str, avoid: frozenset[str], depth: int = 0) -> None:
        """Carry an object to the first surface with room outside ``avoid``, preferably in its present room."""
        if not any(self._surfaces(name, avoid)):
            raise StuckError(f"there is no free surface in the object table to put {name} on")
        self._take(name, depth)
        self._set_down(name, avoid)

    def take(self, name: str) -> None:
        """Pick an object up unless it is in the hand."""
        if name not in self._world.carried[:1]:
            self._take(name, 0)

    def deliver(self, target: str, relation: PlaceRelation) -> bool:
        """Carry the held object to its place, and return whether it is there now."""
        return self._calls.place(target, relation).ok

    def put_down(self, avoid: frozenset[str]) -> None:
        """Place the held object on the first surface with room outside ``avoid``."""
        held = self._world.carried[0]
        self._set_down(held, avoid | {held})

    def use_on(self, skill: Skill, name: str, source: str, at: str) -> None:
        """Use a source or a tool on an object, from beside ``at``."""
        _check(self._calls.use_on(skill, name, source, at))

    def unload(self, name: str) -> None:
        """Put away the objects that rest on an object."""
        while burden := self._world.burden(name):
            self._unload(burden, name, 0)

    def open_containers_of(self, name: str) -> None:
        """Open the closed containers around an object, the outermost first."""
        around = [item.name for item in self._world.relations.enclosing(name) if item.closed]
        for container in reversed(around):
            self.open(container)

    def _set_down(self, name: str, avoid: frozenset[str]) -> None:
        """Place the held object on the first surface with room."""
        reason = ""
        for _, surface in zip(range(SURFACES_TRIED), self._surfaces(name, avoid), strict=False):
            step = self._calls.use(Skill.PLACE, surface, PlaceRelation.ONTOP)
            if step.ok:
                return
            reason = reason or _sentence(step)
        raise StuckError(reason or f"there is no free surface in the object table to put {name} on")

    def _surfaces(self, name: str, avoid: frozenset[str]) -> Iterator[str]:
        """Yield surfaces for an object: plain furniture first, then furniture with doors, portable objects, and sources."""
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
                    and self._world.asset(item).open_supports
                    and may_lie_on(self._choice, name, item, self._world.room_of(item))
                ),
                key=rank,
            )
        )

    def _prepare(self, target: str, relation: PlaceRelation) -> None:
        self.open_containers_of(target)
        if relation is PlaceRelation.INSIDE and self._world.asset(target).joints:
            self.open(target)

    def _removable_at(self, target: str, relation: PlaceRelation, name: str) -> str:
        """Return an object that takes up room at the target and may go elsewhere, "" for none."""
        wanted = Relation(relation.value)
        return next(
            (
                other
                for other in self._task.table
                if other != name
                and not self._world.is_fixed(other)
                and self._world.relations.holds(wanted, other, target)
                and not belongs_at(self._choice, other, target)
            ),
            "",
        )

    def _take(self, name: str, depth: int) -> None:
        self.open_containers_of(name)
        while burden := self._world.burden(name):
            self._unload(burden, name, depth)
        step = self._calls.use(Skill.PICK_UP, name)
        while step.failure is FailureReason.TOO_HEAVY and len(cargo := self._world.cargo(name)) > 1:
            self._unload(cargo[1], name, depth)
            step = self._calls.use(Skill.PICK_UP, name)
        _check(step)

    def _unload(self, burden: str, name: str, depth: int) -> None:
        if depth == DEPTH:
            raise StuckError(f"too many objects are stacked on {name}")
        self.put_away(burden, frozenset((name, burden)), depth + 1)
        self.open_containers_of(name)

    def _swing(self, skill: Skill, name: str, depth: int) -> None:
        """Open or close a door. A portable object that blocks it is put away, else the object itself if it is portable."""
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
        _check(self._calls.use(skill, name))


def _check(step: Step) -> None:
    """Raise StuckError for a step that failed."""
    if not step.ok:
        raise StuckError(_sentence(step))


def _sentence(step: Step) -> str:
    return f"{step.call.skill.value} fails: {step.message}"
