"""Examples: training tasks as a script may see them, and scripts fitted to them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from embomatrix.skills.prompt import PromptRow, Situation
from embomatrix.skills.syntax import Plan
from embomatrix.world.intent import goal_clauses

if TYPE_CHECKING:
    from embomatrix.world.dataset import TaskRecord
    from embomatrix.world.intent import IntentClause

FOLDS: Final = 5
"""Parts of a training split. A task of one part is answered by a script that was fitted to the others."""


@dataclass(frozen=True)
class ScriptExample:
    """Training task: the content of its prompt, the demands of its instruction, and the oracle's plan."""

    task_id: str
    situation: Situation
    intent: tuple[IntentClause, ...]
    oracle: Plan

    @property
    def rows(self) -> Mapping[str, PromptRow]:
        """Rows by name."""
        return {row.name: row for row in self.situation.rows}

    @property
    def demanded(self) -> set[str]:
        """Categories of the objects that the instruction demands something of."""
        rows = self.rows
        names = (name for clause in self.intent for name in (*clause.things, *clause.places))
        return {rows[name].category for name in names if name in rows}


def example_of(record: TaskRecord, situation: Situation, oracle: Plan) -> ScriptExample:
    """Return the example of a training record. A goal takes the place of a missing intent."""
    task = record.task
    intent = record.intent or goal_clauses(task.goal, task.types)
    return ScriptExample(task.task_id, situation, intent, oracle)


class InstructionScript(Protocol):
    """Script that writes a plan from the content of a prompt, without the goal."""

    def plan(self, situation: Situation) -> Plan: ...


class FittedScripts:
    """Scripts fitted to a training split. A task of this split is answered by a script that never saw it.

    Scripts are fitted when they are first needed.
    """

    def __init__(
        self,
        fit: Callable[[Sequence[ScriptExample]], InstructionScript],
        examples: Sequence[ScriptExample],
    ) -> None:
        self._fit = fit
        self._folds = {example.task_id: fold_of(example.task_id) for example in examples}
        self._examples = tuple(examples)
        self._fitted: dict[int | None, InstructionScript] = {}

    def plan(self, task_id: str, situation: Situation) -> Plan:
        """Write the plan of a task."""
        fold = self._folds.get(task_id)
        if fold not in self._fitted:
            others = [example for example in self._examples if self._folds[example.task_id] != fold]
            self._fitted[fold] = self._fit(others)
        return self._fitted[fold].plan(situation)


def fold_of(task_id: str) -> int:
    """Return the part of the training split that a task belongs to. It depends on the id only."""
    return hashlib.sha256(task_id.encode()).digest()[0] % FOLDS
