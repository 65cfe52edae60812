"""Settings of a dataset build."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

DEFAULT_SCENES: Final = ("Rs_int", "Wainscott_0_int", "restaurant_diner")


class WriterKind(StrEnum):
    """Source of tasks."""

    PLAIN = "plain"  # states the goal in a bounded vocabulary that small policies can learn
    SOCIAL = "social"  # requests from simulated conversations, each with its transcript
    MODEL = "model"  # the same with a language model instead of the grammar


@dataclass(frozen=True, slots=True)
class BuildSettings:
    """Settings of a build. Equal settings give equal datasets."""

    train: int = 480
    heldout: int = 40
    seed: int = 0
    scenes: tuple[str, ...] = DEFAULT_SCENES
    writer: WriterKind = WriterKind.PLAIN
    reachability: bool = True
    """Analyse the arm's reach in each variant: about 12 s of CPU per variant."""
    physical: bool = True
    """Require that a robot carries each plan out in stepped physics: about 1 s of CPU per task."""
    shortcut_plans: int = 16
    """Plans tried against each task's instruction before it is admitted: about 5 ms of CPU per plan."""
    modelled: tuple[str, ...] = ()
    """Names of the agents, besides the writer's, that are a language model."""


SCENE_EXTRACTOR: Final = "scene-extractor"
"""Name of scene information extraction in `modelled`, for builds with a vision model."""
