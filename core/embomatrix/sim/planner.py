"""The oracle: a plan for a task, found by working back from its goal and proven by executing it.

It sees what no policy sees, the goal and the whole state, so it tells which tasks can be done and teaches imitation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.sim.goal_choices import choices
from embomatrix.sim.plan_errands import Errands, Placement, Warming
from embomatrix.sim.plan_script import PlanScript, StuckError
from embomatrix.sim.plan_wording import Wording
from embomatrix.skills.appliance import cold_source, cooks, freezes, heat_source, heats
from embomatrix.world.evaluate import evaluate
from embomatrix.world.state import Relation, State

if TYPE_CHECKING:
    from collections.abc import Iterator

    from embomatrix.sim.executor import Simulator
    from embomatrix.sim.goal_choices import Choice, Literal
    from embomatrix.skills.syntax import Plan
    from embomatrix.world.asset import Asset
    from embomatrix.world.task import Task

PROOF_SEEDS: Final = (0, 1, 2)
"""A plan must succeed with each of these: one that needs luck is none."""
SOURCES_TRIED: Final = 3
"""Heat or cold sources that are tried for an object."""
ATTEMPTS: Final = 24
"""Plans that are written at most for a task."""
INEXPRESSIBLE: Final = frozenset({State.SLICED, State.DUSTY, State.STAINED, State.SOAKED})
"""States that none of the thirteen skills changes."""


@dataclass(frozen=True, slots=True)
class PlanNotFound:
    """No plan was found. ``reason`` is a sentence: what stopped the most promising attempt."""

    reason: str


@dataclass(frozen=True, slots=True)
class Strategy:
    """How an attempt differs from the others: the rank of its heat sources, and the order of its errands."""

    source_rank: int
    reverse: bool


STRATEGIES: Final = tuple(
    Strategy(rank, reverse) for rank in range(SOURCES_TRIED) for reverse in (False, True)
)


def find_plan(simulator: Simulator, task: Task) -> Plan | PlanNotFound:
    """A plan whose execution reaches the goal with several seeds, or why there is none. Leaves the simulator anywhere."""
    simulator.reset(task, PROOF_SEEDS[0])
    if evaluate(task.goal, simulator.facts, task.types):
        return PlanNotFound("the goal holds at the start: there is nothing to do")
    wording = Wording(task, simulator.world.scene)
    options = choices(task.goal, task.types, simulator.facts, wording.names)
    if not options:
        return PlanNotFound("the goal contradicts itself")
    reason = ""
    tried: set[Plan] = set()
    for attempt, (choice, strategy) in enumerate(_attempts(options)):
        if attempt == ATTEMPTS:
            break
        try:
            plan = _write(simulator, task, choice, strategy)
        except StuckError as error:
            reason = reason or str(error)
            continue
        if plan in tried:
            continue
        tried.add(plan)
        flaw = _flaw(simulator, task, plan)
        if not flaw:
            return plan
        reason = reason or flaw
    return PlanNotFound(reason)


def _attempts(options: tuple[Choice, ...]) -> Iterator[tuple[Choice, Strategy]]:
    for choice in options:
        for strategy in STRATEGIES:
            yield choice, strategy


def _flaw(simulator: Simulator, task: Task, plan: Plan) -> str:
    """Why the plan is no proof that the task can be done, "" when it is one."""
    for seed in PROOF_SEEDS:
        trace = simulator.execute(task, plan, seed)
        if trace.failure is not None:
            return f"with seed {seed}, step {len(trace.steps)} of the plan fails: {trace.steps[-1].message}"
        if not evaluate(task.goal, simulator.facts, task.types):
            return f"with seed {seed} the plan runs to its end and the goal does not hold"
    return ""


def _write(simulator: Simulator, task: Task, choice: Choice, strategy: Strategy) -> Plan:
    """Execute what the literals ask for, and return the calls that it took. Raises StuckError."""
    script = PlanScript(simulator, task, PROOF_SEEDS[0])
    missing = [item for item in choice if simulator.facts.holds(*_question(item)) != item.positive]
    errands = Errands(
        placements=_placements(choice, strategy),
        warmings=_warmings(simulator, task, choice, missing, strategy),
        open={item.atom.args[0]: item.positive for item in choice if item.atom.predicate == State.OPEN},
        on={item.atom.args[0]: item.positive for item in choice if item.atom.predicate == State.TOGGLED_ON},
        leave=tuple(
            (item.atom.args[0], item.atom.args[1])
            for item in choice
            if not item.positive and item.atom.predicate in set(Relation)
        ),
    )
    errands.run(script, simulator)
    return script.plan


def _question(item: Literal) -> tuple[str, tuple[str, ...]]:
    return item.atom.predicate, item.atom.args


def _placements(choice: Choice, strategy: Strategy) -> tuple[Placement, ...]:
    """Where things must be, what others go on or in before those; what is there and stays there is not carried."""
    wanted = [
        Placement(item.atom.args[0], Relation(item.atom.predicate), item.atom.args[1])
        for item in choice
        if item.positive and item.atom.predicate in set(Relation)
    ]
    if strategy.reverse:
        wanted.reverse()
    ordered: list[Placement] = []
    while wanted:
        moving = {item.name for item in wanted}
        ready = next((item for item in wanted if item.target not in moving), wanted[0])
        wanted.remove(ready)
        ordered.append(ready)
    return tuple(ordered)


def _warmings(
    simulator: Simulator, task: Task, choice: Choice, missing: list[Literal], strategy: Strategy
) -> tuple[Warming, ...]:
    """Sources that objects are taken to, hot ones before cold ones. Raises StuckError for what no source does."""
    homes = {
        item.atom.args[0]: item.atom.args[1]
        for item in choice
        if item.positive and item.atom.predicate in (Relation.INSIDE, Relation.ONTOP)
    }
    needs: dict[tuple[str, bool], set[State]] = {}
    for item in missing:
        if item.atom.predicate not in set(State) - {State.OPEN, State.TOGGLED_ON}:
            continue
        name, state = item.atom.args[0], State(item.atom.predicate)
        if state in INEXPRESSIBLE or (state is State.COOKED and not item.positive):
            change = "made" if item.positive else "undone"
            raise StuckError(f"none of the skills can do this: {name} must be {change} {state.value}")
        hot = state is State.COOKED or (state is State.HOT) == item.positive
        needs.setdefault((name, hot), set()).add(state)
    found: list[Warming] = []
    for (name, hot), states in sorted(needs.items(), key=lambda need: not need[0][1]):
        source = _source_for(simulator, task, name, hot, states, homes.get(name, ""), strategy)
        found.append(Warming(name, source, hot))
    return tuple(found)


def _source_for(
    simulator: Simulator,
    task: Task,
    name: str,
    hot: bool,
    states: set[State],
    home: str,
    strategy: Strategy,
) -> str:
    """A source in the object table that brings the states about.

    The one that the instruction names goes first, then where the object must end, then those in its room.
    """
    world = simulator.world
    item = world.asset(name)
    able = [other for other in task.table if other != name and _does(world.asset(other), item, hot, states)]
    if not able:
        raise StuckError(
            f"no object in the table makes {name} {' and '.join(sorted(states))}: expected a heat or cold source"
        )
    room = world.room_of(name)
    wording = Wording(task, world.scene)
    able.sort(
        key=lambda other: (
            -wording.names(other),
            other != home,
            not world.is_fixed(other),
            world.room_of(other) != room,
        )
    )
    return able[strategy.source_rank % len(able)]


def _does(source: Asset, item: Asset, hot: bool, states: set[State]) -> bool:
    found = heat_source(source) if hot else cold_source(source)
    if found is None:
        return False
    if hot:
        able = heats(found) and item.can("heatable")
        return cooks(found, item) and (able or states == {State.COOKED}) if State.COOKED in states else able
    return freezes(found) and item.can("freezable")
