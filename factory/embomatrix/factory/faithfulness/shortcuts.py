"""Search for shortcuts: plans that succeed while they violate what the instruction states.

A plan that is only shorter is not a shortcut. The search tries given plans, mutations of the oracle's plan, plans of a
greedy search over single actions by their reward, and random plans.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.faithfulness.monitor import WatchedRun, watch
from embomatrix.sim.fidelity.sampler import PlanSampler
from embomatrix.skills.appliances import cold_source, heat_source
from embomatrix.skills.describe import call_in_words
from embomatrix.skills.syntax import MAX_STEPS, PROFILES, PlaceRelation, Plan, Skill, SkillCall
from embomatrix.world.intent import IntentClause
from embomatrix.world.task import Task

if TYPE_CHECKING:
    from embomatrix.sim.executor import Simulator

SEED: Final = 0
BEAM: Final = 3
"""Plans that the greedy search extends."""
GREEDY_SHARE: Final = 0.6
"""Share of the plans after the mutations that go to the greedy search."""
RANDOM_ACTIONS: Final = (1, 5)
"""Smallest and largest number of actions of a random plan."""
RANDOM_SKILLS: Final = (
    Skill.PLACE, Skill.PLACE, Skill.OPEN, Skill.CLOSE, Skill.TOGGLE_ON, Skill.TOGGLE_OFF, Skill.HEAT, Skill.COOK, Skill.FREEZE,
)  # fmt: skip
_CALLS_ABOUT: Final = (Skill.OPEN, Skill.CLOSE, Skill.TOGGLE_ON, Skill.TOGGLE_OFF)


class PlanOrigin(StrEnum):
    """Origin of a plan that the search tries."""

    GIVEN = "given"
    RELATION = "relation"  # the oracle's plan with another relation in a place call
    OBJECT = "object"  # the oracle's plan with one object replaced by another, without calls that then fail
    DROPPED = "dropped"  # the oracle's plan without some calls
    GREEDY = "greedy"
    RANDOM = "random"


@dataclass(frozen=True, slots=True)
class Shortcut:
    """Plan that succeeds and violates a clause of the intent."""

    origin: PlanOrigin
    plan: Plan
    violated: IntentClause


@dataclass
class SearchReport:
    """Plans tried for a task, those that succeeded, and the shortcuts among them."""

    tried: Counter[PlanOrigin] = field(default_factory=Counter)
    succeeded: int = 0
    shortcuts: list[Shortcut] = field(default_factory=list)


def find_shortcuts(
    simulator: Simulator,
    task: Task,
    intent: Sequence[IntentClause],
    oracle: Plan,
    plans: int,
    given: Iterable[Plan] = (),
    seed: int = 0,
) -> SearchReport:
    """Try up to ``plans`` plans. Equal arguments give equal reports."""
    search = _Search(simulator, task, tuple(intent), plans, np.random.default_rng(seed))
    for origin, tries in (
        (PlanOrigin.GIVEN, given),
        (PlanOrigin.RELATION, _other_relations(oracle)),
        (PlanOrigin.OBJECT, _other_objects(simulator, task, oracle)),
        (PlanOrigin.DROPPED, _dropped(oracle)),
    ):
        for plan in tries:
            if search.is_over:
                break
            search.run(origin, search.without_failures(plan) if origin is PlanOrigin.OBJECT else plan)
    search.greedy()
    search.random()
    return search.report


def shortcut_in_words(report: SearchReport, table: Sequence[str]) -> str:
    """Return a sentence about the first shortcut of a search; "" for none."""
    for shortcut in report.shortcuts[:1]:
        clause = shortcut.violated
        demanded = " ".join(
            filter(None, (clause.predicate, "/".join(clause.things), "/".join(clause.places)))
        )
        calls = "; ".join(call_in_words(call, table) for call in shortcut.plan)
        return f"({demanded}) is demanded, and this {shortcut.origin} plan succeeds without it: {calls}"
    return ""


class _Search:
    """Search with a limited number of plans. No plan is executed twice, and only new plans count."""

    def __init__(
        self,
        simulator: Simulator,
        task: Task,
        intent: tuple[IntentClause, ...],
        plans: int,
        rng: np.random.Generator,
    ) -> None:
        self.report = SearchReport()
        self._simulator, self._task, self._intent = simulator, task, intent
        self._left = plans
        self._rng = rng
        self._known: dict[Plan, WatchedRun] = {}
        self._succeeding: dict[Plan, Plan] = {}

    @property
    def is_over(self) -> bool:
        return self._left <= 0

    def without_failures(self, plan: Plan) -> Plan:
        """Return the calls of a plan that succeed one after the other, since another object may need fewer calls."""
        if plan not in self._succeeding:
            self._simulator.reset(self._task, SEED)
            self._succeeding[plan] = tuple(call for call in plan if self._simulator.run_step(call).ok)
        return self._succeeding[plan]

    def run(self, origin: PlanOrigin, plan: Plan) -> WatchedRun | None:
        """Execute a new plan, or return the run of a known one; None if it is too long, or no plans are left."""
        if plan in self._known:
            return self._known[plan]
        if not 0 < len(plan) <= MAX_STEPS or self.is_over:
            return None
        self._left -= 1
        self.report.tried[origin] += 1
        found = self._known[plan] = watch(self._simulator, self._task, self._intent, plan, SEED)
        self.report.succeeded += found.reward.success
        if found.is_shortcut:
            self.report.shortcuts.append(Shortcut(origin, plan, found.violated[0]))
        return found

    def greedy(self) -> None:
        """Extend the best plans by one action at a time, in random order, while rewards rise."""
        keep = round((1 - GREEDY_SHARE) * self._left)
        beam: list[tuple[float, Plan]] = [(0.0, ())]
        actions = list(_actions(self._simulator, self._task))
        while self._left > keep:
            tried: list[tuple[float, Plan]] = []
            for (reward, plan), number in itertools.product(beam, self._rng.permutation(len(actions))):
                if self._left <= keep:
                    return
                longer = plan + actions[number]
                found = self.run(PlanOrigin.GREEDY, longer)
                if found is not None and not found.reward.success and found.reward.total > reward:
                    tried.append((found.reward.total, longer))
            if not tried:
                return
            beam = sorted(tried, key=lambda item: -item[0])[:BEAM]

    def random(self) -> None:
        low, high = RANDOM_ACTIONS
        while not self.is_over:
            before = self._left
            sampler = PlanSampler(self._simulator, self._task, SEED, self._rng)
            for _ in range(int(self._rng.integers(low, high + 1))):
                sampler.add(RANDOM_SKILLS[int(self._rng.integers(len(RANDOM_SKILLS)))])
            self.run(PlanOrigin.RANDOM, sampler.plan)
            self._left = min(self._left, before - 1)


def _other_relations(oracle: Plan) -> Iterator[Plan]:
    """Yield the plan with another relation in one of its place calls."""
    for number, call in enumerate(oracle):
        for relation in PlaceRelation if call.relation is not None else ():
            if relation is not call.relation:
                yield (*oracle[:number], replace(call, relation=relation), *oracle[number + 1 :])


def _dropped(oracle: Plan) -> Iterator[Plan]:
    """Yield the plan without one of its calls, or without several calls in a row."""
    for low, high in itertools.combinations(range(len(oracle) + 1), 2):
        yield (*oracle[:low], *oracle[high:])


def _other_objects(simulator: Simulator, task: Task, oracle: Plan) -> Iterator[Plan]:
    """Yield the plan with one object replaced by another, with each relation in the place calls about that one.

    Other heat and cold sources come first.
    """
    assets = [simulator.world.asset(name) for name in task.table]
    is_source = [heat_source(asset) is not None or cold_source(asset) is not None for asset in assets]
    used = dict.fromkeys(call.object_index for call in oracle if call.object_index is not None)
    pairs = [(row, other) for row, other in itertools.product(used, range(len(assets))) if row != other]
    for row, other in sorted(pairs, key=lambda pair: not (is_source[pair[0]] and is_source[pair[1]])):
        swapped = tuple(_renamed(call, row, other) for call in oracle)
        yield swapped
        for relation in PlaceRelation:
            yield tuple(
                replace(call, relation=relation)
                if call.relation is not None and call.object_index == other
                else call
                for call in swapped
            )


def _renamed(call: SkillCall, row: int, other: int) -> SkillCall:
    return replace(
        call,
        object_index=other if call.object_index == row else call.object_index,
        source_index=other if call.source_index == row else call.source_index,
    )


def _actions(simulator: Simulator, task: Task) -> Iterator[Plan]:
    """Yield single actions with the moves that they need: switches, doors, and each object to each place."""
    world = simulator.world
    simulator.reset(task, SEED)
    for row, name in enumerate(task.table):
        asset = world.asset(name)
        for skill in _CALLS_ABOUT:
            able = bool(asset.joints) if skill in (Skill.OPEN, Skill.CLOSE) else asset.can("toggleable")
            if able and skill in PROFILES[task.profile]:
                yield (SkillCall(Skill.MOVE, object_index=row), SkillCall(skill, object_index=row))
    loose = [row for row, name in enumerate(task.table) if not world.is_fixed(name)]
    hosts = [row for row, name in enumerate(task.table) if world.asset(name).supports]
    for row, host in itertools.product(loose, hosts):
        for relation in (PlaceRelation.ONTOP, PlaceRelation.INSIDE):
            if row != host:
                yield (
                    SkillCall(Skill.MOVE, object_index=row),
                    SkillCall(Skill.PICK_UP, object_index=row),
                    SkillCall(Skill.MOVE, object_index=host),
                    SkillCall(Skill.PLACE, object_index=host, relation=relation),
                )
