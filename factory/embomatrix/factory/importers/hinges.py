"""Moving parts of Sweet Home 3D models, marked by group names.

``sweethome3d_opening_on_hinge_N`` turns about the rod ``sweethome3d_hinge_N``. ``sweethome3d_opening_on_rail_N`` slides along
the rod ``sweethome3d_rail_N`` or ``sweethome3d_unique_rail``. Names may have any suffix. Rods are not part of the asset,
because an opening passes through its own rod.
"""

import math
import re
from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np

from embomatrix.factory.importers.model import (
    AxisConvention,
    Mesh,
    ModelFileError,
    Motion,
    RawLink,
    RawModel,
    triple,
)
from embomatrix.world.asset import JointKind
from embomatrix.world.geometry import FloatArray

_OPENING: Final = re.compile(r"sweethome3d_opening_on_(hinge|rail)_(\d+)")
_HINGE: Final = re.compile(r"sweethome3d_hinge_(\d+)")
_RAIL: Final = re.compile(r"sweethome3d_(?:unique_rail|rail_(\d+))")
TRAVEL_SHARE: Final = 0.8
FORWARD: Final = {AxisConvention.Y_UP: 2, AxisConvention.Z_UP: 0}
"""Axis whose positive end is the model's front."""


def linked(groups: Mapping[str, Mesh], frame: AxisConvention) -> RawModel:
    """Return a model with named openings that move on a base of all other groups. Raises ModelFileError without a base."""
    openings: dict[tuple[str, str], list[Mesh]] = {}
    hinges: dict[str, Mesh] = {}
    rails: dict[str, Mesh] = {}
    base: list[Mesh] = []
    for name, mesh in groups.items():
        if found := _OPENING.match(name):
            openings.setdefault((found[1], found[2]), []).append(mesh)
            continue
        if found := _HINGE.match(name):
            hinges[found[1]] = mesh
        elif found := _RAIL.match(name):
            rails[found[1] or ""] = mesh
        else:
            base.append(mesh)
    if not base:
        raise ModelFileError("all groups are openings: expected at least one group that does not move")
    links = [RawLink("base", tuple(base))]
    for (kind, number), meshes in sorted(openings.items()):
        name = f"{'door' if kind == 'hinge' else 'drawer'}{number}"
        rod = hinges.get(number) if kind == "hinge" else rails.get(number, rails.get(""))
        if rod is None:
            raise ModelFileError(
                f"the opening on {kind} {number} has no sweethome3d_{kind}_{number} to move on"
            )
        motion = _turn(rod, meshes, frame) if kind == "hinge" else _slide(rod, meshes, frame)
        links.append(RawLink(name, tuple(meshes), motion))
    return RawModel(tuple(links), frame)


def _turn(rod: Mesh, meshes: Iterable[Mesh], frame: AxisConvention) -> Motion:
    """Return a quarter turn about the rod's centre line, towards the front."""
    origin, axis = _line(rod)
    low, high = _box(meshes)
    arm = (low + high) / 2 - origin
    swung = np.cross(axis, arm)  # initial direction of a positive turn
    sign = 1.0 if swung[FORWARD[frame]] >= 0 else -1.0
    return Motion(JointKind.REVOLUTE, triple(origin), triple(sign * axis), math.pi / 2)


def _slide(rod: Mesh, meshes: Iterable[Mesh], frame: AxisConvention) -> Motion:
    """Return a slide along the rod: towards the front, or to the side with more of the rod."""
    origin, axis = _line(rod)
    low, high = _box(meshes)
    along = int(np.argmax(np.abs(axis)))
    sign = 1.0 if along == FORWARD[frame] or origin[along] >= (low + high)[along] / 2 else -1.0
    travel = TRAVEL_SHARE * float(high[along] - low[along])
    return Motion(JointKind.PRISMATIC, triple((low + high) / 2), triple(sign * axis), travel)


def _line(rod: Mesh) -> tuple[FloatArray, FloatArray]:
    """Return centre and direction of a rod: the longest side of its box."""
    low, high = _box((rod,))
    axis = np.zeros(3)
    axis[int(np.argmax(high - low))] = 1.0
    return (low + high) / 2, axis


def _box(meshes: Iterable[Mesh]) -> tuple[FloatArray, FloatArray]:
    points = np.vstack([mesh.vertices for mesh in meshes])
    return points.min(axis=0), points.max(axis=0)
