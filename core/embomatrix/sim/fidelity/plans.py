"""Plans of the fidelity suite for one scene: oracle plans, and random valid, perturbed and failing plans."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.fidelity.compare import FidelityTrial, PlanKind
from embomatrix.sim.fidelity.sampler import ABILITY, SKILLS, PlanSampler, work_pairs
from embomatrix.skills.syntax import Plan, Skill, SkillCall
from embomatrix.world.task import Task

if TYPE_CHECKING:
    from embomatrix.sim.executor import Simulator
    from embomatrix.sim.live_world import LiveWorld

LENGTHS: Final = (4, 9)
MOST: Final = 12
"""Length of a random plan in calls: least, upper bound, and most with the calls that these need."""
PREFIXES: Final = (0, 5)
"""Calls before the failing one: least, and upper bound."""
WAITS: Final = 3
"""Largest number of waits at a source for the same effect in one plan."""
IDLE: Final = 6
"""Consecutive plans without progress on missing calls after which a scene counts as exhausted."""


@dataclass(frozen=True, slots=True)
class TrialRequest:
    """Wanted numbers of plans of each kind, and of successful calls of each skill, for one scene.

    Up to ``extra`` more valid plans are written while they provide missing calls. Trials are numbered from ``first``.
    """

    plans: Mapping[PlanKind, int]
    calls: Mapping[Skill, int]
    seed: int
    extra: int = 0
    first: int = 0


@dataclass(frozen=True, slots=True)
class SolvedTask:
    """A task of the scene with a plan that reaches its goal."""

    task: Task
    plan: Plan


def write_trials(
    simulator: Simulator, digest: str, examples: Sequence[SolvedTask], request: TrialRequest
) -> tuple[FidelityTrial, ...]:
    """Write trials for a scene loaded in cached mode. Equal arguments give equal trials.

    Skills with missing calls are more frequent in valid plans.
    """
    return tuple(_Writer(simulator, digest, examples, request).write())


def can_use(world: LiveWorld, task: Task, skill: Skill) -> bool:
    """True if the object table offers an object for the skill."""
    assets = [(name, world.asset(name)) for name in task.table]
    match skill:
        case Skill.PICK_UP | Skill.PLACE:
            return any(not world.is_fixed(name) for name, _ in assets)
        case Skill.OPEN | Skill.CLOSE:
            return any(asset.joints for _, asset in assets)
        case Skill.TOGGLE_ON | Skill.TOGGLE_OFF:
            return any(asset.can("toggleable") for _, asset in assets)
        case _:
            return skill not in ABILITY or bool(work_pairs(world, task, skill))


class _Writer:
    def __init__(
        self, simulator: Simulator, digest: str, examples: Sequence[SolvedTask], request: TrialRequest
    ) -> None:
        self._simulator = simulator
        self._digest = digest
        self._examples = examples
        self._request = request
        self._number = request.first
        words = np.frombuffer(bytes.fromhex(digest.partition(":")[2][:16]), dtype=np.uint32).tolist()
        self._rng = np.random.default_rng(np.random.SeedSequence((request.seed, *words)))
        self._missing: Counter[Skill] = Counter(request.calls)
        self._base: list[tuple[Task, Plan]] = []

    def write(self) -> Iterator[FidelityTrial]:
        wanted = self._request.plans
        for number in range(wanted.get(PlanKind.ORACLE, 0)):
            example = self._examples[number % len(self._examples)]
            yield self._counted(PlanKind.ORACLE, example.task, example.plan, self._seed())
        yield from self._valid_trials(wanted.get(PlanKind.VALID, 0))
        for kind, change in ((PlanKind.PERTURBED, self._perturbed), (PlanKind.FAILING, self._failing)):
            for _ in range(wanted.get(kind, 0)):
                yield self._trial(kind, *change())

    def _valid_trials(self, count: int) -> Iterator[FidelityTrial]:
        """Yield the requested number of trials, and more while they provide missing calls."""
        made = idle = 0
        most = count + self._request.extra
        while made < count or (made < most and idle < IDLE and self._lacking()):
            made += 1
            before = sum(self._missing[skill] for skill in self._lacking())
            task, seed = self._task(), self._seed()
            plan = self._valid(task, seed)
            if plan:
                yield self._counted(PlanKind.VALID, task, plan, seed)
            after = sum(self._missing[skill] for skill in self._lacking())
            idle = 0 if after < before else idle + 1

    def _counted(self, kind: PlanKind, task: Task, plan: Plan, seed: int) -> FidelityTrial:
        self._base.append((task, plan))
        for step in self._simulator.execute(task, plan, seed).steps:
            if step.ok:
                self._missing[step.call.skill] -= 1
        return self._trial(kind, task, plan, seed)

    def _trial(self, kind: PlanKind, task: Task, plan: Plan, seed: int) -> FidelityTrial:
        scene = self._simulator.world.scene
        trial_id = f"{scene.scene_id}-{self._digest.partition(':')[2][:8]}-{self._number:04d}"
        self._number += 1
        return FidelityTrial(trial_id, self._digest, scene.base, task.task_id, kind, seed, plan)

    def _lacking(self) -> list[Skill]:
        """Return usable skills with missing calls, those that lack most first."""
        world = self._simulator.world
        able = [
            skill
            for skill in SKILLS
            if self._missing[skill] > 0 and any(can_use(world, item.task, skill) for item in self._examples)
        ]
        return sorted(able, key=lambda skill: -self._missing[skill])

    def _task(self) -> Task:
        """Draw a task that allows the skill with the most missing calls, if any does."""
        lacking, world = self._lacking(), self._simulator.world
        tasks = [item.task for item in self._examples]
        able = [task for task in tasks if not lacking or can_use(world, task, lacking[0])]
        return able[self._draw(len(able))]

    def _valid(self, task: Task, seed: int) -> Plan:
        """Draw a plan whose calls all succeed."""
        sampler = PlanSampler(self._simulator, task, seed, self._rng)
        able = [skill for skill in SKILLS if can_use(self._simulator.world, task, skill)]
        weights = np.array([0.3 + max(0, self._missing[skill]) for skill in able])
        length = int(self._rng.integers(*LENGTHS))
        for _ in range(3 * length):
            if len(sampler.plan) >= length:
                break
            skill = able[int(self._rng.choice(len(able), p=weights / weights.sum()))]
            # An object at a working source takes many calls to arrange, so the robot waits there more than once.
            while sampler.add(skill) and skill in ABILITY and sampler.count(skill) < WAITS:
                pass
        return sampler.plan[:MOST]

    def _perturbed(self) -> tuple[Task, Plan, int]:
        """Return an earlier plan with a step dropped, two steps swapped or an index changed."""
        task, plan = self._base[self._draw(len(self._base))]
        change = CHANGES[self._draw(len(CHANGES))]
        return task, change(plan, task, self._rng), self._seed()

    def _failing(self) -> tuple[Task, Plan, int]:
        """Return a valid prefix with a failing call."""
        task, seed = self._task(), self._seed()
        sampler = PlanSampler(self._simulator, task, seed, self._rng)
        for _ in range(int(self._rng.integers(*PREFIXES))):
            sampler.add(SKILLS[self._draw(len(SKILLS))])
        last = sampler.fail()
        return task, (*sampler.plan, *((last,) if last is not None else ())), seed

    def _seed(self) -> int:
        return self._draw(2**31)

    def _draw(self, count: int) -> int:
        return int(self._rng.integers(count))


def _dropped(plan: Plan, task: Task, rng: np.random.Generator) -> Plan:
    number = int(rng.integers(len(plan)))
    return (*plan[:number], *plan[number + 1 :])


def _swapped(plan: Plan, task: Task, rng: np.random.Generator) -> Plan:
    first, second = sorted(rng.integers(len(plan), size=2).tolist())
    calls = list(plan)
    calls[first], calls[second] = calls[second], calls[first]
    return tuple(calls)


def _reindexed(plan: Plan, task: Task, rng: np.random.Generator) -> Plan:
    """Change the object of one call."""
    named = [number for number, call in enumerate(plan) if call.object_index is not None]
    if not named:
        return plan
    number = named[int(rng.integers(len(named)))]
    other: SkillCall = replace(plan[number], object_index=int(rng.integers(len(task.table))))
    return (*plan[:number], other, *plan[number + 1 :])


CHANGES: Final[tuple[Callable[[Plan, Task, np.random.Generator], Plan], ...]] = (
    _dropped,
    _swapped,
    _reindexed,
)
"""Perturbations of a plan."""
