"""Assets: geometry and abilities of one object model, shared by all its instances.

The origin of the asset frame is the centre of the model's bounding box. x runs along the depth with the *front at +x*, y along
the width, z up. Parts, joints, supports and interiors are given in this frame with every joint at zero (closed).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from embomatrix.world.geometry import ConvexPart, Vec2, Vec3

FLOOR_CATEGORY: Final = "floors"
"""Category of a room's floor if the floor is an object that plans and goals can name."""


class JointKind(StrEnum):
    REVOLUTE = "revolute"
    PRISMATIC = "prismatic"


@dataclass(frozen=True, slots=True)
class Joint:
    """Motion of a link against the base. Position 0 is closed, ``upper`` is fully open (rad or m)."""

    kind: JointKind
    origin_m: Vec3
    axis: Vec3
    upper: float


@dataclass(frozen=True, slots=True)
class Link:
    """Rigid group of convex parts. The first link of an asset is its base and has no joint."""

    name: str
    parts: tuple[ConvexPart, ...]
    joint: Joint | None = None


@dataclass(frozen=True, slots=True)
class SupportSurface:
    """Horizontal rectangle that objects can stand on.

    ``center_m`` lies on the surface; ``size_m`` is its extent along the asset's x and y; ``clearance_m`` is the free height
    above it. ``interior`` names the cavity whose floor the surface is; empty in the open. ``link`` names the moving link that
    carries the surface, such as a drawer; empty for the base. A ``framed`` surface has walls on three sides, as a board in
    a bookcase: objects stand on it, not in a cavity.
    """

    name: str
    center_m: Vec3
    size_m: Vec2
    clearance_m: float
    interior: str = ""
    link: str = ""
    framed: bool = False

    @property
    def walled(self) -> bool:
        """True if an object must fit on the surface with its whole footprint."""
        return self.framed or bool(self.interior)


@dataclass(frozen=True, slots=True)
class Interior:
    """Box-shaped cavity that objects can be inside of.

    ``closed_by`` names the links that close the cavity while their joints are shut; empty for a cavity that is always open.
    ``link`` names the moving link that carries the cavity, such as a drawer; empty for the base.
    """

    name: str
    center_m: Vec3
    size_m: Vec3
    closed_by: tuple[str, ...] = ()
    link: str = ""


@dataclass(frozen=True, slots=True)
class Credit:
    """Author, licence and source of an imported model."""

    creator: str
    licence: str
    source: str


@dataclass(frozen=True, slots=True)
class Asset:
    """One object model: ``asset_id`` is ``category-model``, as in the scene inventories.

    ``abilities`` maps an ability of the catalog ("openable", "heatSource", ...) to its parameters. ``credit`` is None for
    models that this project generates.
    """

    asset_id: str
    category: str
    synset: str
    size_m: Vec3
    mass_kg: float
    links: tuple[Link, ...]
    supports: tuple[SupportSurface, ...] = ()
    interiors: tuple[Interior, ...] = ()
    abilities: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    credit: Credit | None = None
    joints: tuple[tuple[str, Joint], ...] = field(init=False, repr=False, compare=False)
    """Link name and joint of every moving link, in link order: the order of an object's joint positions."""

    def __post_init__(self) -> None:
        joints = tuple((link.name, link.joint) for link in self.links if link.joint is not None)
        object.__setattr__(self, "joints", joints)

    @property
    def open_supports(self) -> tuple[SupportSurface, ...]:
        """Surfaces outside cavities: an object there is on top of the asset, not inside it."""
        return tuple(surface for surface in self.supports if not surface.interior)

    def can(self, ability: str) -> bool:
        return ability in self.abilities
