"""Symbolic household: tasks, oracle plans and a cluster that executes plans by rules, without physics.

Deterministic, in memory, with the asynchronous interface of ``rpc.client.ClusterClient``.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from embomatrix.reward.hierarchy import score
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.wire.values import (
    Completed,
    InfraCode,
    InfraFailure,
    RolloutResult,
    RunStats,
    RunTerms,
    Timings,
)
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.prompt import PromptRow, Situation
from embomatrix.skills.syntax import PlaceRelation, Skill, SkillCall
from embomatrix.skills.trace import Step
from embomatrix.trainer.data.tasks import TaskSet, TrainingTask
from embomatrix.world.goal import And, Atom, Not
from embomatrix.world.state import Relation
from embomatrix.world.task import Task, TaskCategory

if TYPE_CHECKING:
    from embomatrix.reward.breakdown import RewardBreakdown
    from embomatrix.rpc.wire.training import TrainingReport

CONTAINERS = ("fridge", "microwave", "oven", "cabinet", "dishwasher", "drawer", "wardrobe", "washer")
SURFACES = ("countertop", "table", "desk", "shelf", "sofa", "bed", "stool", "bench")
SWITCHES = ("lamp", "television", "radio", "fan")
SMALL = (
    "apple",
    "chicken_leg",
    "bowl",
    "plate",
    "mug",
    "notebook",
    "remote",
    "towel",
    "book",
    "bottle",
    "sandwich",
    "knife",
    "toy",
    "candle",
    "glass",
    "pillow",
    "pan",
    "carton",
    "pen",
    "sponge",
    "vase",
    "hammer",
    "scarf",
    "tray",
)
RUNNING = frozenset({"microwave", "oven", "dishwasher", "washer"})
ROOMS = ("kitchen_0", "living_room_0", "bedroom_0")


@dataclass
class House:
    """State of one rollout. Objects are identified by their table rows."""

    situation: Situation
    parent: dict[int, tuple[int, Relation]] = field(default_factory=dict)
    open: set[int] = field(default_factory=set)
    on: set[int] = field(default_factory=set)
    near: int = -1
    held: int = -1
    touched: set[int] = field(default_factory=set)

    def __post_init__(self) -> None:
        rows = {row.name: row for row in self.situation.rows}
        for row in self.situation.rows:
            if row.host:
                self.parent[row.index] = (rows[row.host].index, row.relation)
            if "open" in row.states:
                self.open.add(row.index)
            if "on" in row.states:
                self.on.add(row.index)
        self.by_index = {row.index: row for row in self.situation.rows}

    def holds(self, predicate: str, args: tuple[str, ...]) -> bool:
        index = {row.name: row.index for row in self.situation.rows}
        first = index[args[0]]
        if predicate == "open":
            return first in self.open
        if predicate == "toggled_on":
            return first in self.on
        return self.parent.get(first) == (index[args[1]], Relation(predicate))

    def act(self, call: SkillCall) -> FailureReason | None:
        if call.skill is Skill.GO_TO_ROOM:
            return None if call.room_name in self.situation.rooms else FailureReason.UNKNOWN_ROOM
        row = self.by_index.get(-1 if call.object_index is None else call.object_index)
        if row is None:
            return FailureReason.UNKNOWN_INDEX
        failure = self._act_on(call, row)
        if failure is None:
            self.touched.add(row.index)
        return failure

    def _act_on(self, call: SkillCall, row: PromptRow) -> FailureReason | None:
        at = row.index
        closable = bool({"open", "closed"} & set(row.states))
        host = self.parent.get(at, (at, None))[0]
        match call.skill:
            case Skill.MOVE:
                self.near = host
                return None
            case Skill.PICK_UP if row.fixed:
                return FailureReason.NOT_PORTABLE
            case Skill.PICK_UP if self.held >= 0:
                return FailureReason.HAND_FULL
        if self.near not in (at, host):
            return FailureReason.OUT_OF_REACH
        match call.skill:
            case Skill.PICK_UP:
                if self._closed(host):
                    return FailureReason.CONTAINER_CLOSED
                self.held = at
                self.parent.pop(at, None)
            case Skill.PLACE:
                return self._place(row, call.relation)
            case Skill.OPEN | Skill.CLOSE if not closable:
                return FailureReason.NOT_OPENABLE
            case Skill.OPEN | Skill.CLOSE:
                (self.open.add if call.skill is Skill.OPEN else self.open.discard)(at)
            case Skill.TOGGLE_ON | Skill.TOGGLE_OFF if not {"on", "off"} & set(row.states):
                return FailureReason.NOT_TOGGLEABLE
            case Skill.TOGGLE_ON | Skill.TOGGLE_OFF:
                (self.on.add if call.skill is Skill.TOGGLE_ON else self.on.discard)(at)
            case _:
                return FailureReason.NOT_HEATABLE
        return None

    def _closed(self, index: int) -> bool:
        return "closed" in self.by_index[index].states and index not in self.open

    def _place(self, row: PromptRow, relation: PlaceRelation | None) -> FailureReason | None:
        if self.held < 0:
            return FailureReason.HAND_EMPTY
        fits = CONTAINERS if relation is PlaceRelation.INSIDE else SURFACES
        if row.category not in fits:
            return FailureReason.NO_CAVITY if relation is PlaceRelation.INSIDE else FailureReason.NO_SURFACE
        if self._closed(row.index):
            return FailureReason.CONTAINER_CLOSED
        self.parent[self.held] = (row.index, Relation(relation.value))
        self.held = -1
        return None


def run_plan(
    task: TrainingTask, plan: tuple[SkillCall, ...], reward: RewardSettings = PAPER
) -> tuple[RewardBreakdown, tuple[Step, ...]]:
    """Execute up to the first failure and score the result."""
    house = House(task.situation)
    steps = []
    for call in plan:
        failure = house.act(call)
        steps.append(Step(call, failure, failure.value if failure else "done"))
        if failure:
            break
    touched = frozenset(house.by_index[index].name for index in house.touched)
    return score(task.task, touched, house, reward), tuple(steps)


def make_task(task_id: str, rng: np.random.Generator, objects: int = 16) -> TrainingTask:
    """Return a random house with one of three kinds of goal and a plan that reaches it."""
    names = _pick(rng, CONTAINERS, max(2, objects // 6)) + _pick(rng, SURFACES, max(2, objects // 6))
    names += _pick(rng, SWITCHES, 1)
    hosts = [name for name in names if name not in SWITCHES]
    small = _pick(rng, SMALL, objects - len(names))
    order = list(rng.permutation([*names, *small]))
    room = {name: str(rng.choice(ROOMS[:2])) for name in names}
    host = {name: str(rng.choice(hosts)) for name in small}
    is_open = {name: bool(rng.random() < 0.25) for name in names}
    rows = tuple(_row(index, str(name), host, room, is_open) for index, name in enumerate(order))
    goal, words, plan = _goal(rng, names, small, host, is_open, {row.category: row.index for row in rows})
    situation = Situation(ROOMS[:2], ROOMS[0], rows, words, len(rows))
    task = Task(
        task_id=task_id,
        scene_id=f"scene-{task_id}",
        instruction=words,
        category=TaskCategory.PICK_AND_PLACE if len(goal) == 1 else TaskCategory.COMPOUND,
        goal=And(goal),
        goal_bddl=str(goal),
        table=tuple(row.name for row in rows),
    )
    return TrainingTask(task, situation, f"sha256:{task_id}", tuple(plan))


def _pick(rng: np.random.Generator, words: tuple[str, ...] | list[str], count: int) -> list[str]:
    return [str(word) for word in rng.choice(words, size=min(count, len(words)), replace=False)]


def _row(
    index: int, name: str, host: dict[str, str], room: dict[str, str], is_open: dict[str, bool]
) -> PromptRow:
    if name in host:
        relation = Relation.INSIDE if host[name] in CONTAINERS else Relation.ONTOP
        return PromptRow(index, f"{name}_1", name, room[host[name]], f"{host[name]}_1", relation)
    states = (("open" if is_open[name] else "closed"),) if name in CONTAINERS else ()
    if name in SWITCHES or name in RUNNING:
        states = (*states, "off")
    return PromptRow(index, f"{name}_1", name, room[name], states=states, fixed=True)


def _goal(rng, names, small, host, is_open, index):
    opened = dict(is_open)
    goal, words, plan = [], [], []

    def carry(carried: str, target: str) -> None:
        plan.append(SkillCall(Skill.MOVE, object_index=index[carried]))
        _opened(plan, host[carried], opened, index)
        plan.append(SkillCall(Skill.PICK_UP, object_index=index[carried]))
        plan.append(SkillCall(Skill.MOVE, object_index=index[target]))
        _opened(plan, target, opened, index)
        inside = target in CONTAINERS
        relation = PlaceRelation.INSIDE if inside else PlaceRelation.ONTOP
        plan.append(SkillCall(Skill.PLACE, object_index=index[target], relation=relation))
        goal.append(Atom(relation.value, (f"{carried}_1", f"{target}_1")))
        words.append(f"put the {carried.replace('_', ' ')} {'in' if inside else 'on'} the {target}")

    kind = rng.integers(4)
    if kind == 3:
        lamp = str(rng.choice([name for name in names if name in SWITCHES or name in RUNNING]))
        plan.append(SkillCall(Skill.MOVE, object_index=index[lamp]))
        if lamp in RUNNING and opened[lamp]:
            plan.append(SkillCall(Skill.CLOSE, object_index=index[lamp]))
        plan.append(SkillCall(Skill.TOGGLE_ON, object_index=index[lamp]))
        return (Atom("toggled_on", (f"{lamp}_1",)),), f"switch on the {lamp}", plan
    things = _pick(rng, small, 2 if kind == 2 else 1)
    for carried in things:
        targets = [name for name in names if name not in SWITCHES and name != host[carried]]
        carry(carried, str(rng.choice(targets)))
    if kind == 1 and plan[-1].relation is PlaceRelation.INSIDE:
        target = goal[0].args[1]
        goal.append(Not(Atom("open", (target,))))
        plan.append(SkillCall(Skill.CLOSE, object_index=plan[-1].object_index))
        words.append("close it")
    return tuple(goal), " and ".join(words), plan


def _opened(plan: list[SkillCall], name: str, opened: dict[str, bool], index: dict[str, int]) -> None:
    if name in CONTAINERS and not opened[name]:
        plan.append(SkillCall(Skill.OPEN, object_index=index[name]))
        opened[name] = True


def make_tasks(train: int, heldout: int, *, seed: int = 0, objects: int = 16) -> TaskSet:
    """Return training and held-out tasks from disjoint seeds."""
    made = [
        make_task(f"task-{number}", np.random.default_rng((seed, number)), objects)
        for number in range(train + heldout)
    ]
    kinds = [tuple(c for c in CONTAINERS if (c in RUNNING) is runs) for runs in (True, False)]
    return TaskSet(
        train=tuple(made[:train]),
        heldout=tuple(made[train:]),
        bundle_bytes=lambda digest: digest.encode(),
        kinds={word: kind for kind in (*kinds, SURFACES, SWITCHES, SMALL) for word in kind},
    )


@dataclass
class SymbolicCluster:
    """Cluster client over the symbolic rules.

    Rollouts whose id contains an entry of ``lost`` are lost; ``lose_first`` loses one rollout of every group.
    """

    tasks: TaskSet
    delay_s: float = 0.0
    lost: frozenset[str] = frozenset()
    lose_first: bool = False
    announced: list[tuple[int, list[int]]] = field(default_factory=list)
    batches: list[str] = field(default_factory=list)
    sent: set[str] = field(default_factory=set)
    seeds: list[tuple[str, int]] = field(default_factory=list)
    executed: int = 0
    reports: list[TrainingReport] = field(default_factory=list)
    closed: bool = False
    terms: RunTerms = field(default_factory=RunTerms)

    async def __aenter__(self) -> SymbolicCluster:
        self._by_id = {task.task.task_id: task for task in (*self.tasks.train, *self.tasks.heldout)}
        return self

    async def __aexit__(self, *_: object) -> None: ...

    async def open_run(self, name: str, run_id: str = "", terms: RunTerms | None = None) -> str:
        self.terms = terms or self.terms
        return run_id or f"run-{name}"

    async def announce_lookahead(self, run_id, version, entries):
        self.announced.append((version, [entry.step for entry in entries]))
        return {}

    async def report_training(self, run_id, report):
        self.reports.append(report)

    async def put_bundles(self, bundles):
        self.sent |= set(bundles)
        return tuple(bundles)

    async def execute(self, batch):
        self.batches.append(batch.batch_id)
        await asyncio.sleep(self.delay_s)
        groups = set()
        for cursor, rollout in enumerate(batch.rollouts, start=1):
            assert rollout.bundle_digest in self.sent
            self.seeds.append((rollout.task_id, rollout.seed))
            first = rollout.group_id not in groups
            groups.add(rollout.group_id)
            yield RolloutResult(
                rollout.rollout_id, rollout.group_id, cursor, 1, self._outcome(rollout, first=first)
            )

    def _outcome(self, rollout, *, first):
        if (self.lose_first and first) or any(mark in rollout.rollout_id for mark in self.lost):
            return InfraFailure(InfraCode.WORKER_LOST, "the worker was lost")
        self.executed += 1
        reward, steps = run_plan(self._by_id[rollout.task_id], rollout.plan, self.terms.reward)
        return Completed(reward, steps, (), "digest", "worker-0", Timings(), warm=True)

    async def close_run(self, run_id: str) -> RunStats:
        self.closed = True
        return RunStats(delivered=self.executed, prewarm_hits=self.executed)
