"""Assets as URDF files, as one would have them of a library of objects: convex parts to collide with, joints with limits.

Nothing is drawn: without visual elements the files load faster than those of a library would.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial import ConvexHull

from embomatrix.sim.geometry.bounds import joint_motion
from embomatrix.world.geometry import Pose, Shape

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from embomatrix.world.asset import Asset, Joint
    from embomatrix.world.geometry import ConvexPart, Quat, Vec3

INERTIA: Final = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
"""URDF wants one; Bullet finds its own of mass and shape."""
EFFORT_N: Final = 100.0
SPEED: Final = 10.0
"""What joints may do at most: URDF wants both; nothing here comes near."""


def write_urdf(asset: Asset, folder: Path, name: str, fixed_at: Sequence[float] | None = None) -> Path:
    """Write an asset with its hulls' meshes; returns the URDF's path.

    Its base bears the asset's frame. With ``fixed_at`` the joints are fixed at these shares of their travel.
    """
    shares = iter(fixed_at or ())
    elements = []
    for number, link in enumerate(asset.links):
        origin = link.joint.origin_m if link.joint is not None else (0.0, 0.0, 0.0)
        frame = Pose((-origin[0], -origin[1], -origin[2]))
        parts = [
            _collision(part, frame, folder / f"{name}-{number}-{index}.obj")
            for index, part in enumerate(link.parts)
        ]
        mass_kg = asset.mass_kg / len(asset.links)
        mass = f'<inertial><mass value="{mass_kg:.6g}"/>{INERTIA}</inertial>'
        elements.append(f"<link name={quoteattr(link.name)}>{mass}{''.join(parts)}</link>")
        if link.joint is not None:
            share = next(shares) if fixed_at is not None else None
            elements.append(_joint(asset.links[0].name, link.name, link.joint, share))
    path = folder / f"{name}.urdf"
    path.write_text(f'<robot name="{name}">{"".join(elements)}</robot>\n', encoding="utf-8")
    return path


def _joint(base: str, link: str, joint: Joint, share: float | None) -> str:
    ends = f"<parent link={quoteattr(base)}/><child link={quoteattr(link)}/>"
    name = quoteattr(f"{link} joint")
    if share is not None:
        pose = joint_motion(joint, share) @ Pose(joint.origin_m)
        return f'<joint name={name} type="fixed">{ends}{_origin(pose)}</joint>'
    limit = (
        f'<limit lower="{min(0.0, joint.upper)!r}" upper="{max(0.0, joint.upper)!r}" '
        f'effort="{EFFORT_N}" velocity="{SPEED}"/>'
    )
    axis = f'<axis xyz="{_numbers(joint.axis)}"/>'
    return f'<joint name={name} type="{joint.kind.value}">{ends}{_origin(Pose(joint.origin_m))}{axis}{limit}</joint>'


def _collision(part: ConvexPart, frame: Pose, mesh: Path) -> str:
    match part.shape:
        case Shape.BOX:
            shape = f'<box size="{_numbers(part.size_m)}"/>'
        case Shape.CYLINDER:
            shape = f'<cylinder radius="{part.size_m[0] / 2!r}" length="{part.size_m[2]!r}"/>'
        case Shape.SPHERE:
            shape = f'<sphere radius="{part.size_m[0] / 2!r}"/>'
        case Shape.HULL:
            _write_mesh(part, mesh)
            shape = f"<mesh filename={quoteattr(mesh.name)}/>"
    return f"<collision>{_origin(frame @ part.pose)}<geometry>{shape}</geometry></collision>"


def _write_mesh(part: ConvexPart, path: Path) -> None:
    hull = ConvexHull(np.asarray(part.vertices_m))
    vertices = [f"v {_numbers(vertex)}" for vertex in part.vertices_m]
    faces = [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in hull.simplices]
    path.write_text("\n".join([*vertices, *faces]) + "\n", encoding="utf-8")


def _origin(pose: Pose) -> str:
    return f'<origin xyz="{_numbers(pose.position_m)}" rpy="{_numbers(roll_pitch_yaw(pose.quat_xyzw))}"/>'


def roll_pitch_yaw(quat: Quat) -> Vec3:
    """Angles (rad) about the fixed x, y and z axes, one after another, that make the rotation: as URDF writes it."""
    x, y, z, w = quat
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return roll, pitch, yaw


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
