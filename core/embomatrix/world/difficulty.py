"""Difficulty of a task, as measured: which scripts solve it, and how long the oracle's plan is."""

import hashlib
from dataclasses import dataclass
from enum import StrEnum


class DifficultyLevel(StrEnum):
    """Level of a task, by the weakest script that solves it from the words alone."""

    EASY = "easy"
    """The demands of the most similar training instruction solve it."""
    MEDIUM = "medium"
    """Only a script that knows all phrases of the training split solves it."""
    HARD = "hard"
    """Neither script solves it."""


@dataclass(frozen=True, slots=True)
class Difficulty:
    """Success of three scripts, number of steps of the oracle's plan, and success share of a small policy if it was measured.

    ``template`` and ``nearest`` read the instruction; ``greedy`` knows the goal.
    """

    template: bool
    nearest: bool
    greedy: bool
    steps: int
    small_policy: float | None = None

    @property
    def level(self) -> DifficultyLevel:
        if self.nearest:
            return DifficultyLevel.EASY
        return DifficultyLevel.MEDIUM if self.template else DifficultyLevel.HARD


def shuffle_key(task_id: str) -> bytes:
    """Sort key that shuffles tasks in the same way everywhere, whatever the order of their names."""
    return hashlib.sha256(task_id.encode()).digest()
