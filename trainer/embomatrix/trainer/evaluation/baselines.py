"""Baselines without a model: lower and upper bounds for measured models.

* ``oracle``: the dataset's own plan, found by a planner that knows the goal and the simulator.
* ``greedy``: a script that knows the goal, but not the simulator. It takes the subgoals in order and writes a few fixed
  calls for each, from the prompt's initial state. It ignores the effects of its own earlier steps.
* ``template``: a script that knows every phrase of the training split, and reads the instruction and the prompt's table.
* ``nearest``: the demands of the training instruction with the most similar wording, on the objects of the new one.
* ``random``: a few random actions (place an object, open or close, switch), each with the moves that it needs, on objects
  that fit by the prompt. It does not know the goal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from embomatrix.scripts.examples import FittedScripts, InstructionScript, ScriptExample, example_of
from embomatrix.scripts.greedy import DOORS, SubgoalCalls, calls_at, greedy_plan
from embomatrix.scripts.nearest import NearestScript
from embomatrix.scripts.template import TemplateScript
from embomatrix.skills.syntax import PlaceRelation, Plan, Skill, SkillCall
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.data.tasks import TrainingTask, read_tasks
from embomatrix.world.dataset import Dataset

if TYPE_CHECKING:
    import numpy as np

    Baseline = Callable[[TrainingTask, np.random.Generator], Plan]

MAX_ACTIONS: Final = 4
"""Maximum actions of a random plan."""
_SWITCHES: Final = frozenset({"on", "off"})


class BaselineName(StrEnum):
    """Name of a baseline."""

    ORACLE = "oracle"
    GREEDY = "greedy"
    RANDOM = "random"
    TEMPLATE = "template"
    NEAREST = "nearest"
    HUMAN = "human"
    """Plans that EAI publishes; not for our own tasks."""


def oracle_plan(task: TrainingTask, rng: np.random.Generator) -> Plan:
    """Return the dataset's plan. Raises TrainerError for a task without one."""
    if not task.oracle:
        raise TrainerError(
            f"the task {task.task.task_id!r} has no oracle plan: build the dataset with `embomatrix factory`, or use another "
            "baseline"
        )
    return task.oracle


def random_plan(task: TrainingTask, rng: np.random.Generator) -> Plan:
    """Return one to ``MAX_ACTIONS`` actions on different objects. Kind and objects are drawn uniformly from those that fit."""
    script = SubgoalCalls(task.task, task.situation)
    loose = [row for row in task.situation.rows if not row.fixed]
    places = [row for row in task.situation.rows if row.fixed]
    doors = [row for row in places if DOORS & set(row.states)]
    switches = [row for row in task.situation.rows if _SWITCHES & set(row.states)]
    calls: list[SkillCall] = []
    for _ in range(int(rng.integers(1, MAX_ACTIONS + 1))):
        kinds = [kind for kind in (loose if places else [], doors, switches) if kind]
        if not kinds:
            break
        kind = kinds[int(rng.integers(len(kinds)))]
        item = kind.pop(int(rng.integers(len(kind))))
        if kind is loose:
            place = places[int(rng.integers(len(places)))]
            relation = tuple(PlaceRelation)[int(rng.integers(len(PlaceRelation)))]
            calls += script.carry(item, place, relation)
        elif kind is doors:
            calls += calls_at(item, Skill.CLOSE if "open" in item.states else Skill.OPEN)
        else:
            calls += calls_at(item, Skill.TOGGLE_OFF if "on" in item.states else Skill.TOGGLE_ON)
    return tuple(calls) or (SkillCall(Skill.MOVE, 0),)


def _greedy_plan(task: TrainingTask, rng: np.random.Generator) -> Plan:
    return greedy_plan(task.task, task.situation)


PLANNERS: Final[Mapping[BaselineName, Baseline]] = {
    BaselineName.ORACLE: oracle_plan,
    BaselineName.GREEDY: _greedy_plan,
    BaselineName.RANDOM: random_plan,
}
"""Functions that write a task's plan. Equal generators give equal plans. Human plans are not for our own tasks."""

SCRIPTS: Final[Mapping[BaselineName, Callable[[Sequence[ScriptExample]], InstructionScript]]] = {
    BaselineName.TEMPLATE: TemplateScript.fit,
    BaselineName.NEAREST: NearestScript.fit,
}
"""Functions that fit a script to a training split."""


def fitted_scripts(name: BaselineName, training: Dataset) -> FittedScripts:
    """Fit a script of ``SCRIPTS`` to the training split of a dataset. Raises TrainerError for one without training tasks."""
    tasks = read_tasks(Dataset(training.folder, training.train))
    examples = [
        example_of(record, tasks[record.task.task_id].situation, tasks[record.task.task_id].oracle)
        for record in training.train
    ]
    if not examples:
        raise TrainerError(
            f"the baseline `{name}` learns from training tasks, and {training.folder} has none: pass a dataset that has some "
            "with --training"
        )
    return FittedScripts(SCRIPTS[name], examples)
