"""What the REST API tells of a dataset's tasks. FastAPI evaluates these annotations: here they are no text."""

from dataclasses import dataclass, field
from typing import Any

Box = tuple[str, float, float, float, float]
"""A name, and west, south, east and north in metres."""


@dataclass(frozen=True, slots=True)
class FloorPlanView:
    """Rooms, walls and what stands about, as boxes in the world's xy plane."""

    rooms: list[Box]
    walls: list[Box]
    pieces: list[Box]
    robot: list[float]


@dataclass(frozen=True, slots=True)
class MomentView:
    """After a call; the first is the start. ``things`` are those that are elsewhere than at the start, ``active`` what the plan
    opened or switched on. Metres in the world's xy plane.
    """

    call: str
    robot: list[float]
    held: list[str] = field(default_factory=list)
    things: dict[str, list[float]] = field(default_factory=dict)
    active: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class TaskCard:
    """A task in a list. ``steps`` are those of the oracle's plan, ``objects`` rows of the object table."""

    task_id: str
    instruction: str
    category: str
    scene_id: str
    split: str
    steps: int
    objects: int
    bundle_digest: str
    picture: bool
    """Whether there is a picture of its scene."""


@dataclass(frozen=True, slots=True)
class SceneCount:
    """A scene and how many tasks are in it."""

    scene_id: str
    tasks: int


@dataclass(frozen=True, slots=True)
class SceneName:
    """What the scene in a bundle is called."""

    bundle_digest: str
    scene_id: str


@dataclass(frozen=True, slots=True)
class TaskPage:
    """Tasks from ``offset``, of ``total`` that fit what was asked for, with all scenes and categories that there are.

    ``notice`` says why there are none.
    """

    total: int
    offset: int
    items: list[TaskCard]
    scenes: list[SceneCount]
    categories: list[str]
    notice: str = ""


@dataclass(frozen=True, slots=True)
class ObjectRow:
    """A row of the object table at the start: ``size_m`` is width, depth and height, ``goal`` whether the goal names it."""

    name: str
    room: str
    where: str
    size_m: list[float]
    mass_kg: float
    states: str
    goal: bool


@dataclass(frozen=True, slots=True)
class TaskDetail:
    """One task. ``rooms`` are those to be shown, ``things`` small ones at the start, ``moments`` the oracle's plan by calls.

    ``tree`` is the layout tree of a scene that was laid out by one, else None; ``problem`` why there is no plan to be played.
    """

    card: TaskCard
    goal: str
    source: str
    profile: str
    signature: str
    rooms: list[str]
    objects: list[ObjectRow]
    transcript: str
    tree: Any
    floor: FloorPlanView
    things: dict[str, list[float]]
    moments: list[MomentView] = field(default_factory=list)
    problem: str = ""
