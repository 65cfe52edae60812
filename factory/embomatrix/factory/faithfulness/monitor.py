"""Execution of a plan under watch: whether it reaches the goal, and which clauses of the intent it violates.

The watch follows calls and sources, not the facts by which the goal is scored, so an error in those facts shows as a shortcut.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.reward.hierarchy import score
from embomatrix.skills.appliances import cold_source, cooks, freezes, heat_source, heats
from embomatrix.skills.syntax import Plan, Skill
from embomatrix.skills.view import target_of
from embomatrix.world.intent import IntentClause
from embomatrix.world.state import THERMAL, Relation, State
from embomatrix.world.task import Task

if TYPE_CHECKING:
    from embomatrix.sim.executor import Simulator

PLACED = (Relation.INSIDE, Relation.ONTOP)


@dataclass(frozen=True, slots=True)
class WatchedRun:
    """Result of one execution. ``violated`` are clauses that the instruction states and the plan did not meet.

    Only a run that succeeds can be a shortcut.
    """

    reward: RewardBreakdown
    violated: tuple[IntentClause, ...]

    @property
    def is_shortcut(self) -> bool:
        return self.reward.success and bool(self.violated)


def watch(
    simulator: Simulator, task: Task, intent: Sequence[IntentClause], plan: Plan, seed: int
) -> WatchedRun:
    """Execute a plan up to its first failed step."""
    world = simulator.world
    simulator.reset(task, seed)
    sourced = [clause for clause in intent if clause.predicate in THERMAL and clause.places]
    treated = {clause for clause in sourced if _is_treated(simulator, clause)}
    placed: dict[str, tuple[str, str]] = {}
    for call in plan:
        held = world.carried[:1]
        if not simulator.run_step(call).ok:
            break
        if call.skill is Skill.PLACE and call.relation is not None:
            placed[held[0]] = (call.relation.value, target_of(world, call))
        treated |= {clause for clause in sourced if clause not in treated and _is_treated(simulator, clause)}
    wrong = [
        clause
        for clause in intent
        if (clause in sourced and clause not in treated)
        or (clause.predicate in PLACED and clause.holds and _is_placed_otherwise(clause, placed))
    ]
    return WatchedRun(score(task, simulator.touched, simulator.facts), tuple(wrong))


def _is_placed_otherwise(clause: IntentClause, placed: dict[str, tuple[str, str]]) -> bool:
    """True if every thing that was placed was last placed at a place of the clause with another relation."""
    last = [placed[thing] for thing in clause.things if thing in placed]
    return bool(last) and all(
        target in clause.places and relation != clause.predicate for relation, target in last
    )


def _is_treated(simulator: Simulator, clause: IntentClause) -> bool:
    """True if one of the clause's sources acts on one of its things now."""
    return any(
        _acts(simulator, source, thing, State(clause.predicate))
        for source in clause.places
        for thing in clause.things
    )


def _acts(simulator: Simulator, name: str, thing: str, state: State) -> bool:
    world = simulator.world
    asset, food = world.asset(name), world.asset(thing)
    source = cold_source(asset) if state is State.FROZEN else heat_source(asset)
    if source is None or world.engine.is_parked(thing):
        return False
    able = {State.FROZEN: freezes(source), State.HOT: heats(source), State.COOKED: cooks(source, food)}
    return able[state] and world.thermal.works(name, source) and world.thermal.is_at(thing, name, source)
