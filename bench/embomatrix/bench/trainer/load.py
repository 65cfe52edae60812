"""One load for two trainers: the same prompts in words, the same shape of model, the same groups, one thread."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.skills.prompt import Codec, limited, prompt_for
from embomatrix.skills.syntax import PROFILES, PlaceRelation
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.world.task import Profile

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from embomatrix.trainer.data.tasks import TrainingTask

END: Final = "<end>"
UNKNOWN: Final = "<unknown>"
ROWS: Final = 16


@dataclass(frozen=True, slots=True)
class Load:
    """A step samples ``group`` plans of ``new`` tokens for each of ``tasks`` prompts and learns from all of them at once.

    ``words`` are the vocabulary. ``steps`` are measured after ``unmeasured`` ones, in which libraries warm up.
    """

    prompts: tuple[str, ...]
    words: tuple[str, ...]
    tasks: int = 4
    group: int = 8
    new: int = 48
    steps: int = 5
    unmeasured: int = 1
    layers: int = 4
    width: int = 256
    heads: int = 4
    inner: int = 672
    seed: int = 0


def load_of(tasks: Sequence[TrainingTask]) -> Load:
    """The load that these tasks make, told in lines."""
    prompts = [prompt_for(limited(task.situation, ROWS), Codec.LINES) for task in tasks]
    texts = tuple(f"{prompt.system}\n\n{prompt.user}\nPlan:\n" for prompt in prompts)
    skills = [skill.value for skill in PROFILES[Profile.PAPER]]
    words = dict.fromkeys(word for text in texts for word in text.split())
    words |= dict.fromkeys([*skills, *(relation.value for relation in PlaceRelation)])
    return Load(texts, (UNKNOWN, END, *words))


def write_load(path: Path, load: Load) -> None:
    """Write it for the two processes. Raises OSError."""
    path.write_text(json.dumps(asdict(load)), encoding="utf-8")


def read_load(path: Path) -> Load:
    """What ``write_load`` wrote. Raises TrainerError."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
        return Load(**{**value, "prompts": tuple(value["prompts"]), "words": tuple(value["words"])})
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainerError(f"{path} is no load of `embomatrix bench trainer` ({error})") from error
