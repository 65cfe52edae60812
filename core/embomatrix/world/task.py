"""Tasks: an instruction and a goal in a scene, and the table of objects that a plan may name."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import Final

from embomatrix.world.evaluate import objects_of, render, scored_atoms
from embomatrix.world.goal import Formula

MAX_NAME: Final = 200
"""Characters of the name of a task, a scene, an object or a room."""
MAX_TASKS: Final = 1_000
"""Tasks of one bundle."""
MAX_TABLE: Final = 60
"""Largest number of rows in a task's object table: more do not fit a prompt."""


class TaskCategory(StrEnum):
    """The paper's four kinds of task."""

    PICK_AND_PLACE = "pick_and_place"
    APPLIANCE_USE = "appliance_use"
    KITCHEN_OPERATION = "kitchen_operation"
    COMPOUND = "compound"

    @property
    def words(self) -> str:
        """Name for people, the same on every page and in every report."""
        return self.value.replace("_", " ")


class Profile(StrEnum):
    """Skills that a task's plans may use: the paper's thirteen, or three more for cutting, cleaning and wetting."""

    PAPER = "paper"
    HOUSEHOLD = "household"


@dataclass(frozen=True)
class Task:
    """Goal for the robot in a scene. All names are names of scene objects or rooms.

    ``goal`` is ground except for its quantifiers, which range over ``types``: object names by synset. ``table`` is the object
    table: a plan's ``object_index`` is a row of it, and its order reveals nothing about the goal. ``goal_bddl`` is the same
    goal as text. ``source`` is the task's origin ("society", "writer", "behavior-1k", "embomatrix", "eai",
    "file").
    """

    task_id: str
    scene_id: str
    instruction: str
    category: TaskCategory
    goal: Formula
    goal_bddl: str
    table: tuple[str, ...]
    types: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    source: str = "writer"
    profile: Profile = Profile.PAPER

    @cached_property
    def index_of(self) -> Mapping[str, int]:
        return {name: index for index, name in enumerate(self.table)}

    @cached_property
    def goal_objects(self) -> frozenset[str]:
        """Objects that the goal is about. Raises GoalError for a quantifier over an unknown type."""
        return objects_of(self.goal, self.types)

    @cached_property
    def goal_atoms(self) -> tuple[tuple[Formula, str], ...]:
        """Scored sub-goals, each with its text. Raises GoalError as ``goal_objects`` does."""
        return tuple((atom, render(atom)) for atom in scored_atoms(self.goal, self.types))
