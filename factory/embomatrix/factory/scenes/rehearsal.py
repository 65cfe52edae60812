"""Wishes are tried before they are written: by the routines of the oracle, in the simulator that executes plans, one at a time.

What fits a scene on paper is often out of the robot's reach in it: food in the corner behind a microwave, a cabinet behind
a console table, an oven whose door takes the only place from which its inside is served. A wish that fails alone fails in
every task. That all wishes of a task can be met together is not asked here; admission tells.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Self

from embomatrix.factory.scenes.view import SceneView
from embomatrix.sim.actions import HANDLINGS
from embomatrix.sim.planner.calls import StuckError
from embomatrix.sim.planner.errands import Errands, Warming
from embomatrix.sim.planner.script import PlanScript
from embomatrix.sim.planner.ways import PlacementGoal
from embomatrix.sim.planner.wishes import GoalLiterals
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import Bundle
from embomatrix.world.evaluate import evaluate, render
from embomatrix.world.goal import Atom, Not
from embomatrix.world.poses import PoseCache
from embomatrix.world.state import State
from embomatrix.world.task import Task, TaskCategory

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from embomatrix.world.goal import Formula
    from embomatrix.world.poses import Handling
    from embomatrix.world.scene import Scene
    from embomatrix.world.state import Relation

    Bars = Callable[[Sequence[tuple[Handling, str]]], bool]
    """Whether the arm finds no way to do one of some things to an object each, as the scene begins."""

SEED: Final = 0
"""Seed of the trials."""


class Rehearsal:
    """Tries wishes in a scene, each once. Close it after use; not for use by several threads."""

    def __init__(self, scene: Scene, bars: Bars = lambda _: False) -> None:
        """``bars`` knows the arm. Raises EngineError when the scene can't be loaded."""
        self._view = SceneView(scene)
        self._bars = bars
        self._simulator = load_simulator(Bundle(scene, {}, PoseCache()))
        self._known: dict[tuple[str, ...], bool] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._simulator.close()

    def fetches(self, thing: str) -> bool:
        """Whether it gets the thing into its hand."""
        return self._tries(f"take {thing}", (thing,), None, lambda script: script.take(thing))

    def puts(self, thing: str, relation: Relation, host: str) -> bool:
        """Whether it brings the thing on or into another, where it is not yet."""
        placed = Errands((PlacementGoal(thing, relation, host),), (), {}, {}, ())
        return self._brings_about(Atom(relation.value, (thing, host)), placed, thing, host)

    def swings(self, name: str, *, shut: bool) -> bool:
        """Whether it opens, or shuts, all doors and drawers of an object that is not so yet."""
        atom = Atom(State.OPEN.value, (name,))
        return self._brings_about(
            Not(atom) if shut else atom, Errands((), (), {name: not shut}, {}, ()), name
        )

    def switches(self, name: str, *, on: bool) -> bool:
        """Whether it switches an object on, or off, that is not so yet."""
        atom = Atom(State.TOGGLED_ON.value, (name,))
        return self._brings_about(atom if on else Not(atom), Errands((), (), {}, {name: on}, ()), name)

    def exposes(self, thing: str, source: str, state: State) -> bool:
        """Whether the thing becomes hot, cooked or frozen at a source, and is not so yet."""
        warming = Warming(thing, source, hot=state is not State.FROZEN)
        return self._brings_about(
            Atom(state.value, (thing,)), Errands((), (warming,), {}, {}, ()), thing, source
        )

    def _brings_about(self, goal: Formula, errands: Errands, *names: str) -> bool:
        simulator = self._simulator
        return self._tries(render(goal), names, goal, lambda script: errands.run(script, simulator))

    def _tries(
        self, deed: str, names: tuple[str, ...], goal: Formula | None, do: Callable[[PlanScript], None]
    ) -> bool:
        """Whether the deed succeeds, to which these objects and what they rest on or in are all that is needed."""
        key = (deed, *names)
        if key not in self._known:
            self._known[key] = self._succeeds(names, goal, do)
        return self._known[key]

    def _succeeds(
        self, names: tuple[str, ...], goal: Formula | None, do: Callable[[PlanScript], None]
    ) -> bool:
        task = self._task_about(names)
        script = PlanScript(self._simulator, task, SEED, GoalLiterals())
        if goal is not None and evaluate(goal, self._simulator.facts, {}):
            return False
        try:
            do(script)
        except StuckError:
            return False
        if goal is not None and not evaluate(goal, self._simulator.facts, {}):
            return False
        handled = [
            (HANDLINGS[call.skill], task.table[call.object_index])
            for call in script.plan
            if call.skill in HANDLINGS and call.object_index is not None
        ]
        return not self._bars(handled)

    def _task_about(self, names: tuple[str, ...]) -> Task:
        """What the simulator takes: a table of the objects and what they rest on or in, and any goal."""
        goal = Atom(State.OPEN.value, names[:1])
        rows = dict.fromkeys(row for name in names for row in (name, *self._view.hosts(name)))
        return Task(
            "rehearsal", self._view.scene.scene_id, "", TaskCategory.COMPOUND, goal, render(goal), tuple(rows)
        )
