"""Audit of a dataset: instructions against goals, and a search for plans that succeed against the instruction."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from embomatrix.factory.admission import oracle_plan
from embomatrix.factory.evaluate.scripts import by_bundle, in_processes
from embomatrix.factory.faithfulness.instruction import audit, read_intent
from embomatrix.factory.faithfulness.monitor import PLACED
from embomatrix.factory.faithfulness.shortcuts import PlanOrigin, find_shortcuts, shortcut_in_words
from embomatrix.factory.metrics.figures import EvaluationFigures
from embomatrix.factory.scenes.view import SceneView
from embomatrix.pages.figures import Better, Figure
from embomatrix.sim.executor import Simulator
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import PlanError, parse_plan
from embomatrix.skills.prompt import Codec, situation_of, with_indices
from embomatrix.skills.syntax import Plan
from embomatrix.world.dataset import Dataset, DatasetError, TaskRecord
from embomatrix.world.json_text import parse_json
from embomatrix.world.scene import Scene
from embomatrix.world.task import Task

SHORTCUT_GOAL: Final = 0.005
MANY_PLANS: Final = 10_000
"""Plans for each base scene in a thorough search."""


@dataclass(frozen=True, slots=True)
class PolicyAnswers:
    """Texts of a policy by task id, and their form."""

    codec: Codec = Codec.JSON
    texts: Mapping[str, Sequence[str]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class TaskAudit:
    """Findings about one task.

    ``findings`` are sentences about instruction and goal, ``shortcut`` is one about the first plan that succeeds against the
    instruction; "" for none. ``swaps`` is True if a plan with another relation than the instruction's succeeds.
    """

    task: str
    findings: tuple[str, ...]
    tried: int
    succeeded: int
    shortcut: str
    placed: bool
    swaps: bool


def audit_dataset(
    folder: Path,
    records: Sequence[TaskRecord],
    *,
    plans: int,
    answers: PolicyAnswers,
    jobs: int,
    progress: Callable[[int], None] = lambda _done: None,
) -> list[TaskAudit]:
    """Audit records of a dataset, with up to ``plans`` plans for each, and call ``progress`` with the number done so far.

    Raises DatasetError if a bundle or a plan can't be read or a process dies.
    """
    found: dict[str, TaskAudit] = {}
    work = partial(_audit_bundle, folder, plans=plans, answers=answers)
    for group in in_processes(work, by_bundle(records).values(), jobs=jobs, doing="audits tasks"):
        found |= {each.task: each for each in group}
        progress(len(found))
    return [found[record.task.task_id] for record in records]


def _audit_bundle(
    folder: Path, records: Sequence[TaskRecord], *, plans: int, answers: PolicyAnswers
) -> list[TaskAudit]:
    """Audit tasks of one bundle."""
    bundle = Dataset(folder, ()).read_bundle(records[0].bundle_digest)
    view = SceneView(bundle.scene)
    with contextlib.closing(load_simulator(bundle)) as simulator:
        return [
            audit_task(
                simulator,
                view,
                record,
                plans,
                _plans_in(answers, bundle.scene, record.task),
            )
            for record in records
        ]


def audit_task(
    simulator: Simulator, view: SceneView, record: TaskRecord, plans: int, given: Sequence[Plan] = ()
) -> TaskAudit:
    """Audit one task. A task whose writer stated no intent is held to its goal and the sources that its words name.

    Raises DatasetError if the oracle's plan can't be read.
    """
    task = record.task
    intent = record.intent or read_intent(task, view)
    oracle = oracle_plan(record)
    report = find_shortcuts(simulator, task, intent, oracle, plans, given)
    return TaskAudit(
        task.task_id,
        audit(task, intent, view),
        report.tried.total(),
        report.succeeded,
        shortcut_in_words(report, task.table),
        any(clause.predicate in PLACED for clause in intent),
        any(
            shortcut.origin is PlanOrigin.RELATION or shortcut.violated.predicate in PLACED
            for shortcut in report.shortcuts
        ),
    )


def read_answers(path: Path) -> PolicyAnswers:
    """Read the stored answers of an evaluation. Raise DatasetError for another file, OSError."""
    codec, texts = Codec.JSON, dict[str, list[str]]()
    for number, line in enumerate(path.read_bytes().splitlines(), start=1):
        try:
            value = parse_json(line)
            if number == 1:
                codec = Codec(value["codec"])
            else:
                texts.setdefault(str(value["task_id"]), []).append(str(value["text"]))
        except (ValueError, TypeError, KeyError) as error:
            raise DatasetError(
                f"{path}:{number} is no answer of an evaluation ({error}): name the answers.jsonl that `embomatrix eval` wrote"
            ) from error
    return PolicyAnswers(codec, texts)


def _plans_in(answers: PolicyAnswers, scene: Scene, task: Task) -> list[Plan]:
    """Return the plans in a policy's answers. Texts without one are left out."""
    situation, plans = situation_of(scene, task), list[Plan]()
    for text in answers.texts.get(task.task_id, ()):
        named = with_indices(text, situation) if answers.codec is Codec.NAMES else text
        with contextlib.suppress(PlanError):
            plans.append(parse_plan(named, task.profile))
    return plans


def evaluation_of(audits: Sequence[TaskAudit], conditions: Mapping[str, Any]) -> EvaluationFigures:
    """Return the share of tasks with a shortcut, the number of swapped relations, and the share with findings."""
    plans, low = sum(each.tried for each in audits), Better.LOWER
    placed = [each.swaps for each in audits if each.placed]
    shares = {
        "shortcut_share": [bool(each.shortcut) for each in audits],
        "unfaithful_share": [bool(each.findings) for each in audits],
    }
    figures = [
        Figure(name, sum(held) / len(held), "share", low, len(held), SHORTCUT_GOAL)
        for name, held in shares.items()
    ]
    figures.insert(1, Figure("relation_swaps", sum(placed), "count", low, len(placed), 0.0))
    succeeded = sum(each.succeeded for each in audits)
    figures.append(Figure("plans_tried", plans, "count", Better.HIGHER, len(audits)))
    notes = (f"{succeeded:,} of {plans:,} plans succeeded.",)
    return EvaluationFigures("faithfulness", conditions, tuple(figures), notes)


def objections(audits: Sequence[TaskAudit]) -> Iterator[str]:
    """Yield a line for each finding and each shortcut."""
    for each in audits:
        for finding in each.findings:
            yield f"{each.task}: {finding}"
        if each.shortcut:
            yield f"{each.task}: {each.shortcut}"
