"""Assets: the geometry and the abilities of one object model, shared by all its instances.

The asset frame has its origin at the centre of the model's bounding box, x along the depth with the *front at +x*, y along
the width, z up. Parts, joints, supports and interiors are all given in that frame with every joint at zero (closed).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.world.geometry import ConvexPart, Vec2, Vec3

FLOOR_CATEGORY: Final = "floors"
"""Category of a room's floor, where it is an object that plans and goals can name."""


class JointKind(StrEnum):
    REVOLUTE = "revolute"
    PRISMATIC = "prismatic"


@dataclass(frozen=True, slots=True)
class Joint:
    """How a link moves against the base. Position 0 is closed, ``upper`` is fully open (rad or m)."""

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
    """Horizontal rectangle that things can stand on.

    ``center_m`` lies on the surface; ``size_m`` is its extent along the asset's x and y; ``clearance_m`` is the free
    height above it. ``interior`` names the cavity that the surface is the floor of, or is empty in the open. ``link`` names
    the moving link that the surface rides on, as a drawer's floor does; empty for the base.
    """

    name: str
    center_m: Vec3
    size_m: Vec2
    clearance_m: float
    interior: str = ""
    link: str = ""


@dataclass(frozen=True, slots=True)
class Interior:
    """Box-shaped cavity that things can be inside of.

    ``closed_by`` names the links whose joints bar the way in while they are shut; empty means that it is always open.
    ``link`` names the moving link that the cavity rides on, as a drawer's does; empty for the base.
    """

    name: str
    center_m: Vec3
    size_m: Vec3
    closed_by: tuple[str, ...] = ()
    link: str = ""


@dataclass(frozen=True, slots=True)
class Credit:
    """Whose work an imported model is, and on which terms it may be used."""

    creator: str
    licence: str
    source: str


@dataclass(frozen=True, slots=True)
class Asset:
    """One object model: ``asset_id`` is ``category-model``, as in the scene inventories.

    ``abilities`` maps an ability of the catalog ("openable", "heatSource", ...) to its parameters. ``credit`` is None for
    what this project generated itself.
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
    """(link name, joint) of every moving link, in link order: the order of an object's joint positions."""

    def __post_init__(self) -> None:
        joints = tuple((link.name, link.joint) for link in self.links if link.joint is not None)
        object.__setattr__(self, "joints", joints)

    def can(self, ability: str) -> bool:
        return ability in self.abilities
