"""Task values of the REST API. FastAPI evaluates the annotations, so they are not postponed."""

from dataclasses import dataclass, field
from typing import Any

from embomatrix.rpc.wire.training import SampledPlan

Box = tuple[str, float, float, float, float]
"""Name, then west, south, east and north edges in metres."""


@dataclass(frozen=True, slots=True)
class FloorPlanView:
    """Rooms, walls and objects as boxes in the world's xy plane."""

    rooms: list[Box]
    walls: list[Box]
    pieces: list[Box]
    robot: list[float]


@dataclass(frozen=True, slots=True)
class MomentView:
    """State after a call; the first one is the start. ``things`` are displaced objects, ``active`` objects that the
    plan opened or switched on. Positions are metres in the world's xy plane.
    """

    call: str
    robot: list[float]
    held: list[str] = field(default_factory=list)
    things: dict[str, list[float]] = field(default_factory=dict)
    active: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class TaskCard:
    """Task in a list. ``steps`` counts the oracle's calls, ``objects`` the rows of the object table."""

    task_id: str
    instruction: str
    category: str
    scene_id: str
    split: str
    steps: int
    objects: int
    bundle_digest: str
    picture: bool
    """True if there is a picture of its scene."""


@dataclass(frozen=True, slots=True)
class SceneCount:
    """Scene and its number of tasks."""

    scene_id: str
    tasks: int


@dataclass(frozen=True, slots=True)
class SceneName:
    """Name of the scene in a bundle."""

    bundle_digest: str
    scene_id: str


@dataclass(frozen=True, slots=True)
class TaskPage:
    """Page of tasks from ``offset``; ``total`` counts all matches. ``scenes`` and ``categories`` are those of the
    dataset.

    ``notice`` says why there are no tasks.
    """

    total: int
    offset: int
    items: list[TaskCard]
    scenes: list[SceneCount]
    categories: list[str]
    notice: str = ""


@dataclass(frozen=True, slots=True)
class ObjectRow:
    """Row of the object table at the start: ``size_m`` is width, depth and height; ``goal`` if the goal names it."""

    name: str
    room: str
    where: str
    size_m: list[float]
    mass_kg: float
    states: str
    goal: bool


@dataclass(frozen=True, slots=True)
class TaskDetail:
    """One task. ``rooms`` are the rooms to show, ``things`` the small objects at the start, ``moments`` a plan call by call:
    the oracle's, or that of a policy.

    ``tree`` is the layout tree of a generated scene, else None; ``problem`` says why there is no plan to show.
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


@dataclass(frozen=True, slots=True)
class SampledPlanView:
    """Plan or episode ``number`` of the ``count`` that a trainer reported with step ``step``.

    ``task`` has its moments: the start, then one for each of its steps. It is None, with the reason in ``notice``, if the
    manager does not show the task.
    """

    step: int
    number: int
    count: int
    plan: SampledPlan
    task: TaskDetail | None = None
    notice: str = ""
