"""What is to be laid out, who does it, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.furnish.roles import FurnitureRole, role_of
from embomatrix.factory.layout.constraints import choose_constraints
from embomatrix.factory.layout.distribution import distribute
from embomatrix.factory.layout.organization import organize
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
from embomatrix.world.catalog import Catalog

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from embomatrix.factory.layout.organization import LayoutTree
    from embomatrix.factory.scenes.editor import LayoutReason
    from embomatrix.world.asset import Asset

_FRONTED: Final = (
    "alarm_clock picture_frame radio laptop monitor microwave toaster toaster_oven coffee_maker printer standing_tv "
    "cash_register desk_phone digital_camera loudspeaker table_lamp keyboard teddy_bear"
)
HAS_FRONT: Final = frozenset(_FRONTED.split())
"""Small objects and appliances of which it matters where their front looks; of furniture it always does."""


_KINDS: Final = {
    FurnitureRole.SURFACE: PlacementClass.GOODS,
    FurnitureRole.FITTED: PlacementClass.GOODS,
    FurnitureRole.WALL: PlacementClass.HUNG,
    FurnitureRole.HUNG_CABINET: PlacementClass.HUNG,
    FurnitureRole.CEILING: PlacementClass.OVERHEAD,
}
"""Roles of what does not stand on the floor."""


@dataclass(frozen=True, slots=True)
class RequestedObject:
    """An object that a task brings into a scene. ``models`` are (category, model), the best first.

    ``relation`` and ``host`` are what the task demands: another item, a scene object, or a room, whose floor it is; None and
    empty leave it to the agents. ``rooms`` are those it may be in, all when empty; ``beside`` what it must be next to.
    """

    name: str
    models: tuple[tuple[str, str], ...]
    relation: LayoutRelation | None = None
    host: str = ""
    rooms: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()

    def asset(self, choice: int) -> Asset:
        """The asset of one of its models. Raises IndexError beyond the last one."""
        return build_asset(Catalog.load(), *self.models[choice])

    def failure(self, host: str, reason: LayoutReason, detail: str) -> LayoutFailure:
        """That it found no place at ``host``, in the relation that the task demands or else on top."""
        return LayoutFailure(self.name, self.relation or LayoutRelation.ONTOP, host, reason, detail)


def object_brief(item: RequestedObject, asset: Asset, names: Mapping[str, str]) -> ObjectBrief:
    """An item as agents see it; ``names`` are those in the scene of what was placed already."""
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
    """Where such a thing belongs, by its role in the furnishing of rooms."""
    return _KINDS.get(role_of(asset.category, asset.size_m, asset.mass_kg), PlacementClass.FURNITURE)


@dataclass(frozen=True, slots=True)
class LayoutAgents:
    """Who decides, by the paper's names: each a function of a brief alone. The defaults are rules."""

    distribute: Callable[[DistributionBrief], Distribution] = distribute
    """Scene-level Distribution Agent."""
    organize: Callable[[RoomBrief], LayoutTree] = organize
    """Room-level Organization Agent."""
    choose_constraints: Callable[[ConstraintBrief], PlacementConstraints] = choose_constraints
    """Planar-Level Placement Generator: which constraints."""
    arrange: Callable[[PlaneBrief], tuple[PlaneArrangement, ...]] = arrange
    """Planar-Level Placement Generator: the solver."""


@dataclass(slots=True)
class LayoutRecord:
    """All that the agents were asked and answered, in order: for people, and for running an agent again alone."""

    distribution: tuple[DistributionBrief, Distribution] | None = None
    rooms: list[tuple[RoomBrief, LayoutTree]] = field(default_factory=list)
    constraints: list[tuple[ConstraintBrief, PlacementConstraints]] = field(default_factory=list)
    planes: list[tuple[PlaneBrief, tuple[PlaneArrangement, ...]]] = field(default_factory=list)
    planar_s: dict[str, float] = field(default_factory=dict)
    """Seconds of CPU that the planar solver took, by room."""
    settled: int = 0
    """Things that no geometry proved stable, and that were let go in physics."""


@dataclass(frozen=True, slots=True)
class Layout:
    """What came of a layout: names in the scene by item, trees by room in those names, and a failure for each item left out.

    ``unreachable`` tells of items that were given a place at which the robot does not get at them, as no better one was found.
    """

    names: Mapping[str, str]
    trees: Mapping[str, LayoutTree]
    failures: tuple[LayoutFailure, ...]
    record: LayoutRecord
    unreachable: tuple[LayoutFailure, ...] = ()
