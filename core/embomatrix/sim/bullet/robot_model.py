"""The robot as URDF text: a holonomic base and a lifting column under the arm of the installed ``pybullet_data`` package.

The arm's links, meshes and inertias are read from the package's ``panda.urdf`` when a robot is made; nothing of it is copied.
"""

from __future__ import annotations

import functools
import importlib.util
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Final

from embomatrix.sim.engine import EngineMissingError

BASE_JOINTS: Final = ("base_x", "base_y", "base_yaw")
LIFT_JOINTS: Final = ("lift_low", "lift_high")
ARM_JOINTS: Final = tuple(f"panda_joint{number}" for number in range(1, 8))
FINGER_JOINTS: Final = ("panda_finger_joint1", "panda_finger_joint2")
HAND: Final = "panda_hand"
BASE_RADIUS_M: Final = 0.25
GROUND_M: Final = 0.035
"""The base passes over rugs up to this height."""
BASE_TOP_M: Final = 0.30
HOUSING_M: Final = 0.42
"""Height of the column's fixed part."""
MOUNT_LOW_M: Final = 0.43
"""Height of the arm's mount with the lift down."""
LIFT_M: Final = 0.76
MOUNT_AHEAD_M: Final = 0.12
"""The arm sits this far ahead of the base's centre."""
STAGE_M: Final = 0.38
WRIST_EFFORT_NM: Final = 40.0
"""Three times a Panda's: the table of limits lets the robot lift 8 kg."""


@functools.cache
def package_folder() -> Path:
    """Folder of the arm's description. Raises EngineMissingError where it is not installed."""
    spec = importlib.util.find_spec("pybullet_data")
    folder = Path(spec.origin).parent / "franka_panda" if spec is not None and spec.origin else None
    if folder is None or not (folder / "panda.urdf").is_file():
        raise EngineMissingError(
            "the robot's arm is missing: expected franka_panda/panda.urdf in the package pybullet_data, which comes with "
            "pybullet 3.2.7; install embomatrix[worker]"
        )
    return folder


@functools.cache
def robot_urdf(*, visuals: bool = False) -> str:
    """The whole robot as URDF text; mesh files are named by their paths in the installed package."""
    folder = package_folder()
    arm = ET.parse(folder / "panda.urdf").getroot()
    for mesh in arm.iter("mesh"):
        mesh.set("filename", str(mesh.get("filename", "")).replace("package:/", str(folder)))
    robot = ET.Element("robot", name="mobile_panda")
    for part in _below_the_arm():
        robot.append(part)
    for part in arm:
        if not visuals:
            for shown in part.findall("visual"):
                part.remove(shown)
        if part.get("name") in ARM_JOINTS[4:]:
            for limit in part.findall("limit"):
                limit.set("effort", str(WRIST_EFFORT_NM))
        robot.append(part)
    return ET.tostring(robot, encoding="unicode")


def _below_the_arm() -> list[ET.Element]:
    """Base and column, down to the joint on which the arm is mounted."""
    radius, top = BASE_RADIUS_M, BASE_TOP_M
    return [
        _link("ground", mass=1.0),
        _link("rail_x", mass=1.0),
        _link("rail_y", mass=1.0),
        _link(
            "base",
            mass=60.0,
            cylinders=(
                (radius, top - GROUND_M, 0.0, (top + GROUND_M) / 2),
                (0.1, HOUSING_M - top, 0.0, (HOUSING_M + top) / 2),
            ),
        ),
        _link("column_low", mass=4.0, cylinders=((0.085, STAGE_M, 0.0, -STAGE_M / 2),)),
        _link("column_high", mass=4.0, cylinders=((0.07, STAGE_M, 0.0, -STAGE_M / 2),)),
        _joint("base_x", "prismatic", "ground", "rail_x", "1 0 0", 100.0),
        _joint("base_y", "prismatic", "rail_x", "rail_y", "0 1 0", 100.0),
        _joint("base_yaw", "continuous", "rail_y", "base", "0 0 1", 0.0),
        _joint("lift_low", "prismatic", "base", "column_low", "0 0 1", LIFT_M / 2, z=MOUNT_LOW_M, low=0.0),
        _joint("lift_high", "prismatic", "column_low", "column_high", "0 0 1", LIFT_M / 2, low=0.0),
        _joint("mount", "fixed", "column_high", "panda_link0", "0 0 1", 0.0, x=MOUNT_AHEAD_M),
    ]


def _link(
    name: str, *, mass: float = 0.0, cylinders: tuple[tuple[float, float, float, float], ...] = ()
) -> ET.Element:
    """A link of upright cylinders, each (radius, length, x, z)."""
    link = ET.Element("link", name=name)
    if mass:
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "mass", value=str(mass))
        ET.SubElement(inertial, "inertia", ixx="0.5", ixy="0", ixz="0", iyy="0.5", iyz="0", izz="0.5")
    for kind in ("visual", "collision"):
        for radius, length, x, z in cylinders:
            shape = ET.SubElement(link, kind)
            ET.SubElement(shape, "origin", xyz=f"{x} 0 {z}")
            geometry = ET.SubElement(shape, "geometry")
            ET.SubElement(geometry, "cylinder", radius=str(radius), length=str(length))
    return link


def _joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    axis: str,
    upper: float,
    *,
    low: float | None = None,
    x: float = 0.0,
    z: float = 0.0,
) -> ET.Element:
    joint = ET.Element("joint", name=name, type=kind)
    ET.SubElement(joint, "origin", xyz=f"{x} 0 {z}")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "axis", xyz=axis)
    if kind == "prismatic":
        lower = -upper if low is None else low
        ET.SubElement(joint, "limit", lower=str(lower), upper=str(upper), effort="1000", velocity="3")
    return joint
