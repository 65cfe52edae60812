"""Readings: answers of a reader who saw prompts only, with a plan and the goal that the instruction states.

A file of answers has one JSON object per line: ``task``, ``plan`` (text in a plan codec) and ``goal`` (a formula over rows of
the object table, such as ``(and (inside 4 2) (not (open 2)))``). Besides BDDL's operators, ``(exactly N a b c)`` is true if N
of the formulas are.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Final

import numpy as np

from embomatrix.factory.admission import SEED
from embomatrix.factory.metrics.figures import EvaluationError, EvaluationFigures
from embomatrix.pages.figures import Better, Figure
from embomatrix.reward.hierarchy import score
from embomatrix.sim.executor import Simulator
from embomatrix.sim.planner.oracle import PlanNotFound, find_plan
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import PlanError, parse_plan
from embomatrix.skills.prompt import Codec, prompt_for, situation_of
from embomatrix.world.dataset import Dataset, TaskRecord
from embomatrix.world.evaluate import atoms_of, evaluate, instance, instances, pair_sides, render
from embomatrix.world.goal import And, Atom, Formula, Imply, Not, Or, Quantified, Quantifier
from embomatrix.world.json_text import parse_json
from embomatrix.world.task import Task

ANSWERS: Final = "readings.jsonl"
EXACTLY: Final = "exactly"
MAX_ATOMS: Final = 12
"""Maximum number of atoms for which all assignments are compared; with more, a sample is."""
SAMPLE: Final = 4_096
GOALS: Final = {"human_success": 0.95, "instruction_goal_agreement": 0.97}


@dataclass(frozen=True, slots=True)
class Reading:
    """Answer of a reader to one prompt. Empty texts stand for no answer."""

    task: str
    plan: str = ""
    goal: str = ""


@dataclass(frozen=True, slots=True)
class ReadingVerdict:
    """Verdict on a reading: whether its plan succeeds, and whether its goal agrees. None for a text that was not given."""

    task: str
    success: bool | None
    agrees: bool | None
    detail: str = ""


def read_answers(path: Path) -> tuple[Reading, ...]:
    """Return the answers of a file. Raise EvaluationError that names the line."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise EvaluationError(
            f"{path} can't be read ({error}): expected JSON lines with task, plan and goal"
        ) from error
    found = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            value = parse_json(line)
            found.append(Reading(str(value["task"]), str(value.get("plan", "")), str(value.get("goal", ""))))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise EvaluationError(
                f"{path}:{number} is no answer ({error}): expected an object with task, plan and goal"
            ) from error
    return tuple(found)


def shipped_answers() -> tuple[Reading, ...]:
    """Return the answers of readers about held-out tasks of the shipped dataset."""
    with resources.as_file(resources.files("embomatrix.factory.evaluate") / ANSWERS) as file:
        return read_answers(file)


def prompts_of(dataset: Dataset, count: int) -> str:
    """Return the prompts of the first held-out tasks, without any goal, as text for a reader.

    The system text of a profile stands before the first of its tasks.
    """
    parts: list[str] = []
    shown: set[str] = set()
    for record in dataset.heldout[:count]:
        scene = dataset.bundle(record.bundle_digest).scene
        prompt = prompt_for(situation_of(scene, record.task), Codec.LINES)
        if prompt.system not in shown:
            shown.add(prompt.system)
            parts.append(f"{prompt.system}\n")
        parts.append(f"## {record.task.task_id}\n\n{prompt.user}\n")
    return "\n".join(parts)


def evaluate_readings(
    dataset: Dataset, readings: Sequence[Reading]
) -> tuple[EvaluationFigures, tuple[ReadingVerdict, ...]]:
    """Return the shares of successful plans and of agreeing goals, with a verdict for each answer. Raise DatasetError."""
    verdicts = tuple(verdict_on(dataset, dataset.find(each.task), each) for each in readings)
    figures = []
    for name, values in (
        ("human_success", [each.success for each in verdicts if each.success is not None]),
        ("instruction_goal_agreement", [each.agrees for each in verdicts if each.agrees is not None]),
    ):
        if values:
            figures.append(
                Figure(name, sum(values) / len(values), "", Better.HIGHER, len(values), GOALS[name])
            )
    return EvaluationFigures("readings", {"answers": len(readings)}, tuple(figures)), verdicts


def verdict_on(dataset: Dataset, record: TaskRecord, reading: Reading) -> ReadingVerdict:
    """Judge one answer by execution and by comparing formulas."""
    with contextlib.closing(load_simulator(dataset.read_bundle(record.bundle_digest))) as simulator:
        success, detail = _succeeds(simulator, record.task, reading.plan) if reading.plan else (None, "")
        agrees = None
        if reading.goal:
            try:
                stated = parse_goal(reading.goal, record.task.table)
            except EvaluationError as error:
                return ReadingVerdict(record.task.task_id, success, False, str(error))
            agrees = is_equivalent(stated, record.task) or _agree_when_executed(
                simulator, record.task, stated
            )
            if not agrees:
                detail = f"{detail} stated {reading.goal}, scored {record.task.goal_bddl}".strip()
    return ReadingVerdict(record.task.task_id, success, agrees, detail)


def _succeeds(simulator: Simulator, task: Task, text: str) -> tuple[bool, str]:
    try:
        plan = parse_plan(text, task.profile)
    except PlanError as error:
        return False, str(error)
    trace = simulator.execute(task, plan, SEED)
    reached = score(task, trace.touched, simulator.facts).success
    return reached, "" if reached else trace.steps[
        -1
    ].message if trace.failure is not None else "the goal is missed"


def parse_goal(text: str, table: Sequence[str]) -> Formula:
    """Return a reader's formula over scene objects. Raise EvaluationError for text that is no formula."""
    tokens = text.replace("(", " ( ").replace(")", " ) ").split()
    node, rest = _node(tokens, text)
    if rest:
        raise EvaluationError(f"{text!r} goes on after its end: expected one formula")
    return _formula(node, table, text)


Node = str | list["Node"]


def _node(tokens: Sequence[str], text: str) -> tuple[Node, Sequence[str]]:
    if not tokens or tokens[0] == ")":
        raise EvaluationError(f"{text!r} is no formula: expected balanced parentheses")
    if tokens[0] != "(":
        return tokens[0], tokens[1:]
    items: list[Node] = []
    rest = tokens[1:]
    while rest and rest[0] != ")":
        item, rest = _node(rest, text)
        items.append(item)
    if not rest:
        raise EvaluationError(f"{text!r} is no formula: expected balanced parentheses")
    return items, rest[1:]


def _formula(node: Node, table: Sequence[str], text: str) -> Formula:
    if isinstance(node, str) or not node or not isinstance(node[0], str):
        raise EvaluationError(
            f"{text!r} is no formula: expected (predicate row ...) or (and ...), (or ...), (not ...)"
        )
    head, arguments = node[0].lower(), node[1:]
    if head == EXACTLY and arguments and isinstance(arguments[0], str) and arguments[0].isdigit():
        return _exactly(int(arguments[0]), [_formula(each, table, text) for each in arguments[1:]])
    if head in ("and", "or", "not", "imply"):
        parts = tuple(_formula(each, table, text) for each in arguments)
        if head == "not" and len(parts) == 1:
            return Not(parts[0])
        if head == "imply" and len(parts) == 2:
            return Imply(*parts)
        if head in ("and", "or"):
            return And(parts) if head == "and" else Or(parts)
        raise EvaluationError(f"{text!r} gives {head} {len(parts)} formulas: expected another number")
    return Atom(head, tuple(_row(each, table, text) for each in arguments))


def _exactly(count: int, parts: Sequence[Formula]) -> Formula:
    """Return the formula that holds if exactly ``count`` of the parts do."""
    rows = range(len(parts))
    return Or(
        tuple(
            And(tuple(parts[row] if row in chosen else Not(parts[row]) for row in rows))
            for chosen in itertools.combinations(rows, count)
        )
    )


def _row(node: Node, table: Sequence[str], text: str) -> str:
    if isinstance(node, str) and node.isdigit() and int(node) < len(table):
        return table[int(node)]
    raise EvaluationError(f"{text!r} is about {node!r}: expected a row of the table, 0 to {len(table) - 1}")


class _Assumed:
    """Facts by assignment."""

    def __init__(self, values: Mapping[Atom, bool]) -> None:
        self._values = values

    def holds(self, predicate: str, args: tuple[str, ...]) -> bool:
        return self._values[Atom(predicate, args)]


def is_equivalent(stated: Formula, task: Task) -> bool:
    """True if the formula and the task's goal have equal values for all assignments of their atoms, or for a sample."""
    goal = _ground(task.goal, task)
    atoms = list(dict.fromkeys((*atoms_of(stated), *atoms_of(goal))))
    rng = np.random.default_rng(0)
    assignments: Iterator[Sequence[bool]] = (
        iter(itertools.product((False, True), repeat=len(atoms)))
        if len(atoms) <= MAX_ATOMS
        else iter((rng.random((SAMPLE, len(atoms))) < rng.random((SAMPLE, 1))).tolist())
    )
    return all(
        evaluate(stated, facts, {}) is evaluate(goal, facts, {})
        for facts in (_Assumed(dict(zip(atoms, values, strict=True))) for values in assignments)
    )


def _ground(formula: Formula, task: Task) -> Formula:
    """Return the formula without quantifiers, but for pairs written out as a choice of partners."""
    match formula:
        case Not(body):
            return Not(_ground(body, task))
        case And(parts):
            return And(tuple(_ground(part, task) for part in parts))
        case Or(parts):
            return Or(tuple(_ground(part, task) for part in parts))
        case Imply(premise, conclusion):
            return Imply(_ground(premise, task), _ground(conclusion, task))
        case Quantified(Quantifier.FORPAIRS | Quantifier.FORNPAIRS):
            rows, columns, needed = pair_sides(formula, task.types)
            cells = {
                (row, column): instance(formula, row, column)
                for row in rows
                for column in columns
                if row != column
            }
            lines = [
                Or(tuple(cells[row, column] for column in columns if (row, column) in cells)) for row in rows
            ]
            files = [
                Or(tuple(cells[row, column] for row in rows if (row, column) in cells)) for column in columns
            ]
            return And((_at_least(needed, lines), _at_least(needed, files)))
        case Quantified(Quantifier.FORN, count=int(count)):
            return _exactly(count, [_ground(part, task) for part in instances(formula, task.types)])
        case Quantified(quantifier):
            found = tuple(_ground(part, task) for part in instances(formula, task.types))
            return And(found) if quantifier is Quantifier.FORALL else Or(found)
        case _:
            return formula


def _at_least(count: int, parts: Sequence[Formula]) -> Formula:
    return Or(tuple(And(chosen) for chosen in itertools.combinations(parts, min(count, len(parts)))))


def _agree_when_executed(simulator: Simulator, task: Task, stated: Formula) -> bool:
    """True if a plan for either goal also reaches the other."""
    other = replace(task, goal=stated, goal_bddl=render(stated), types={})
    return _reaches(simulator, task, other) and _reaches(simulator, other, task)


def _reaches(simulator: Simulator, task: Task, other: Task) -> bool:
    """True if a plan for the first task also reaches the goal of the other, which does not hold at the start."""
    simulator.execute(task, (), SEED)
    if evaluate(other.goal, simulator.facts, other.types):
        return False
    plan = find_plan(simulator, task)
    if isinstance(plan, PlanNotFound):
        return False
    simulator.execute(task, plan, SEED)
    return evaluate(other.goal, simulator.facts, other.types)
