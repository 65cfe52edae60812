"""Briefs and answers of the layout agents, as plain values. Each agent can be run on a brief alone.

Field types are resolved at run time, because pydantic reads these dataclasses in ``layout.agent_interfaces``.
"""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final, TypeVar, dataclass_transform

from pydantic import ConfigDict, with_config

from embomatrix.factory.scenes.editor import LayoutReason

T = TypeVar("T")


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def _value(cls: type[T]) -> type[T]:
    """Make a class a frozen dataclass whose JSON form rejects unknown fields."""
    return with_config(ConfigDict(extra="forbid"))(dataclass(frozen=True, slots=True)(cls))


Size2 = tuple[float, float]
Size3 = tuple[float, float, float]


class LayoutRelation(StrEnum):
    """Relation between two objects of a layout tree (EmboMatrix, appendix A; OmniGibson's object states)."""

    ONTOP = "ontop"
    INSIDE = "inside"
    UNDER = "under"
    ATTACHED = "attached"
    COVERED = "covered"
    DRAPED = "draped"
    FILLED = "filled"
    OVERLAID = "overlaid"
    SATURATED = "saturated"


CLOTH_RELATIONS: Final = frozenset({LayoutRelation.DRAPED, LayoutRelation.OVERLAID})
"""Relations that need cloth. Rigid bodies can't fulfil them."""


class PlacementClass(StrEnum):
    """Part of a room in which objects of a category stand."""

    GOODS = "goods"  # on and in furniture
    FURNITURE = "furniture"  # on the floor
    HUNG = "hung"  # on a wall
    OVERHEAD = "overhead"  # under the ceiling


@_value
class LayoutFailure:
    """Object that could not be placed as a tree demands. The organizer gets it in the brief of its next round."""

    object_name: str
    relation: LayoutRelation
    host: str
    reason: LayoutReason
    detail: str


@_value
class LayoutRoomFacts:
    """Facts about a room: floor size along the world's x and y axes, and the category of each object that can hold others."""

    name: str
    type: str
    size_m: Size2
    furniture: tuple[str, ...] = ()

    @property
    def area_m2(self) -> float:
        return self.size_m[0] * self.size_m[1]


@_value
class ObjectBrief:
    """Object that a task adds to the scene. Empty fields are decided by the agents.

    ``size_m`` is the extent along the asset's x (depth), y (width) and z axes. ``has_front`` is true if the direction
    of its front, +x, matters. ``relation`` and ``host`` are demanded by the task's start. ``rooms`` lists the allowed
    rooms, and ``beside`` the objects that it must stand next to.
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


@_value
class DistributionBrief:
    """Brief of the Scene-level Distribution Agent. ``homes`` gives the rooms of the scene's own objects that the task names."""

    rooms: tuple[LayoutRoomFacts, ...]
    objects: tuple[ObjectBrief, ...]
    homes: dict[str, str] = field(default_factory=dict)
    seed: int = 0


@_value
class Distribution:
    """Room of each object, and a short reason for it."""

    rooms: dict[str, str]
    reasons: dict[str, str] = field(default_factory=dict)


@_value
class HostOffer:
    """Relation that a piece of furniture offers to objects: on its open surfaces, in its cavities, or under it.

    ``spaces_m`` lists the free spaces as extents along the host's x and y axes and free height. ``height_m`` is the
    height of the lowest space above the floor.
    """

    relation: LayoutRelation
    spaces_m: tuple[Size3, ...]
    height_m: float


@_value
class HostFacts:
    """Object of a room that can hold others. ``contents`` lists the categories of the objects that it holds."""

    name: str
    category: str
    offers: tuple[HostOffer, ...]
    contents: tuple[str, ...] = ()
    closed: bool = False


@_value
class RoomBrief:
    """Brief of the Room-level Organization Agent: objects of a room, possible hosts, and earlier failures."""

    room: LayoutRoomFacts
    hosts: tuple[HostFacts, ...]
    objects: tuple[ObjectBrief, ...]
    failures: tuple[LayoutFailure, ...] = ()
    seed: int = 0


@_value
class Branch:
    """Edge of a layout tree: the child is in the relation to the parent, as in ``ontop(child, parent)``."""

    parent: str
    relation: LayoutRelation
    child: str


class ConstraintKind(StrEnum):
    """Kind of a placement constraint (EmboMatrix, appendix A, after Holodeck).

    ``edge`` and ``middle`` refer to the plane alone.
    """

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


@_value
class PlacementConstraint:
    """Constraint on an object relative to another object of the plane. ``required`` constraints must hold."""

    kind: ConstraintKind
    other: str = ""
    required: bool = False


@_value
class ConstraintBrief:
    """Brief for the choice of placement constraints: objects to place on a plane, and name and category of those on it.

    ``host`` is the category of the furniture that the plane belongs to. ``on_floor`` is true for the floor of a room.
    """

    plane: str
    host: str
    objects: tuple[ObjectBrief, ...]
    others: tuple[tuple[str, str], ...] = ()
    on_floor: bool = False
    seed: int = 0


@_value
class PlacementConstraints:
    """Placement constraints by object, the most important first."""

    of: dict[str, tuple[PlacementConstraint, ...]]


@_value
class PlaneFootprint:
    """Box on a plane, in the plane's frame: centre, yaw, extents along its own x and y axes, and heights above the plane.

    Its front points along its own +x axis.
    """

    name: str
    center_m: Size2
    yaw: float
    size_m: Size2
    low_m: float
    high_m: float


@_value
class PlaneObject:
    """Object to place on a plane, with its constraints, the most important first."""

    name: str
    size_m: Size3
    constraints: tuple[PlacementConstraint, ...] = ()
    has_front: bool = False


@_value
class PlaneBrief:
    """Brief of the planar solver, in the plane's frame: origin in the middle, metres, radians.

    ``obstacles`` stand on the plane or reach into the space above it; constraints may name them. ``zones`` are
    rectangles (x0, y0, x1, y1) that stay free. ``stands`` are floor positions of the robot; if empty, reach is not
    checked. ``rim_m`` is the free strip at the plane's edge. ``on_floor`` is true for the floor of a room.
    """

    plane: str
    size_m: Size2
    objects: tuple[PlaneObject, ...]
    obstacles: tuple[PlaneFootprint, ...] = ()
    zones: tuple[tuple[float, float, float, float], ...] = ()
    stands: tuple[Size2, ...] = ()
    rim_m: float = 0.01
    on_floor: bool = False
    seed: int = 0


@_value
class PlaneSpot:
    """Centre and yaw of an object on a plane, with the constraints that hold there."""

    object_name: str
    center_m: Size2
    yaw: float
    held: tuple[PlacementConstraint, ...] = ()


@_value
class SampleBrief:
    """Brief of the Object-level Sampling Agent: a model of a category, to place at a host of a base scene.

    An empty model means any model. Without a relation, the host is a room and the object stands on its floor.
    """

    scene: str
    category: str
    host: str
    relation: LayoutRelation | None = None
    model: str = ""
    seed: int = 0


@_value
class SampledPose:
    """Pose in the world frame, or the reason for its absence."""

    name: str = ""
    position_m: Size3 | None = None
    quat_xyzw: tuple[float, float, float, float] | None = None
    room: str = ""
    reason: LayoutReason | None = None
    detail: str = ""


@_value
class PlaneArrangement:
    """Joint arrangement of a plane's objects with its score, and the reason for each object left out."""

    spots: tuple[PlaneSpot, ...]
    score: float
    left_out: dict[str, LayoutReason] = field(default_factory=dict)
