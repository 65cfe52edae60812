"""Oracle planner: finds a plan by working back from a task's goal and proves it by execution.

It sees the goal and the whole state, which no policy sees. It decides which tasks can be done, and its plans teach imitation.
The goal is first turned into conjunctions of literals. An attempt makes one conjunction true in the simulator, subgoal by
subgoal, and repeats for literals that a later subgoal undid.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from embomatrix.sim.planner.calls import StuckError, TooLongError
from embomatrix.sim.planner.choices import Choice, GroundLiteral, choices
from embomatrix.sim.planner.feasibility import needs_heat, portables, sources_for, why_impossible
from embomatrix.sim.planner.script import PlanScript
from embomatrix.sim.planner.subgoals import Exposure, PlacementGoal, Subgoals
from embomatrix.sim.planner.tool_work import chosen_methods, needs_tools, subgoals_for
from embomatrix.skills.prompt import plain_words
from embomatrix.skills.syntax import PlaceRelation, Plan
from embomatrix.skills.turns import Advice
from embomatrix.world.evaluate import evaluate, render
from embomatrix.world.goal import Not
from embomatrix.world.scene import Scene
from embomatrix.world.state import THERMAL, Relation, State
from embomatrix.world.task import Task

if TYPE_CHECKING:
    from embomatrix.sim.executor import Simulator

PLACED: Final = frozenset({Relation.ONTOP, Relation.INSIDE, Relation.UNDER, Relation.NEXTTO})
"""Relations that a call places an object in."""
PROOF_SEEDS: Final = (0, 1, 2)
"""A plan must succeed with each of these seeds, so that it does not depend on luck."""
SOURCES_TRIED: Final = 3
"""Heat or cold sources, or tools, to try for an object."""
VARIANTS_TRIED: Final = 4
"""Variants to try for a relation."""
ATTEMPTS: Final = 36
"""Most plans that are written for a task."""
ATTEMPTS_FROM_HERE: Final = 8
"""Most plans that are written from a state within an episode, while the episode waits."""
ROUNDS: Final = 4
"""Most times that one attempt looks for missing literals and acts on them."""
NAMED: Final = 2
NAMED_IN_ROOM: Final = 3
"""Preference of an object whose category the instruction names, and of one that it names with the right room."""


@dataclass(frozen=True, slots=True)
class PlanNotFound:
    """Result without a plan. ``reason`` is a sentence about the most promising attempt."""

    reason: str


@dataclass(frozen=True, slots=True)
class Strategy:
    """Parameters of one attempt.

    ``source_rank`` selects among sources and tools, ``variant`` among the ways to bring relations about. ``reverse`` turns the
    order of the placements. ``packed`` fills containers before they are carried to their places. ``singly`` lets a source work
    on one object at a time. ``seed`` decides about poses while the plan is written. ``thrifty`` leaves out moves to objects in
    reach.
    """

    source_rank: int = 0
    reverse: bool = False
    variant: int = 0
    packed: bool = False
    singly: bool = False
    seed: int = PROOF_SEEDS[0]
    thrifty: bool = False


def find_plan(simulator: Simulator, task: Task) -> Plan | PlanNotFound:
    """Return a plan that reaches the goal with several seeds, or the reason why none was found. Leaves the state anywhere."""
    simulator.reset(task, PROOF_SEEDS[0])
    if evaluate(task.goal, simulator.facts, task.types):
        return PlanNotFound("the goal holds at the start: there is nothing to do")
    possible = _possible_choices(simulator, task)
    return possible if isinstance(possible, PlanNotFound) else _first_proven(simulator, task, possible)


def plan_from_here(simulator: Simulator, task: Task, seed: int) -> Plan | PlanNotFound:
    """Return a plan that reaches the goal from the simulator's present state, or the reason why none was found.

    The plan is empty if the goal holds. It succeeds with this seed. Leaves the state anywhere.
    """
    if evaluate(task.goal, simulator.facts, task.types):
        return ()
    possible = _possible_choices(simulator, task)
    if isinstance(possible, PlanNotFound):
        return possible
    here, reason = simulator.mark(), ""
    for choice, strategy in _attempts(possible)[:ATTEMPTS_FROM_HERE]:
        simulator.return_to(here, seed)
        script = PlanScript(simulator, task, choice)
        try:
            _empty_hand(simulator, task, choice, strategy, script)
            _make_true(simulator, task, choice, strategy, script)
        except StuckError as error:
            reason = reason or str(error)
            continue
        # Failed calls and superfluous moves are left out, which changes random numbers: only the plan itself proves itself.
        simulator.return_to(here, seed)
        failed = next((step for call in script.plan if not (step := simulator.run_step(call)).ok), None)
        if failed is None and evaluate(task.goal, simulator.facts, task.types):
            return script.plan
        reason = reason or (
            f"{' '.join(map(_in_words, _missing(simulator, choice)))} is missing in the end"
            if failed is None
            else f"{failed.call.skill.value} fails: {failed.message}"
        )
    return PlanNotFound(reason)


def advice_from_here(simulator: Simulator, task: Task, seed: int) -> Advice:
    """Return what ``plan_from_here`` finds as advice. Leaves the state anywhere."""
    found = plan_from_here(simulator, task, seed)
    return Advice(problem=found.reason) if isinstance(found, PlanNotFound) else Advice(found)


def _empty_hand(
    simulator: Simulator, task: Task, choice: Choice, strategy: Strategy, script: PlanScript
) -> None:
    """Carry the held object to its place if it has one that takes it now, else to any surface. Raises StuckError."""
    world = simulator.world
    if not world.carried:
        return
    held = world.carried[0]
    goals = [item for item in _placements(choice, strategy) if item.name == held]
    reached = any(
        script.deliver(item.target, PlaceRelation(item.relation)) for item in goals if item.relation in PLACED
    )
    if not reached:
        script.put_down(frozenset())


def _possible_choices(simulator: Simulator, task: Task) -> list[Choice] | PlanNotFound:
    """Return the choices for a goal that does not hold, without those for which an obstacle is known."""
    obstacle = functools.cache(functools.partial(_obstacle, simulator, task))
    preference = functools.partial(naming_rank, task, simulator.world.scene)
    options = choices(task.goal, task.types, simulator.facts, preference, lambda item: bool(obstacle(item)))
    if not options:
        return PlanNotFound("the goal contradicts itself")
    possible = [choice for choice in options if not any(map(obstacle, choice))]
    return possible or PlanNotFound(next(filter(None, map(obstacle, options[0]))))


def _obstacle(simulator: Simulator, task: Task, item: GroundLiteral) -> str:
    """Return why a literal that does not hold yet is impossible, else ""."""
    return "" if item.holds(simulator.facts) else why_impossible(simulator.world, task, item)


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
    """Pair choices with the strategies that matter to them, in diagonal order: the first of both first."""
    ranked = [
        (rank + place, place, choice, strategy)
        for place, choice in enumerate(options)
        for rank, strategy in enumerate(_strategies(choice))
    ]
    ranked.sort(key=lambda item: item[:2])
    return [(choice, strategy) for _, _, choice, strategy in ranked[:ATTEMPTS]]


def _strategies(choice: Choice) -> list[Strategy]:
    predicates = [item.atom.predicate for item in choice]
    warm = bool(THERMAL & set(predicates))
    choosy = warm or any(map(needs_tools, predicates))
    carried = sum(predicate in set(Relation) for predicate in predicates)
    found = itertools.product(
        PROOF_SEEDS,
        (False, True) if warm else (False,),
        range(VARIANTS_TRIED if carried else 1),
        range(SOURCES_TRIED) if choosy else (0,),
        (False, True) if carried > 1 else (False,),
        (False, True) if _is_nested(choice) else (False,),
    )
    return [
        Strategy(rank, reverse, variant, packed, singly, seed)
        for seed, singly, variant, rank, reverse, packed in found
    ]


def _is_nested(choice: Choice) -> bool:
    """True if something goes into a container that goes somewhere itself."""
    placed = [_relation_of(item) for item in choice if item.positive and _is_relation(item)]
    names = {item.name for item in placed}
    return any(item.relation is Relation.INSIDE and item.target in names for item in placed)


def _flaw(simulator: Simulator, task: Task, plan: Plan, choice: Choice) -> str:
    """Return why a plan does not prove the task, "" if it does."""
    for seed in PROOF_SEEDS:
        trace = simulator.execute(task, plan, seed)
        if trace.failure is not None:
            return f"with seed {seed}, step {len(trace.steps)} of the plan fails: {trace.steps[-1].message}"
        if not evaluate(task.goal, simulator.facts, task.types):
            unmet = " ".join(map(_in_words, _missing(simulator, choice)))
            return f"with seed {seed} the plan runs to its end and the goal does not hold: {unmet} is missing"
    return ""


def _short_enough(simulator: Simulator, task: Task, choice: Choice, strategy: Strategy) -> Plan:
    """Write a plan, a thrifty one if the usual plan has too many steps. Raises StuckError."""
    try:
        return _write(simulator, task, choice, strategy)
    except TooLongError:
        return _write(simulator, task, choice, replace(strategy, thrifty=True))


def _write(simulator: Simulator, task: Task, choice: Choice, strategy: Strategy) -> Plan:
    """Make the literals true and return the calls. Raises StuckError."""
    simulator.reset(task, strategy.seed)
    script = PlanScript(simulator, task, choice, thrifty=strategy.thrifty)
    _make_true(simulator, task, choice, strategy, script)
    return script.plan


def _make_true(
    simulator: Simulator, task: Task, choice: Choice, strategy: Strategy, script: PlanScript
) -> None:
    """Make the literals true by calls of the script. Raises StuckError."""
    for _ in range(ROUNDS):
        missing = _missing(simulator, choice)
        if not missing:
            break
        _subgoals(simulator, task, choice, missing, strategy).run(script, simulator)


def _missing(simulator: Simulator, choice: Choice) -> list[GroundLiteral]:
    return [item for item in choice if not item.holds(simulator.facts)]


def _subgoals(
    simulator: Simulator, task: Task, choice: Choice, missing: list[GroundLiteral], strategy: Strategy
) -> Subgoals:
    world = simulator.world
    work = subgoals_for(world, missing)
    return Subgoals(
        placements=_placements(choice, strategy),
        tool_work=tuple(
            chosen_methods(world, task.table, work, portables(world, task), strategy.source_rank)
        ),
        exposures=_exposures(simulator, task, choice, missing, strategy),
        open={item.atom.args[0]: item.positive for item in choice if item.atom.predicate == State.OPEN},
        on={item.atom.args[0]: item.positive for item in choice if item.atom.predicate == State.TOGGLED_ON},
        leave=tuple(_relation_of(item) for item in choice if not item.positive and _is_relation(item)),
        variant=strategy.variant,
        singly=strategy.singly,
    )


def _is_relation(item: GroundLiteral) -> bool:
    return item.atom.predicate in set(Relation)


def _relation_of(item: GroundLiteral) -> PlacementGoal:
    return PlacementGoal(item.atom.args[0], Relation(item.atom.predicate), item.atom.args[1])


def _in_words(item: GroundLiteral) -> str:
    return render(item.atom if item.positive else Not(item.atom))


def _placements(choice: Choice, strategy: Strategy) -> tuple[PlacementGoal, ...]:
    """Return final placements in an order that places the hosts and neighbours of other objects first.

    Packed containers are filled first instead, the innermost ones before the others.
    """
    wanted = [_relation_of(item) for item in choice if item.positive and _is_relation(item)]
    if strategy.reverse:
        wanted.reverse()
    implied = {item for item in wanted if _is_implied(item, wanted)}
    ordered: list[PlacementGoal] = []
    while wanted:
        moving = {item.name for item in wanted}
        filled = {item.target for item in wanted if item.relation is Relation.INSIDE}
        if strategy.packed:
            free = [item for item in wanted if item.name not in filled and _may_precede(item, moving)]
        else:
            free = [item for item in wanted if item.target not in moving]
        ready = next((item for item in free if item not in implied), (free or wanted)[0])
        wanted.remove(ready)
        ordered.append(ready)
    return tuple(ordered)


def _may_precede(item: PlacementGoal, moving: Set[str]) -> bool:
    """True if the object may be placed before its target is: into a container, but not onto a plate."""
    return item.relation is Relation.INSIDE or item.target not in moving


def _is_implied(item: PlacementGoal, wanted: Sequence[PlacementGoal]) -> bool:
    """True if the object gets there when it is put next to another one that belongs there too."""
    return any(
        other.name == item.name
        and other.relation is Relation.NEXTTO
        and PlacementGoal(other.target, item.relation, item.target) in wanted
        for other in wanted
    )


def _exposures(
    simulator: Simulator, task: Task, choice: Choice, missing: list[GroundLiteral], strategy: Strategy
) -> tuple[Exposure, ...]:
    """Return exposures to sources, hot ones first. Raises StuckError if no source brings a state about."""
    homes = {
        item.atom.args[0]: item.atom.args[1]
        for item in choice
        if item.positive and item.atom.predicate in (Relation.INSIDE, Relation.ONTOP)
    }
    needs: dict[tuple[str, bool], set[State]] = {}
    found: dict[Exposure, None] = {}
    for item in missing:
        if item.atom.predicate in THERMAL:
            (name, *stated), hot = item.atom.args, needs_heat(item)
            if stated and item.positive:
                found[Exposure(name, stated[0], hot)] = None
            else:
                needs.setdefault((name, hot), set()).add(State(item.atom.predicate))
    for (name, hot), states in needs.items():
        home = homes.get(name, "")
        source = _source_for(simulator, task, name, hot, frozenset(states), home, strategy)
        found[Exposure(name, source, hot)] = None
    return tuple(sorted(found, key=lambda exposure: not exposure.hot))


def _source_for(
    simulator: Simulator,
    task: Task,
    name: str,
    hot: bool,
    states: frozenset[State],
    home: str,
    strategy: Strategy,
) -> str:
    """Return a source in the object table that brings the states about.

    The source that the instruction names ranks first, then the object's final host, then sources in its room.
    """
    world = simulator.world
    able = list(sources_for(world, task, name, states, hot=hot))
    if not able:
        raise StuckError(
            f"no object in the table makes {name} {' and '.join(sorted(states))}: expected a heat or cold source"
        )
    room = world.room_of(name)
    able.sort(
        key=lambda other: (
            -naming_rank(task, world.scene, other),
            other != home,
            not world.is_fixed(other),
            world.room_of(other) != room,
        )
    )
    return able[strategy.source_rank % len(able)]


def naming_rank(task: Task, scene: Scene, name: str) -> int:
    """Rank how well the instruction names an object: 0 for not at all, highest for its category in its room.

    Plans for imitation should follow the instruction where the goal leaves a choice.
    """
    item = scene.by_name.get(name)
    if item is None:
        return 0
    text = f" {plain_words(task.instruction)} "
    category = plain_words(scene.assets[item.asset_id].category)
    room = plain_words(next((room.type for room in scene.rooms if room.name == item.room), ""))
    if room and f" {category} in the {room} " in text:
        return NAMED_IN_ROOM
    return NAMED if f" {category} " in text else 0
