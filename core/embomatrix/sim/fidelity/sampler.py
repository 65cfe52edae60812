"""Random plans, written by executing them in cached mode: `check` decides which calls are possible.

A failed call is not part of a valid plan. The sampler then restores the state before it, so that the plan meets the same random
numbers whenever it is executed with its seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from embomatrix.skills.appliances import cold_source, heat_source, starts_closed
from embomatrix.skills.check import check, within_reach
from embomatrix.skills.syntax import PROFILES, PlaceRelation, Plan, Skill, SkillCall
from embomatrix.world.asset import FLOOR_CATEGORY
from embomatrix.world.task import Profile, Task

if TYPE_CHECKING:
    import numpy as np

    from embomatrix.sim.executor import Simulator
    from embomatrix.sim.live_world import LiveWorld

SKILLS: Final = PROFILES[Profile.PAPER]
TRIES: Final = 4
"""Objects to try for a skill before another skill is drawn."""
REVISIT: Final = 0.8
"""Probability of a move to an object that is in reach already."""
ABILITY: Final[Mapping[Skill, str]] = {
    Skill.HEAT: "heatable",
    Skill.COOK: "cookable",
    Skill.FREEZE: "freezable",
}
RELATIONS: Final = tuple(PlaceRelation)
RELATION_SHARES: Final = (0.4, 0.3, 0.15, 0.15)
STEP_M: Final = (0.1, 1.5)
"""Range of the length of a straight drive."""


class PlanSampler:
    """Sampler of one plan in a simulator. The caller provides the random generator."""

    def __init__(self, simulator: Simulator, task: Task, seed: int, rng: np.random.Generator) -> None:
        self._simulator = simulator
        self._world: LiveWorld = simulator.world
        self._task = task
        self._seed = seed
        self._rng = rng
        self._calls: list[SkillCall] = []
        self._rows = range(len(task.table))
        simulator.reset(task, seed)

    @property
    def plan(self) -> Plan:
        """Calls so far, all of which succeed."""
        return tuple(self._calls)

    def count(self, skill: Skill) -> int:
        """Count the calls of a skill so far."""
        return sum(call.skill is skill for call in self._calls)

    def add(self, skill: Skill) -> bool:
        """Add a call of the skill with the calls that it needs. False if none was found; needed calls may then remain."""
        return ROUTINES[skill](self, skill)

    def fail(self) -> SkillCall | None:
        """Draw a call that fails in the present state, None if none was drawn."""
        for _ in range(8 * TRIES):
            call = self._any_call()
            if check(self._world, call) is not None:
                return call
        return None

    def _any_call(self) -> SkillCall:
        skill = SKILLS[self._draw(len(SKILLS))]
        size = len(self._task.table)
        row = self._draw(size + 1)
        match skill:
            case Skill.TURN | Skill.MOVE_FORWARD:
                return SkillCall(Skill.MOVE_FORWARD, distance=self._between(4.0, 9.0), yaw=self._yaw())
            case Skill.GO_TO_ROOM:
                return SkillCall(skill, room_name=f"{self._world.rooms[0]}_x")
            case Skill.HEAT | Skill.COOK | Skill.FREEZE:
                return SkillCall(skill, object_index=row, source_index=self._draw(size))
            case Skill.PLACE:
                return SkillCall(skill, object_index=row, relation=RELATIONS[self._draw(len(RELATIONS))])
            case _:
                return SkillCall(skill, object_index=row)

    def _do(self, call: SkillCall) -> bool:
        if check(self._world, call) is not None:
            return False
        if self._simulator.run_step(call).ok:
            self._calls.append(call)
            return True
        self._simulator.reset(self._task, self._seed)
        for earlier in self._calls:
            self._simulator.run_step(earlier)
        return False

    def _use(self, call: SkillCall) -> bool:
        """Run the call, with a move to its source or object before it if that is out of reach, and often otherwise."""
        row = call.source_index if call.source_index is not None else call.object_index
        assert row is not None
        away = within_reach(self._world, self._task.table[row]) is not None
        if away or self._rng.random() < REVISIT:
            self._do(SkillCall(Skill.MOVE, object_index=row))
        return self._do(call)

    def _drive(self, skill: Skill) -> bool:
        match skill:
            case Skill.MOVE:
                return self._do(SkillCall(skill, object_index=self._draw(len(self._rows))))
            case Skill.TURN:
                return self._do(SkillCall(skill, yaw=self._yaw()))
            case Skill.GO_TO_ROOM:
                rooms = self._world.rooms
                return self._do(SkillCall(skill, room_name=rooms[self._draw(len(rooms))]))
            case _:
                return any(self._drive_on() for _ in range(TRIES))

    def _drive_on(self) -> bool:
        """Drive straight, backwards with probability 0.5, where the floor is free."""
        distance, yaw = self._between(*STEP_M), self._yaw()
        back = self._rng.random() < 0.5
        robot = self._world.robot
        course = robot.yaw + yaw + (math.pi if back else 0.0)
        if self._world.navigator.forward(robot, course, distance) < distance:
            return False
        return self._do(SkillCall(Skill.MOVE_FORWARD, distance=-distance if back else distance, yaw=yaw))

    def _pick_up(self, skill: Skill) -> bool:
        movable = [row for row in self._rows if not self._world.is_fixed(self._task.table[row])]
        return self._free_hand() and any(self._fetch(row) for row in self._some(movable))

    def _fetch(self, row: int) -> bool:
        """Pick up the object, out of closed containers if necessary."""
        while container := self._world.closed_around(self._task.table[row]):
            around = self._task.index_of.get(container)
            if around is None or not self._open_row(around):
                return False
        return self._use(SkillCall(Skill.PICK_UP, object_index=row))

    def _place(self, skill: Skill) -> bool:
        if not self._world.carried and not self._pick_up(Skill.PICK_UP):
            return False
        relation = RELATIONS[int(self._rng.choice(len(RELATIONS), p=RELATION_SHARES))]
        hosts = [row for row in self._rows if self._may_hold(row, relation)]
        return any(
            self._use(SkillCall(skill, object_index=row, relation=relation)) for row in self._some(hosts)
        )

    def _may_hold(self, row: int, relation: PlaceRelation) -> bool:
        asset = self._world.asset(self._task.table[row])
        match relation:
            case PlaceRelation.INSIDE:
                return bool(asset.interiors)
            case PlaceRelation.NEXTTO:
                return asset.category != FLOOR_CATEGORY
            case _:
                return bool(asset.open_supports)

    def _free_hand(self) -> bool:
        """Put the held object on any surface."""
        if not self._world.carried:
            return True
        hosts = [row for row in self._rows if self._may_hold(row, PlaceRelation.ONTOP)]
        return any(
            self._use(SkillCall(Skill.PLACE, object_index=row, relation=PlaceRelation.ONTOP))
            for row in self._some(hosts)
        )

    def _open(self, skill: Skill) -> bool:
        rows = [row for row in self._rows if self._asset_opens(row) and not self._is_open(row)]
        return self._free_hand() and any(self._open_row(row) for row in self._some(rows))

    def _open_row(self, row: int) -> bool:
        name = self._task.table[row]
        if self._is_open(row):
            return True
        if self._world.is_on(name) and starts_closed(self._world.asset(name)):
            self._use(SkillCall(Skill.TOGGLE_OFF, object_index=row))
        return self._use(SkillCall(Skill.OPEN, object_index=row))

    def _close(self, skill: Skill) -> bool:
        if not any(self._is_open(row) for row in self._rows) and not self._open(Skill.OPEN):
            return False
        rows = [row for row in self._rows if self._is_open(row)]
        return self._free_hand() and any(
            self._use(SkillCall(skill, object_index=row)) for row in self._some(rows)
        )

    def _switch(self, skill: Skill) -> bool:
        """Switch an object. Before switching off, switch one on if none is on."""
        able = [row for row in self._rows if self._world.asset(self._task.table[row]).can("toggleable")]
        wanted = skill is Skill.TOGGLE_ON
        ready = [row for row in able if self._world.is_on(self._task.table[row]) is not wanted]
        if not ready and wanted is False:
            return self._switch(Skill.TOGGLE_ON) and self._switch(skill)
        return self._free_hand() and any(
            self._use(SkillCall(skill, object_index=row)) for row in self._some(ready)
        )

    def _work(self, skill: Skill) -> bool:
        """Heat, cook or freeze an object that is at a source already, or bring one there."""
        pairs = work_pairs(self._world, self._task, skill)
        order = self._rng.permutation(len(pairs)).tolist()[:TRIES]
        chosen = sorted((pairs[number] for number in order), key=lambda pair: not self._is_at(*pair))
        return any(self._work_at(skill, food, source) for food, source in chosen)

    def _work_at(self, skill: Skill, food: int, source: int) -> bool:
        """Provide missing conditions: access, the food at the source, a closed door, the switch on. Then wait."""
        name = self._task.table[source]
        asset = self._world.asset(name)
        found = cold_source(asset) if skill is Skill.FREEZE else heat_source(asset)
        assert found is not None
        if not self._is_at(food, source):
            relation = PlaceRelation.INSIDE if found.requires_inside else PlaceRelation.ONTOP
            ready = self._free_hand() and (
                not found.requires_inside or not asset.joints or self._open_row(source)
            )
            placed = SkillCall(Skill.PLACE, object_index=source, relation=relation)
            if not (ready and self._fetch(food) and self._use(placed)):
                return False
        if not self._free_hand():
            return False
        if found.requires_closed and self._is_open(source):
            self._use(SkillCall(Skill.CLOSE, object_index=source))
        if found.requires_on and not self._world.is_on(name):
            self._use(SkillCall(Skill.TOGGLE_ON, object_index=source))
        return self._use(SkillCall(skill, object_index=food, source_index=source))

    def _is_at(self, food: int, source: int) -> bool:
        return self._world.is_at(self._task.table[food], self._task.table[source])

    def _asset_opens(self, row: int) -> bool:
        return bool(self._world.asset(self._task.table[row]).joints)

    def _is_open(self, row: int) -> bool:
        return self._world.is_open(self._task.table[row])

    def _some(self, rows: Sequence[int]) -> list[int]:
        """Draw a few rows in random order."""
        return [rows[number] for number in self._rng.permutation(len(rows)).tolist()[:TRIES]]

    def _draw(self, count: int) -> int:
        return int(self._rng.integers(count))

    def _between(self, low: float, high: float) -> float:
        return round(float(self._rng.uniform(low, high)), 2)

    def _yaw(self) -> float:
        return self._between(-math.pi, math.pi)


def work_pairs(world: LiveWorld, task: Task, skill: Skill) -> list[tuple[int, int]]:
    """Return the rows of objects that can be heated, cooked or frozen, each with every source of the table."""
    source_of = cold_source if skill is Skill.FREEZE else heat_source
    sources = [row for row, name in enumerate(task.table) if source_of(world.asset(name)) is not None]
    foods = [
        row
        for row, name in enumerate(task.table)
        if world.asset(name).can(ABILITY[skill]) and not world.is_fixed(name)
    ]
    return [(food, source) for food in foods for source in sources if food != source]


ROUTINES: Final[Mapping[Skill, Callable[[PlanSampler, Skill], bool]]] = {
    Skill.MOVE: PlanSampler._drive,
    Skill.TURN: PlanSampler._drive,
    Skill.PICK_UP: PlanSampler._pick_up,
    Skill.PLACE: PlanSampler._place,
    Skill.MOVE_FORWARD: PlanSampler._drive,
    Skill.OPEN: PlanSampler._open,
    Skill.CLOSE: PlanSampler._close,
    Skill.TOGGLE_ON: PlanSampler._switch,
    Skill.TOGGLE_OFF: PlanSampler._switch,
    Skill.HEAT: PlanSampler._work,
    Skill.COOK: PlanSampler._work,
    Skill.FREEZE: PlanSampler._work,
    Skill.GO_TO_ROOM: PlanSampler._drive,
}
"""Routine that draws a call of each skill of the paper."""
