"""The oracle: a plan for a task, found by working back from its goal and proven by executing it.

It sees what no policy sees, the goal and the whole state, so it tells which tasks can be done and teaches imitation.
A goal is first turned into conjunctions of literals; an attempt makes one of them true, errand by errand, in the simulator,
and looks again: what an errand undid is done in the next round.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from embomatrix.sim.planner.calls import StuckError, TooLongError
from embomatrix.sim.planner.choices import choices
from embomatrix.sim.planner.chores import chores_for, chosen, is_about_chores
from embomatrix.sim.planner.errands import Errands, Warming
from embomatrix.sim.planner.limits import is_hot_work, portables, sources_for, why_impossible
from embomatrix.sim.planner.script import PlanScript
from embomatrix.sim.planner.ways import PlacementGoal
from embomatrix.sim.planner.wishes import GoalLiterals
from embomatrix.sim.planner.wording import Wording
from embomatrix.world.evaluate import evaluate, render
from embomatrix.world.goal import Not
from embomatrix.world.state import Relation, State

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.sim.executor import Simulator
    from embomatrix.sim.planner.choices import Choice, GroundLiteral
    from embomatrix.skills.syntax import Plan
    from embomatrix.world.task import Task

PROOF_SEEDS: Final = (0, 1, 2)
"""A plan must succeed with each of these: one that needs luck is none."""
SOURCES_TRIED: Final = 3
"""Heat or cold sources that are tried for an object."""
WAYS_TRIED: Final = 4
UNAIMED_WAYS_TRIED: Final = 8
"""Ways in which a relation is brought about, and one that no skill aims at."""
ATTEMPTS: Final = 36
"""Plans that are written at most for a task."""
ROUNDS: Final = 4
"""Times that an attempt looks for what is missing, and does it."""
UNAIMED: Final = Relation.NEXTTO
"""The relation that comes about by luck alone, unless two things share a small surface."""


@dataclass(frozen=True, slots=True)
class PlanNotFound:
    """No plan was found. ``reason`` is a sentence: what stopped the most promising attempt."""

    reason: str


@dataclass(frozen=True, slots=True)
class Strategy:
    """How an attempt differs from the others.

    ``source_rank`` and ``way`` choose among sources and tools, and among ways to bring relations about; ``reverse`` turns
    the order of the placements; ``singly`` lets a source work on one thing at a time; ``seed`` decides where things come to
    stand while the plan is written. A ``thrifty`` attempt goes nowhere for what is in reach already.
    """

    source_rank: int = 0
    reverse: bool = False
    way: int = 0
    singly: bool = False
    seed: int = PROOF_SEEDS[0]
    thrifty: bool = False


def find_plan(simulator: Simulator, task: Task) -> Plan | PlanNotFound:
    """A plan whose execution reaches the goal with several seeds, or why there is none. Leaves the simulator anywhere."""
    simulator.reset(task, PROOF_SEEDS[0])
    if evaluate(task.goal, simulator.facts, task.types):
        return PlanNotFound("the goal holds at the start: there is nothing to do")
    limit = functools.cache(functools.partial(_limit, simulator, task))
    names = Wording(task, simulator.world.scene).names
    options = choices(task.goal, task.types, simulator.facts, names, lambda item: bool(limit(item)))
    if not options:
        return PlanNotFound("the goal contradicts itself")
    hopeful = [choice for choice in options if not any(map(limit, choice))]
    if not hopeful:
        return PlanNotFound(next(filter(None, map(limit, options[0]))))
    return _first_proven(simulator, task, hopeful)


def _limit(simulator: Simulator, task: Task, item: GroundLiteral) -> str:
    """Why the literal, which does not hold yet, never will; "" otherwise."""
    missing = simulator.facts.holds(item.atom.predicate, item.atom.args) != item.positive
    return why_impossible(simulator.world, task, item) if missing else ""


def _first_proven(simulator: Simulator, task: Task, options: Sequence[Choice]) -> Plan | PlanNotFound:
    reason = ""
    tried: set[Plan] = set()
    for choice, strategy in _attempts(options):
        try:
            plan = _short_enough(simulator, task, choice, strategy)
        except StuckError as error:
            reason = reason or str(error)
            continue
        if plan in tried:
            continue
        tried.add(plan)
        flaw = _flaw(simulator, task, plan, choice)
        if not flaw:
            return plan
        reason = reason or flaw
    return PlanNotFound(reason)


def _attempts(options: Sequence[Choice]) -> list[tuple[Choice, Strategy]]:
    """Choices with strategies that make a difference to them, the first of both first: in diagonals."""
    ranked = [
        (rank + place, place, choice, strategy)
        for place, choice in enumerate(options)
        for rank, strategy in enumerate(_strategies(choice))
    ]
    ranked.sort(key=lambda item: item[:2])
    return [(choice, strategy) for _, _, choice, strategy in ranked[:ATTEMPTS]]


def _strategies(choice: Choice) -> list[Strategy]:
    predicates = [item.atom.predicate for item in choice]
    warm = bool({State.HOT, State.COOKED, State.FROZEN} & set(predicates))
    choosy = warm or any(map(is_about_chores, predicates))
    carried = sum(predicate in set(Relation) for predicate in predicates)
    found = itertools.product(
        PROOF_SEEDS,
        (False, True) if warm else (False,),
        range(UNAIMED_WAYS_TRIED if UNAIMED in predicates else WAYS_TRIED if carried else 1),
        range(SOURCES_TRIED) if choosy else (0,),
        (False, True) if carried > 1 else (False,),
    )
    return [Strategy(rank, reverse, way, singly, seed) for seed, singly, way, rank, reverse in found]


def _flaw(simulator: Simulator, task: Task, plan: Plan, choice: Choice) -> str:
    """Why the plan is no proof that the task can be done, "" when it is one."""
    for seed in PROOF_SEEDS:
        trace = simulator.execute(task, plan, seed)
        if trace.failure is not None:
            return f"with seed {seed}, step {len(trace.steps)} of the plan fails: {trace.steps[-1].message}"
        if not evaluate(task.goal, simulator.facts, task.types):
            missing = _missing(simulator, choice)
            lucky = next((item for item in missing if item.atom.predicate == UNAIMED), None)
            if lucky is not None:
                return f"{_in_words(lucky)} is a matter of luck: no skill aims at it"
            unmet = " ".join(map(_in_words, missing))
            return f"with seed {seed} the plan runs to its end and the goal does not hold: {unmet} is missing"
    return ""


def _short_enough(simulator: Simulator, task: Task, choice: Choice, strategy: Strategy) -> Plan:
    """A plan, a thrifty one where another would have too many steps. Raises StuckError."""
    try:
        return _write(simulator, task, choice, strategy)
    except TooLongError:
        return _write(simulator, task, choice, replace(strategy, thrifty=True))


def _write(simulator: Simulator, task: Task, choice: Choice, strategy: Strategy) -> Plan:
    """Execute what the literals ask for, and return the calls that it took. Raises StuckError."""
    script = PlanScript(simulator, task, strategy.seed, GoalLiterals(choice), thrifty=strategy.thrifty)
    for _ in range(ROUNDS):
        missing = _missing(simulator, choice)
        if not missing:
            break
        _errands(simulator, task, choice, missing, strategy).run(script, simulator)
    return script.plan


def _missing(simulator: Simulator, choice: Choice) -> list[GroundLiteral]:
    return [
        item for item in choice if simulator.facts.holds(item.atom.predicate, item.atom.args) != item.positive
    ]


def _errands(
    simulator: Simulator, task: Task, choice: Choice, missing: list[GroundLiteral], strategy: Strategy
) -> Errands:
    return Errands(
        placements=_placements(choice, strategy),
        chores=tuple(
            chosen(
                simulator.world,
                task.table,
                chores_for(simulator.world, missing),
                portables(simulator.world, task),
                strategy.source_rank,
            )
        ),
        warmings=_warmings(simulator, task, choice, missing, strategy),
        open={item.atom.args[0]: item.positive for item in choice if item.atom.predicate == State.OPEN},
        on={item.atom.args[0]: item.positive for item in choice if item.atom.predicate == State.TOGGLED_ON},
        leave=tuple(_relation_of(item) for item in choice if not item.positive and _is_relation(item)),
        way=strategy.way,
        singly=strategy.singly,
    )


def _is_relation(item: GroundLiteral) -> bool:
    return item.atom.predicate in set(Relation)


def _relation_of(item: GroundLiteral) -> PlacementGoal:
    return PlacementGoal(item.atom.args[0], Relation(item.atom.predicate), item.atom.args[1])


def _in_words(item: GroundLiteral) -> str:
    return render(item.atom if item.positive else Not(item.atom))


def _placements(choice: Choice, strategy: Strategy) -> tuple[PlacementGoal, ...]:
    """Where things must be, what others go on or in before those; what is there and stays there is not carried."""
    wanted = [_relation_of(item) for item in choice if item.positive and _is_relation(item)]
    if strategy.reverse:
        wanted.reverse()
    ordered: list[PlacementGoal] = []
    while wanted:
        moving = {item.name for item in wanted}
        ready = next((item for item in wanted if item.target not in moving), wanted[0])
        wanted.remove(ready)
        ordered.append(ready)
    return tuple(ordered)


def _warmings(
    simulator: Simulator, task: Task, choice: Choice, missing: list[GroundLiteral], strategy: Strategy
) -> tuple[Warming, ...]:
    """Sources that objects are taken to, hot ones before cold ones. Raises StuckError for what no source does."""
    homes = {
        item.atom.args[0]: item.atom.args[1]
        for item in choice
        if item.positive and item.atom.predicate in (Relation.INSIDE, Relation.ONTOP)
    }
    needs: dict[tuple[str, bool], set[State]] = {}
    for item in missing:
        if item.atom.predicate in (State.HOT, State.COOKED, State.FROZEN):
            key = (item.atom.args[0], is_hot_work(item))
            needs.setdefault(key, set()).add(State(item.atom.predicate))
    return tuple(
        Warming(
            name,
            _source_for(simulator, task, name, hot, frozenset(states), homes.get(name, ""), strategy),
            hot,
        )
        for (name, hot), states in sorted(needs.items(), key=lambda need: not need[0][1])
    )


def _source_for(
    simulator: Simulator,
    task: Task,
    name: str,
    hot: bool,
    states: frozenset[State],
    home: str,
    strategy: Strategy,
) -> str:
    """A source in the object table that brings the states about.

    The one that the instruction names goes first, then where the object must end, then those in its room.
    """
    world = simulator.world
    able = list(sources_for(world, task, name, states, hot=hot))
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
