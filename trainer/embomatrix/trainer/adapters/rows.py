"""Dataset rows for other trainers: the prompt, and the key by which the reward finds the task."""

import os
from pathlib import Path
from typing import Any

from embomatrix.skills.prompt import Codec, Situation, prompt_for
from embomatrix.starter.options import DATASET_VARIABLE
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.data.tasks import TrainingTask, load_tasks

SOURCE = "embomatrix"


def messages(situation: Situation, codec: Codec = Codec.JSON) -> list[dict[str, str]]:
    """Prompt of a task as chat messages."""
    prompt = prompt_for(situation, codec)
    return [{"role": "system", "content": prompt.system}, {"role": "user", "content": prompt.user}]


def prompt_rows(dataset: str | Path, split: str = "train", codec: Codec = Codec.JSON) -> list[dict[str, Any]]:
    """``{"prompt": messages, "task_id": id}`` for each task of a split, for TRL. Raises TrainerError."""
    return [
        {"prompt": messages(task.situation, codec), "task_id": task.task.task_id}
        for task in tasks_of(dataset, split)
    ]


def verl_rows(dataset: str | Path, split: str = "train", codec: Codec = Codec.JSON) -> list[dict[str, Any]]:
    """Rows in the format of verl's datasets. The ground truth is the task's id. Raises TrainerError."""
    return [
        {
            "data_source": SOURCE,
            "prompt": messages(task.situation, codec),
            "ability": task.task.category.value,
            "reward_model": {"style": "rule", "ground_truth": task.task.task_id},
            "extra_info": {"split": split, "index": index},
        }
        for index, task in enumerate(tasks_of(dataset, split))
    ]


def dataset_named(given: str, option: str) -> str:
    """Return the dataset's folder: the given one, or else the variable's. Raises TrainerError, which names ``option``."""
    found = given or os.environ.get(DATASET_VARIABLE, "")
    if not found:
        raise TrainerError(
            f"{DATASET_VARIABLE} is not set: set it to the dataset's folder{option and f', or pass {option}'}"
        )
    return found


def tasks_of(dataset: str | Path, split: str) -> tuple[TrainingTask, ...]:
    """Tasks of a dataset's split. Raises TrainerError."""
    tasks = load_tasks(Path(dataset))
    splits = {"train": tasks.train, "heldout": tasks.heldout}
    if split not in splits:
        raise TrainerError(f"a dataset has no split {split!r}: expected {' or '.join(splits)}")
    return splits[split]
