"""What the layout agents hand to one another: plain values, so that each agent can be run and looked at alone.

All field types are resolved at run time: pydantic reads these dataclasses at the door (``layout.doors``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import ClassVar, Final

from embomatrix.factory.scenes.editor import LayoutReason  # noqa: TC001  pydantic reads the annotation

_STRICT: Final = {"extra": "forbid"}

Size2 = tuple[float, float]
Size3 = tuple[float, float, float]


class LayoutRelation(StrEnum):
    """The nine relations of a layout tree (EmboMatrix, appendix A; OmniGibson's object states)."""

    ONTOP = "ontop"
    INSIDE = "inside"
    UNDER = "under"
    ATTACHED = "attached"
    COVERED = "covered"
    DRAPED = "draped"
    FILLED = "filled"
    OVERLAID = "overlaid"
    SATURATED = "saturated"


class RelationMethod(StrEnum):
    """What makes a relation of the tree true in a scene."""

    POSE = "pose"  # the child is placed
    FACT = "fact"  # the child is a substance, and the parent has it
    NONE = "none"  # rigid bodies can't: it takes cloth


RELATION_METHODS: Final = {
    LayoutRelation.ONTOP: RelationMethod.POSE,
    LayoutRelation.INSIDE: RelationMethod.POSE,
    LayoutRelation.UNDER: RelationMethod.POSE,
    LayoutRelation.COVERED: RelationMethod.FACT,
    LayoutRelation.FILLED: RelationMethod.FACT,
    LayoutRelation.SATURATED: RelationMethod.FACT,
    LayoutRelation.ATTACHED: RelationMethod.POSE,
    LayoutRelation.DRAPED: RelationMethod.NONE,
    LayoutRelation.OVERLAID: RelationMethod.NONE,
}


class PlacementClass(StrEnum):
    """Where objects of a sort belong."""

    GOODS = "goods"  # on and in furniture
    FURNITURE = "furniture"  # on the floor
    HUNG = "hung"  # on a wall
    OVERHEAD = "overhead"  # under the ceiling


@dataclass(frozen=True, slots=True)
class LayoutFailure:
    """A thing that could not be where a tree said; what the organizer hears of it in the next round."""

    object_name: str
    relation: LayoutRelation
    host: str
    reason: LayoutReason
    detail: str
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class LayoutRoomFacts:
    """A room, its floor in metres along the world's x and y, and the categories of what can hold objects there, one by one."""

    name: str
    type: str
    size_m: Size2
    furniture: tuple[str, ...] = ()
    __pydantic_config__: ClassVar = _STRICT

    @property
    def area_m2(self) -> float:
        return self.size_m[0] * self.size_m[1]


@dataclass(frozen=True, slots=True)
class ObjectBrief:
    """An object that a task brings. What is empty is left to the agents.

    ``size_m`` is the extent along the asset's x (depth), y (width) and z; ``has_front`` says that it matters where its front,
    +x, looks. ``relation`` and ``host`` are what the task's start demands, ``rooms`` where it may be; ``beside`` are objects
    that it must stand next to.
    """

    name: str
    category: str
    size_m: Size3
    rooms: tuple[str, ...] = ()
    relation: LayoutRelation | None = None
    host: str = ""
    beside: tuple[str, ...] = ()
    has_front: bool = False
    kind: PlacementClass = PlacementClass.GOODS
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class DistributionBrief:
    """What the Scene-level Distribution Agent decides on. ``homes`` are the rooms of objects that are there already."""

    rooms: tuple[LayoutRoomFacts, ...]
    objects: tuple[ObjectBrief, ...]
    homes: dict[str, str] = field(default_factory=dict)
    seed: int = 0
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class Distribution:
    """The room of each thing, and why, in a few words."""

    rooms: dict[str, str]
    reasons: dict[str, str] = field(default_factory=dict)
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class HostOffer:
    """One way to put objects at a piece of furniture: on its open surfaces, in its cavities, under it.

    ``spaces_m`` are the spaces there: extents along the host's x and y and the free height; ``height_m`` is that of the lowest
    above the floor.
    """

    relation: LayoutRelation
    spaces_m: tuple[Size3, ...]
    height_m: float
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class HostFacts:
    """An object of a room that can hold others. ``contents`` are the categories of what it holds already."""

    name: str
    category: str
    offers: tuple[HostOffer, ...]
    contents: tuple[str, ...] = ()
    shut: bool = False
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class RoomBrief:
    """What the Room-level Organization Agent decides on: objects assigned to a room, what could hold them, what has failed."""

    room: LayoutRoomFacts
    hosts: tuple[HostFacts, ...]
    objects: tuple[ObjectBrief, ...]
    failures: tuple[LayoutFailure, ...] = ()
    seed: int = 0
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class Branch:
    """One edge of a layout tree: the child is in the relation to the parent, as in ``ontop(child, parent)``."""

    parent: str
    relation: LayoutRelation
    child: str
    __pydantic_config__: ClassVar = _STRICT


class ConstraintKind(StrEnum):
    """Constraints on a plane (EmboMatrix, appendix A, after Holodeck). ``edge`` and ``middle`` are about the plane alone."""

    EDGE = "edge"
    MIDDLE = "middle"
    NEAR = "near"
    FAR = "far"
    IN_FRONT_OF = "in_front_of"
    SIDE_OF = "side_of"
    CENTER_ALIGNED = "center_aligned"
    FACE_TO = "face_to"
    NEXT_TO = "next_to"


PLANE_CONSTRAINTS: Final = frozenset({ConstraintKind.EDGE, ConstraintKind.MIDDLE})


@dataclass(frozen=True, slots=True)
class PlacementConstraint:
    """A constraint on a thing, against another object of the plane; ``required`` ones must hold."""

    kind: ConstraintKind
    other: str = ""
    required: bool = False
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class ConstraintBrief:
    """What shares a plane: objects to be put there, and names and categories of what is there already.

    ``host`` is the category of the furniture whose plane it is; ``on_floor`` tells the floor of a room.
    """

    plane: str
    host: str
    objects: tuple[ObjectBrief, ...]
    others: tuple[tuple[str, str], ...] = ()
    on_floor: bool = False
    seed: int = 0
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class PlacementConstraints:
    """Constraints by thing, the most important first."""

    of: dict[str, tuple[PlacementConstraint, ...]]
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class PlaneFootprint:
    """A box that stands on a plane, in the plane's frame: its centre, its yaw, extents along its own x and y, heights over it.

    Its front looks along its own +x.
    """

    name: str
    center_m: Size2
    yaw: float
    size_m: Size2
    low_m: float
    high_m: float
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class PlaneThing:
    """A thing to be put on a plane, with its constraints, the most important first."""

    name: str
    size_m: Size3
    constraints: tuple[PlacementConstraint, ...] = ()
    has_front: bool = False
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class PlaneBrief:
    """What the Planar-Level Placement Generator decides on, in the plane's frame: origin in its middle, metres, radians.

    ``obstacles`` stand on the plane or reach into the space over it, and constraints may name them; ``zones`` are rectangles
    (x0, y0, x1, y1) that stay clear. ``stands`` are spots on the floor where the robot can stand; empty: reach is not asked.
    ``rim_m`` is the free strip at the plane's edge. ``on_floor`` tells the floor of a room.
    """

    plane: str
    size_m: Size2
    objects: tuple[PlaneThing, ...]
    obstacles: tuple[PlaneFootprint, ...] = ()
    zones: tuple[tuple[float, float, float, float], ...] = ()
    stands: tuple[Size2, ...] = ()
    rim_m: float = 0.01
    on_floor: bool = False
    seed: int = 0
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class PlaneSpot:
    """Where a thing's middle goes on a plane, how it is turned, and which of its constraints hold there."""

    object_name: str
    center_m: Size2
    yaw: float
    held: tuple[PlacementConstraint, ...] = ()
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class SampleBrief:
    """What the Object-level Sampling Agent decides on: one model of a category, any where empty, at a host of a base scene.

    Without a relation the host is a room, on whose floor it goes.
    """

    scene: str
    category: str
    host: str
    relation: LayoutRelation | None = None
    model: str = ""
    seed: int = 0
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class SampledPose:
    """A pose in the world, or why there is none."""

    name: str = ""
    position_m: Size3 | None = None
    quat_xyzw: tuple[float, float, float, float] | None = None
    room: str = ""
    reason: LayoutReason | None = None
    detail: str = ""
    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class PlaneArrangement:
    """One joint arrangement of a plane's objects with its score, and what found no place, with the reason."""

    spots: tuple[PlaneSpot, ...]
    score: float
    left_out: dict[str, LayoutReason] = field(default_factory=dict)
    __pydantic_config__: ClassVar = _STRICT
