"""Hierarchical reward: format, relevance and goal, with the paper's constants as defaults."""

from dataclasses import dataclass

from embomatrix.reward.breakdown import AtomResult, RewardBreakdown
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.world.evaluate import evaluate
from embomatrix.world.goal import Facts
from embomatrix.world.task import Task


@dataclass(frozen=True, slots=True)
class Fulfilment:
    """Parts of a goal that a final state fulfils, whatever they are worth."""

    atoms: tuple[AtomResult, ...]
    success: bool


def judge(task: Task, facts: Facts) -> Fulfilment:
    """Judge a final state. Raises GoalError if the goal quantifies over a type that the task does not list."""
    atoms = tuple(AtomResult(text, evaluate(atom, facts, task.types)) for atom, text in task.goal_atoms)
    return Fulfilment(atoms, evaluate(task.goal, facts, task.types))


def score(
    task: Task, touched: frozenset[str], facts: Facts, settings: RewardSettings = PAPER
) -> RewardBreakdown:
    """Return the reward of an executed plan.

    ``touched`` names the objects on which a call succeeded; ``facts`` is the final state. Raises GoalError if the goal
    quantifies over a type that the task does not list.
    """
    return worth(task, touched, judge(task, facts), settings)


def worth(
    task: Task, touched: frozenset[str], judgement: Fulfilment, settings: RewardSettings = PAPER
) -> RewardBreakdown:
    """Return the reward of an executed plan whose final state was judged."""
    relevant = len(task.goal_objects & touched)
    atoms = judgement.atoms
    satisfied = sum(atom.holds for atom in atoms)
    return RewardBreakdown(
        format=settings.format,
        relevance=min(settings.relevance_limit, settings.relevance_per_object * relevant),
        goal=settings.goal * satisfied / len(atoms) if atoms else 0.0,
        atoms=atoms,
        success=judgement.success,
    )


def unparsable(settings: RewardSettings = PAPER) -> RewardBreakdown:
    """Return the reward of a text without a plan. It was never executed, so it has no atoms."""
    return RewardBreakdown(format=settings.unparsable, relevance=0.0, goal=0.0, atoms=(), success=False)
