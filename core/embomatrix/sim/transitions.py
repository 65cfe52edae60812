"""Tree of transitions: the calls that plans have in common are executed once.

A call after the same calls of the same task with the same seed has the same outcome to the bit. So a plan walks down the tree
as far as it is known, and only the rest is executed. The seed matters from the first call that draws a random number: calls
before it are shared by all seeds.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, Generic, TypeAlias, TypeVar

from embomatrix.sim.executor import TurnRun

if TYPE_CHECKING:
    from embomatrix.sim.executor import Mark, Simulator
    from embomatrix.sim.live_world import WorldMark
    from embomatrix.skills.syntax import Plan, SkillCall
    from embomatrix.skills.trace import Step, Trace
    from embomatrix.skills.turns import TurnObservation
    from embomatrix.world.task import Task

NODES_KEPT: Final = 4_000
"""Nodes in memory, about 3 kB each."""

T = TypeVar("T")
R = TypeVar("R")
_Key: TypeAlias = "str | SkillCall | tuple[SkillCall, int]"


@dataclass(slots=True, eq=False)
class _Node(Generic[T]):
    """State after a call, or the start of a task, whose parent is the tree's root."""

    parent: _Node[T] | None = None
    key: _Key = ""
    """Key in the parent's children: the call, with the seed if it is the first that draws; for a start the task id."""
    drawn: bool = False
    """A call on the way here has drawn: the state belongs to one seed."""
    step: Step | None = None
    mark: Mark | None = None
    """None for a start that was not asked for its mark."""
    ending: tuple[Trace, T] | None = None
    """Trace and judgement of a plan that ends here. Those of other plans differ in the plan alone."""
    world: WorldMark | None = None
    """State of the world where the mark lacks it, if a turn has begun here."""
    turn: tuple[tuple[int, bool], TurnObservation, T] | None = None
    """Prefix and sight, observation and judgement of a turn that ended here."""
    children: dict[_Key, _Node[T]] = field(default_factory=dict)


class TransitionTree(Generic[T]):
    """Executes plans with one simulator, which nothing else may use in the meantime.

    ``judge`` judges a task in the simulator's present state. It must depend on these two alone.
    """

    def __init__(self, simulator: Simulator, judge: Callable[[Task], T], most: int = NODES_KEPT) -> None:
        self._simulator = simulator
        self._drawing = simulator.drawing
        self._judge = judge
        self._most = most
        self._root: _Node[T] = _Node()
        self._nodes: OrderedDict[_Node[T], None] = OrderedDict()
        """All nodes but the root. Those not used for longest are first, and a node always before its parent."""
        self._here: _Node[T] | None = None
        """Node with the simulator's state; None if unknown."""

    def __len__(self) -> int:
        return len(self._nodes)

    def execute(
        self, task: Task, plan: Plan, seed: int, on_step: Callable[[int], None] = lambda _: None
    ) -> tuple[Trace, T, int]:
        """Return the trace of the plan, its judgement, and the number of its steps that were known.

        Equal to ``Simulator.execute`` and a judgement of the final state. ``on_step`` receives the number of finished steps.
        """
        nodes, shared = self._walk(task, plan, seed, 0, on_step)
        node = nodes[-1]
        if node.ending is None:
            self._go_to(node, task, seed)
            node.ending = self._simulator.trace(task, plan, _steps_of(nodes)), self._judge(task)
        self._use(node)
        trace, judgement = node.ending
        return replace(trace, plan=plan), judgement, shared

    def execute_turn(
        self,
        task: Task,
        plan: Plan,
        seed: int,
        prefix: int,
        on_step: Callable[[int], None] = lambda _: None,
        *,
        sight: bool = False,
    ) -> tuple[TurnRun, T, int]:
        """Return the run of a turn, the judgement of its end, and the number of its steps that were known.

        The first ``prefix`` calls are its episode's past. Equal to ``Simulator.execute_turn`` and a judgement of the final
        state.
        """
        self._mark_of(self._start(task), task, seed)  # while the simulator is there, if it must go there
        nodes, shared = self._walk(task, plan, seed, prefix, on_step)
        begin, end = nodes[prefix], nodes[-1]
        if end.turn is None or end.turn[0] != (prefix, sight):
            before = self._world_at(begin, task, seed)
            self._go_to(end, task, seed)
            observation = self._simulator.observe(task, before, sight=sight)
            end.turn = (prefix, sight), observation, self._judge(task)
        _, observation, judgement = end.turn
        first, last = self._mark_of(begin, task, seed), self._mark_of(end, task, seed)
        self._use(end)
        digests = first.digest(seed), last.digest(seed)
        return TurnRun(_steps_of(nodes), *digests, last.touched, observation), judgement, shared

    def after_turn(
        self, task: Task, plan: Plan, seed: int, prefix: int, ask: Callable[[Simulator, Task, int], R]
    ) -> R:
        """Return what ``ask`` says of the state after a turn, the task and the seed. It may leave the simulator anywhere."""
        nodes, _ = self._walk(task, plan, seed, prefix, lambda _: None)
        self._go_to(nodes[-1], task, seed)
        self._use(nodes[-1])
        self._here = None
        return ask(self._simulator, task, seed)

    def _walk(
        self, task: Task, plan: Plan, seed: int, prefix: int, on_step: Callable[[int], None]
    ) -> tuple[list[_Node[T]], int]:
        """Return the nodes from the start to the plan's end, and the number of steps among them that were known.

        The plan ends at its first failure after the ``prefix``.
        """
        nodes = [self._start(task)]
        for call in plan:
            known = nodes[-1].children.get(self._key(nodes[-1], call, seed))
            if known is None or _is_over(nodes, prefix):
                break
            nodes.append(known)
        shared = len(nodes) - 1
        if shared:
            on_step(shared)
        if shared < len(plan) and not _is_over(nodes, prefix):
            self._go_to(nodes[-1], task, seed)
            for call in plan[shared:]:
                nodes.append(self._run(nodes[-1], call, seed))
                on_step(len(nodes) - 1)
                if _is_over(nodes, prefix):
                    break
        return nodes, shared

    def _start(self, task: Task) -> _Node[T]:
        key = task.task_id
        start = self._root.children.get(key)
        if start is None:
            start = self._root.children[key] = _Node(self._root, key)
        return start

    def _key(self, node: _Node[T], call: SkillCall, seed: int) -> _Key:
        return (call, seed) if not node.drawn and call.skill in self._drawing else call

    def _run(self, node: _Node[T], call: SkillCall, seed: int) -> _Node[T]:
        """Execute a call at the simulator's present node."""
        simulator = self._simulator
        self._here = None  # unknown if the simulator raises
        step = simulator.run_step(call)
        before = None if step.ok else node.mark
        mark = simulator.mark() if before is None else simulator.mark_after_failure(before)
        key = self._key(node, call, seed)
        child = node.children[key] = _Node(node, key, node.drawn or key is not call, step, mark)
        self._here = child
        return child

    def _mark_of(self, node: _Node[T], task: Task, seed: int) -> Mark:
        if node.mark is None:
            self._go_to(node, task, seed)
            node.mark = self._simulator.mark()
        return node.mark

    def _world_at(self, node: _Node[T], task: Task, seed: int) -> WorldMark:
        mark = self._mark_of(node, task, seed)
        if mark.world is not None:
            return mark.world
        if node.world is None:
            self._go_to(node, task, seed)
            node.world = self._simulator.world.mark()
        return node.world

    def _go_to(self, node: _Node[T], task: Task, seed: int) -> None:
        """Bring the simulator to the state of a node."""
        if self._here is node:
            if not node.drawn:
                self._simulator.draw_from(seed)
            return
        self._here = None  # unknown if the simulator raises
        if node.mark is not None:
            self._simulator.return_to(node.mark, seed)
        else:
            self._simulator.reset(task, seed)
        self._here = node

    def _use(self, node: _Node[T]) -> None:
        """Note that a node and its ancestors were used, and forget nodes beyond the limit."""
        while node.parent is not None:
            self._nodes[node] = None
            self._nodes.move_to_end(node)
            node = node.parent
        while len(self._nodes) > self._most:
            oldest, _ = self._nodes.popitem(last=False)
            if oldest is self._here:
                self._here = None
            assert oldest.parent is not None
            del oldest.parent.children[oldest.key]


def _is_over(nodes: list[_Node[T]], prefix: int) -> bool:
    """Return whether the last node's call failed after the prefix."""
    step = nodes[-1].step
    return step is not None and not step.ok and len(nodes) - 1 > prefix


def _steps_of(nodes: list[_Node[T]]) -> tuple[Step, ...]:
    return tuple(node.step for node in nodes if node.step is not None)
