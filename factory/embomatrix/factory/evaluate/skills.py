"""Skills that the tasks of a dataset need: without their calls, the oracle's plan no longer reaches the goal."""

import contextlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from embomatrix.factory.admission import SEED, oracle_plan
from embomatrix.factory.evaluate.scripts import by_bundle, in_processes
from embomatrix.factory.metrics.figures import EvaluationError, EvaluationFigures
from embomatrix.pages.figures import Better, Figure
from embomatrix.sim.executor import Simulator
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.syntax import PROFILES, PlaceRelation, Plan, Skill
from embomatrix.world.dataset import Dataset, TaskRecord
from embomatrix.world.evaluate import evaluate
from embomatrix.world.task import Profile, Task

SHARE_GOAL: Final = 0.05
"""Smallest share of a dataset's tasks that should need each skill."""
UNNEEDED: Final[Mapping[Skill, str]] = {
    Skill.TURN: "`move` faces the object",
    Skill.MOVE_FORWARD: "`move` finds the way to every object",
    Skill.GO_TO_ROOM: "`move` drives through doors, and no goal is about where the robot stands",
    Skill.HEAT: "a running source heats what is in or on it at once; the call only waits",
    Skill.COOK: "a running source cooks what is in or on it at once; the call only waits",
    Skill.FREEZE: "a closed freezer freezes what is in it at once; the call only waits",
}
"""Skills that no goal needs, with the reason. Tasks are not bent to need them."""


@dataclass(frozen=True, slots=True)
class NeededSkills:
    """Skills that one task needs, and relations of ``place`` that it needs.

    ``proved`` is False if the oracle's plan itself does not reach the goal.
    """

    task: str
    profile: Profile
    proved: bool
    skills: frozenset[Skill]
    relations: frozenset[PlaceRelation]


def needed_in_dataset(
    folder: Path,
    records: Sequence[TaskRecord],
    jobs: int,
    progress: Callable[[int], None] = lambda _done: None,
) -> list[NeededSkills]:
    """Return the needs of records of a dataset, and call ``progress`` with the number done so far.

    Raises DatasetError if a bundle or a plan can't be read or a process dies.
    """
    found: list[NeededSkills] = []
    work = partial(_needed_in_bundle, folder)
    for group in in_processes(work, by_bundle(records).values(), jobs=jobs, doing="executes plans"):
        found += group
        progress(len(found))
    return found


def _needed_in_bundle(folder: Path, records: Sequence[TaskRecord]) -> list[NeededSkills]:
    """Return the needs of tasks of one bundle."""
    bundle = Dataset(folder, ()).read_bundle(records[0].bundle_digest)
    with contextlib.closing(load_simulator(bundle)) as simulator:
        return [needed_skills(simulator, record.task, oracle_plan(record)) for record in records]


def needed_skills(simulator: Simulator, task: Task, plan: Plan) -> NeededSkills:
    """Execute a plan without the calls of each of its skills, and without the place calls of each relation."""
    if not _succeeds(simulator, task, plan):
        return NeededSkills(task.task_id, task.profile, False, frozenset(), frozenset())
    skills = dict.fromkeys(call.skill for call in plan)
    relations = dict.fromkeys(call.relation for call in plan if call.relation is not None)
    return NeededSkills(
        task.task_id,
        task.profile,
        True,
        frozenset(
            skill
            for skill in skills
            if not _succeeds(simulator, task, tuple(call for call in plan if call.skill is not skill))
        ),
        frozenset(
            relation
            for relation in relations
            if not _succeeds(simulator, task, tuple(call for call in plan if call.relation is not relation))
        ),
    )


def _succeeds(simulator: Simulator, task: Task, plan: Plan) -> bool:
    """True if the goal holds where the plan ends: after its last call, or at its first failure."""
    simulator.execute(task, plan, SEED)
    return evaluate(task.goal, simulator.facts, task.types)


def evaluate_skills(folder: Path, needs: Sequence[NeededSkills]) -> EvaluationFigures:
    """Return the share of tasks that need each skill, the smallest of these shares, and the shares of relations.

    The smallest share is that of the skills that goals can need, in the profiles of the dataset. Raises EvaluationError
    without tasks.
    """
    if not needs:
        raise EvaluationError(f"{folder} has no tasks: build some with `embomatrix factory build`")
    offered = dict.fromkeys(skill for each in needs for skill in PROFILES[each.profile])
    shares = {
        skill: _share([each.skills for each in needs], skill)
        for skill in Skill
        if skill in offered and skill not in UNNEEDED
    }
    n = len(needs)
    figures = (
        Figure("skill_share_min", min(shares.values()), "share", Better.HIGHER, n, SHARE_GOAL),
        *(
            Figure(f"skill_share {skill}", share, "share", Better.HIGHER, n)
            for skill, share in shares.items()
        ),
        *(
            Figure(
                f"skill_share place {relation}",
                _share([each.relations for each in needs], relation),
                "share",
                Better.HIGHER,
                n,
            )
            for relation in PlaceRelation
        ),
    )
    return EvaluationFigures("skills", {"dataset": folder.name, "tasks": n}, figures, tuple(_notes(needs)))


def _share(sets: Sequence[Collection[str]], item: str) -> float:
    return sum(item in each for each in sets) / len(sets)


def _notes(needs: Sequence[NeededSkills]) -> Iterator[str]:
    """Yield a note about skills without a figure, and one about plans that fail."""
    surprising = sorted({skill for each in needs for skill in each.skills} & UNNEEDED.keys())
    yield f"No goal needs {', '.join(skill for skill in UNNEEDED if skill not in surprising)}."
    if surprising:
        yield f"Needed all the same: {', '.join(surprising)}."
    failed = sum(not each.proved for each in needs)
    if failed:
        yield f"{failed} of {len(needs)} oracle plans do not reach their goal; their tasks count as needing nothing."
