"""Objects to lay out, the agents that decide, and the result of a layout."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.furnish.roles import FurnitureRole, role_of
from embomatrix.factory.layout.constraints import choose_constraints
from embomatrix.factory.layout.distribution import distribute
from embomatrix.factory.layout.organization import LayoutTree, organize
from embomatrix.factory.layout.planar import arrange
from embomatrix.factory.layout.values import (
    ConstraintBrief,
    Distribution,
    DistributionBrief,
    LayoutFailure,
    LayoutRelation,
    ObjectBrief,
    PlacementClass,
    PlacementConstraints,
    PlaneArrangement,
    PlaneBrief,
    RoomBrief,
)
from embomatrix.factory.scenes.editor import LayoutReason
from embomatrix.world.asset import Asset
from embomatrix.world.catalog import Catalog

_FRONTED: Final = (
    "alarm_clock picture_frame radio laptop monitor microwave toaster toaster_oven coffee_maker printer standing_tv "
    "cash_register desk_phone digital_camera loudspeaker table_lamp keyboard teddy_bear"
)
HAS_FRONT: Final = frozenset(_FRONTED.split())
"""Small objects and appliances whose front direction matters. For furniture it always matters."""


_KINDS: Final = {
    FurnitureRole.SURFACE: PlacementClass.GOODS,
    FurnitureRole.FITTED: PlacementClass.GOODS,
    FurnitureRole.WALL: PlacementClass.HUNG,
    FurnitureRole.HUNG_CABINET: PlacementClass.HUNG,
    FurnitureRole.CEILING: PlacementClass.OVERHEAD,
}
"""Placement class of furniture roles that don't stand on the floor."""


@dataclass(frozen=True, slots=True)
class RequestedObject:
    """Object that a task adds to a scene. ``models`` lists (category, model) pairs, the best first.

    ``relation`` and ``host`` are demanded by the task; the host is another requested object, a scene object, or a
    room for its floor. None and an empty string leave the choice to the agents. ``rooms`` lists the allowed rooms;
    empty means all. ``beside`` lists the objects that it must stand next to. ``imported`` holds the scene's imported models by
    asset id; they take the place of generated ones.
    """

    name: str
    models: tuple[tuple[str, str], ...]
    relation: LayoutRelation | None = None
    host: str = ""
    rooms: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()
    imported: Mapping[str, Asset] = field(default_factory=dict)

    def asset(self, choice: int) -> Asset:
        """Return the asset of a model. Raise IndexError for an unknown choice."""
        category, model = self.models[choice]
        return self.imported.get(f"{category}-{model}") or build_asset(Catalog.load(), category, model)

    def failure(self, host: str, reason: LayoutReason, detail: str) -> LayoutFailure:
        """Return a failure of this object at ``host``, in the demanded relation or else on top."""
        return LayoutFailure(self.name, self.relation or LayoutRelation.ONTOP, host, reason, detail)


def object_brief(item: RequestedObject, asset: Asset, names: Mapping[str, str]) -> ObjectBrief:
    """Return the brief of a requested object. ``names`` maps the objects placed so far to scene names."""
    kind = placement_class_of(asset)
    x, y, z = asset.size_m
    return ObjectBrief(
        name=item.name,
        category=asset.category,
        size_m=(round(x, 3), round(y, 3), round(z, 3)),
        rooms=item.rooms,
        relation=item.relation,
        host=names.get(item.host, item.host),
        beside=tuple(names.get(other, other) for other in item.beside),
        has_front=kind is PlacementClass.FURNITURE or asset.category in HAS_FRONT,
        kind=kind,
    )


def placement_class_of(asset: Asset) -> PlacementClass:
    """Return the placement class of an asset, from its furniture role."""
    return _KINDS.get(role_of(asset.category, asset.size_m, asset.mass_kg), PlacementClass.FURNITURE)


@dataclass(frozen=True, slots=True)
class LayoutAgents:
    """Agents of a layout, named as in the paper. Each is a function of its brief; the defaults are rules."""

    distribute: Callable[[DistributionBrief], Distribution] = distribute
    """Scene-level Distribution Agent."""
    organize: Callable[[RoomBrief], LayoutTree] = organize
    """Room-level Organization Agent."""
    choose_constraints: Callable[[ConstraintBrief], PlacementConstraints] = choose_constraints
    """Planar-Level Placement Generator: choice of constraints."""
    arrange: Callable[[PlaneBrief], tuple[PlaneArrangement, ...]] = arrange
    """Planar-Level Placement Generator: solver."""


@dataclass(slots=True)
class LayoutRecord:
    """Briefs and answers of all agents in call order. Each brief can be replayed with ``factory agent``."""

    distribution: tuple[DistributionBrief, Distribution] | None = None
    rooms: list[tuple[RoomBrief, LayoutTree]] = field(default_factory=list)
    constraints: list[tuple[ConstraintBrief, PlacementConstraints]] = field(default_factory=list)
    planes: list[tuple[PlaneBrief, tuple[PlaneArrangement, ...]]] = field(default_factory=list)
    planar_s: dict[str, float] = field(default_factory=dict)
    """CPU seconds of the planar solver, by room."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Result of a layout: scene names by object, trees by room, and a failure for each object left out.

    ``unreachable`` lists placed objects that the robot can't reach. No better place was found for them.
    """

    names: Mapping[str, str]
    trees: Mapping[str, LayoutTree]
    failures: tuple[LayoutFailure, ...]
    record: LayoutRecord
    unreachable: tuple[LayoutFailure, ...] = ()
