"""Plans written while they are executed: household routines that emit the skill calls which the present state needs.

A routine goes to a thing before it uses it, unless the robot was just sent to that thing or to the container that it
lies in. So whether a plan has a move follows from what the plan says, not from distances that no planner is told.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.skills.appliance import starts_closed
from embomatrix.skills.check import within_reach
from embomatrix.skills.syntax import MAX_STEPS, PlaceRelation, Skill, SkillCall

if TYPE_CHECKING:
    from embomatrix.sim.executor import Simulator
    from embomatrix.skills.syntax import Plan
    from embomatrix.world.state import Relation
    from embomatrix.world.task import Task

DEPTH: Final = 4
"""Things stacked on one another that are taken off at most before the lowest is moved."""


class StuckError(Exception):
    """A routine can't go on. The sentence names the call and why it failed."""


class PlanScript:
    """One attempt at a task, from its start. Every routine raises StuckError when a call of it fails."""

    def __init__(self, simulator: Simulator, task: Task, seed: int) -> None:
        simulator.reset(task, seed)
        self._simulator = simulator
        self._world = simulator.world
        self._task = task
        self._at = ""
        self._calls: list[SkillCall] = []

    @property
    def plan(self) -> Plan:
        """The calls so far. Of several moves in a row the last is kept."""
        pairs = zip(self._calls, [*self._calls[1:], None], strict=True)
        return tuple(
            call
            for call, following in pairs
            if not (call.skill is Skill.MOVE and following is not None and following.skill is Skill.MOVE)
        )

    def transfer(self, name: str, target: str, relation: PlaceRelation, depth: int = 0) -> None:
        """Carry an object to its place. What must be open is opened while the hand is empty, the target first."""
        self._clear_way_to(target)
        if relation is PlaceRelation.INSIDE and self._world.asset(target).joints:
            self.open(target)
        self._take(name, depth)
        self._use(Skill.PLACE, target, relation)

    def open(self, name: str) -> None:
        """Open it, unless it is open. An appliance that must be closed while it runs is switched off first."""
        if self._world.is_open(name):
            return
        self._clear_way_to(name)
        if self._world.is_on(name) and starts_closed(self._world.asset(name)):
            self.switch_off(name)
        self._use(Skill.OPEN, name)

    def close(self, name: str) -> None:
        """Close it, unless it is closed."""
        if self._world.is_open(name):
            self._use(Skill.CLOSE, name)

    def switch_on(self, name: str) -> None:
        """Switch it on, unless it is on, closed if it must be."""
        if self._world.is_on(name):
            return
        self._clear_way_to(name)
        if starts_closed(self._world.asset(name)):
            self.close(name)
        self._use(Skill.TOGGLE_ON, name)

    def switch_off(self, name: str) -> None:
        """Switch it off, unless it is off."""
        if self._world.is_on(name):
            self._clear_way_to(name)
            self._use(Skill.TOGGLE_OFF, name)

    def put_away(self, name: str, avoid: frozenset[str], depth: int = 0) -> None:
        """Carry an object to the first free surface that is none of ``avoid``; those of its own room come first."""
        room = self._world.room_of(name)
        surfaces = sorted(
            (item for item in self._task.table if self._is_open_surface(item) and item not in avoid),
            key=lambda item: self._world.room_of(item) != room,
        )
        if not surfaces:
            raise StuckError(f"there is no free surface in the object table to put {name} on")
        self.transfer(name, surfaces[0], PlaceRelation.ONTOP, depth)

    def _is_open_surface(self, name: str) -> bool:
        asset = self._world.asset(name)
        return self._world.is_fixed(name) and bool(asset.supports) and not asset.joints

    def _take(self, name: str, depth: int) -> None:
        self._clear_way_to(name)
        while burden := self._world.burden(name):
            if depth == DEPTH:
                raise StuckError(f"too many things are stacked on {name}")
            self.put_away(burden, frozenset((name,)), depth + 1)
            self._clear_way_to(name)
        self._use(Skill.PICK_UP, name)

    def _clear_way_to(self, name: str) -> None:
        """Open the closed containers around an object, the outermost first."""
        around = [item.name for item in self._world.relations.enclosing(name) if item.closed]
        for container in reversed(around):
            self.open(container)

    def _use(self, skill: Skill, name: str, relation: PlaceRelation | None = None) -> None:
        if not self._stands_at(name):
            self._do(SkillCall(Skill.MOVE, object_index=self._row(name)))
            self._at = name
        self._do(SkillCall(skill, object_index=self._row(name), relation=relation))

    def _stands_at(self, name: str) -> bool:
        inside = self._world.relations.inside
        sent = name == self._at or (self._at and (inside(name, self._at) or inside(self._at, name)))
        return bool(sent) and within_reach(self._world, name) is None

    def _row(self, name: str) -> int:
        row = self._task.index_of.get(name)
        if row is None:
            raise StuckError(f"{name} is not in the object table: no plan can name it")
        return row

    def _do(self, call: SkillCall) -> None:
        if len(self._calls) == MAX_STEPS:
            raise StuckError(f"the plan needs more than {MAX_STEPS} steps")
        step = self._simulator.run_step(call)
        if not step.ok:
            raise StuckError(f"{call.skill.value} fails: {step.message}")
        self._calls.append(call)

    def holds(self, relation: Relation, a: str, b: str) -> bool:
        """Whether the relation holds in the state reached."""
        return self._world.relations.holds(relation, a, b)
