"""Seeds of a task's rollouts, derived from the seed of a run. Training and evaluation share none."""

import hashlib
from typing import Final

HALF: Final = 2**31
"""Seeds of evaluation are below it, those of training from it up."""


def evaluation_seed(run_seed: int, task_id: str) -> int:
    """Seed in [0, 2^31) of all rollouts of a task in an evaluation, so equal plans get equal rewards. No training uses it."""
    return _half(f"{run_seed}:{task_id}")


def training_seed(run_seed: int, task_id: str, epoch: int = 0) -> int:
    """Seed in [2^31, 2^32) of all rollouts of a task in one epoch of training."""
    return HALF + _half(f"{run_seed}:{task_id}:{epoch}")


def split_seed(split: str, run_seed: int, task_id: str) -> int:
    """Seed of all rollouts of a task of this split, ``train`` or ``heldout``, in a run without epochs."""
    return training_seed(run_seed, task_id) if split == "train" else evaluation_seed(run_seed, task_id)


def _half(text: str) -> int:
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big") >> 1
