"""What decides a build of a data set."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from embomatrix.world.catalog import Catalog

DEFAULT_SCENES: Final = ("Rs_int", "Wainscott_0_int", "restaurant_diner")


class WriterKind(StrEnum):
    """Where tasks come from."""

    PLAIN = "plain"  # what a goal says, in a bounded vocabulary: small policies learn from it
    SOCIAL = "social"  # what people come to ask for in conversations, each with its transcript
    MODEL = "model"  # the same with a language model in the place of the grammar


@dataclass(frozen=True, slots=True)
class BuildSettings:
    """What decides a build: equal settings give equal data sets."""

    train: int = 480
    heldout: int = 40
    seed: int = 0
    scenes: tuple[str, ...] = DEFAULT_SCENES
    writer: WriterKind = WriterKind.PLAIN
    look_ahead: bool = True
    """Whether to find out what the arm can do in each variant: about 12 s of CPU for one."""
    physical: bool = True
    """Whether a robot must carry each plan out in stepped physics before its task is admitted: about 1 s of CPU for one."""
    modelled: tuple[str, ...] = ()
    """Agents that are a language model besides the writer's, by name: those of the layout, and what looks at scenes."""


SCENE_EXTRACTOR: Final = "scene-extractor"
"""Scene information extraction, in `modelled` where a model that sees does it."""
EVERY_SCENE: Final = "all"


def scene_ids(asked: list[str] | None) -> tuple[str, ...]:
    """The scenes asked for, without repetition; "all" stands for every base scene of the catalog, nothing for three."""
    if asked and EVERY_SCENE in asked:
        return Catalog.load().scene_ids
    return tuple(dict.fromkeys(asked or DEFAULT_SCENES))
