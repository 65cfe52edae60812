"""Feasibility of goal atoms, tested one at a time before they are written: oracle routines run in the simulator.

Many plausible atoms are out of the robot's reach: food behind a microwave, a cabinet behind a table, an oven whose
open door covers the only position to serve it. An atom that fails alone fails in every task. Combinations of atoms
are only checked by admission.
"""

from collections.abc import Callable, Sequence
from typing import Final, Self

from embomatrix.factory.scenes.view import CapableRobot, SceneView
from embomatrix.sim.actions import HANDLINGS
from embomatrix.sim.planner.calls import StuckError
from embomatrix.sim.planner.script import PlanScript
from embomatrix.sim.planner.subgoals import Exposure, PlacementGoal, Subgoals
from embomatrix.sim.simulation import load_briefly
from embomatrix.world.bundle import Bundle
from embomatrix.world.evaluate import evaluate, render
from embomatrix.world.goal import Atom, Formula, Not
from embomatrix.world.poses import Handling, PoseCache
from embomatrix.world.scene import Scene
from embomatrix.world.state import Relation, State
from embomatrix.world.task import Task, TaskCategory

ArmLimits = Callable[[Sequence[tuple[Handling, str]]], bool]
"""True if the arm can't do one of these handlings in the initial scene."""

SEED: Final = 0
"""Seed of the trials."""


class SimulatedRobot(CapableRobot):
    """Feasibility checks in the simulator. Each check runs once. Close after use; not thread-safe."""

    def __init__(self, scene: Scene, blocks: ArmLimits = lambda _: False) -> None:
        """Load the scene.

        ``blocks`` reports handlings that the arm can't do. Raise EngineError if the scene can't be loaded.
        """
        self._view = SceneView(scene)
        self._blocks = blocks
        self._simulator = load_briefly(Bundle(scene, {}, PoseCache()))
        self._known: dict[tuple[str, ...], bool] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._simulator.close()

    def can_pick_up(self, object_name: str) -> bool:
        """True if the robot can pick the object up."""
        return self._is_feasible(
            f"take {object_name}", (object_name,), None, lambda script: script.take(object_name)
        )

    def can_place(self, object_name: str, relation: Relation, host: str) -> bool:
        """True if the robot can place the object on or in the host, where it is not yet."""
        placed = Subgoals(placements=(PlacementGoal(object_name, relation, host),))
        return self._achieves(Atom(relation.value, (object_name, host)), placed, object_name, host)

    def can_swing(self, name: str, *, shut: bool) -> bool:
        """True if the robot can open, or close, all doors and drawers of the object, and they are not so yet."""
        atom = Atom(State.OPEN.value, (name,))
        return self._achieves(Not(atom) if shut else atom, Subgoals(open={name: not shut}), name)

    def can_switch(self, name: str, *, on: bool) -> bool:
        """True if the robot can switch the object on, or off, and it is not so yet."""
        atom = Atom(State.TOGGLED_ON.value, (name,))
        return self._achieves(atom if on else Not(atom), Subgoals(on={name: on}), name)

    def can_treat(self, object_name: str, source: str, state: State) -> bool:
        """True if the object can become hot, cooked or frozen at the source and is not so yet by that source."""
        exposure = Exposure(object_name, source, hot=state is not State.FROZEN)
        return self._achieves(
            Atom(state.value, (object_name, source)), Subgoals(exposures=(exposure,)), object_name, source
        )

    def _achieves(self, goal: Formula, subgoals: Subgoals, *names: str) -> bool:
        simulator = self._simulator
        return self._is_feasible(render(goal), names, goal, lambda script: subgoals.run(script, simulator))

    def _is_feasible(
        self, action: str, names: tuple[str, ...], goal: Formula | None, do: Callable[[PlanScript], None]
    ) -> bool:
        """True if the action succeeds. ``names`` lists the objects that it needs besides their supports."""
        key = (action, *names)
        if key not in self._known:
            self._known[key] = self._succeeds(names, goal, do)
        return self._known[key]

    def _succeeds(
        self, names: tuple[str, ...], goal: Formula | None, do: Callable[[PlanScript], None]
    ) -> bool:
        task = self._task_about(names)
        self._simulator.reset(task, SEED)
        script = PlanScript(self._simulator, task)
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
        return not self._blocks(handled)

    def _task_about(self, names: tuple[str, ...]) -> Task:
        """Return a task for the simulator with these objects and their supports in its table. Its goal is a placeholder."""
        goal = Atom(State.OPEN.value, names[:1])
        rows = dict.fromkeys(row for name in names for row in (name, *self._view.hosts(name)))
        return Task(
            "feasibility",
            self._view.scene.scene_id,
            "",
            TaskCategory.COMPOUND,
            goal,
            render(goal),
            tuple(rows),
        )
