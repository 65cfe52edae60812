"""Robot as URDF text: holonomic base, mast and carriage under the arm of the installed ``pybullet_data`` package.

The arm's links, meshes and inertias come from the package's ``panda.urdf`` at run time; nothing of it is copied.
"""

from __future__ import annotations

import functools
import importlib.util
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import TYPE_CHECKING, Final

from embomatrix.sim.engine import EngineMissingError
from embomatrix.sim.robot_dimensions import (
    ASKEW_RAD,
    BASE_RADIUS_M,
    BASE_TOP_M,
    CARRIAGE_SIZE_M,
    GROUND_M,
    LIFT_M,
    MAST_SIZE_M,
    MAST_TOP_M,
    MAST_X_M,
    MOUNT_RPY,
    MOUNT_X_M,
    SHOULDER_LOW_M,
    STAGE_SHARE,
)

if TYPE_CHECKING:
    from embomatrix.world.geometry import Vec3

BASE_JOINTS: Final = ("base_x", "base_y", "base_yaw")
LIFT_JOINTS: Final = ("mast", "lift")
ARM_JOINTS: Final = tuple(f"panda_joint{number}" for number in range(1, 8))
FINGER_JOINTS: Final = ("panda_finger_joint1", "panda_finger_joint2")
DRIVEN_JOINTS: Final = (*BASE_JOINTS, *LIFT_JOINTS, *ARM_JOINTS, *FINGER_JOINTS)
"""Joints with motors, in the order of a posture's values."""
HAND: Final = "panda_hand"
SHOULDER_EFFORT_NM: Final = 87.0
WRIST_EFFORT_NM: Final = 40.0
"""Efforts of a Panda: its own at the shoulder, three times its own at the wrist. The robot then lifts the specified 8 kg."""


@functools.cache
def package_folder() -> Path:
    """Folder of the arm's description. Raises EngineMissingError if it is not installed."""
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
    """URDF text of the whole robot; mesh files are named by their paths in the installed package."""
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
        if part.get("name") in ARM_JOINTS:
            for limit in part.findall("limit"):
                wrist = part.get("name") in ARM_JOINTS[4:]
                limit.set("effort", str(WRIST_EFFORT_NM if wrist else SHOULDER_EFFORT_NM))
        robot.append(part)
    return ET.tostring(robot, encoding="unicode")


def _below_the_arm() -> list[ET.Element]:
    """Base, mast and carriage, down to the joint that mounts the arm."""
    high = MAST_TOP_M - BASE_TOP_M
    low = (0.0, 0.0, SHOULDER_LOW_M)
    inner = MAST_SIZE_M[0] * 0.9
    plate = MOUNT_X_M - CARRIAGE_SIZE_M[0] / 2
    disc = _cylinder(BASE_RADIUS_M, BASE_TOP_M - GROUND_M, (0.0, 0.0, (BASE_TOP_M + GROUND_M) / 2))
    mast = _box((*MAST_SIZE_M, high), (MAST_X_M, 0.0, BASE_TOP_M + high / 2))
    return [
        _link("ground", 1.0),
        _link("rail_x", 1.0),
        _link("rail_y", 1.0),
        _link("base", 60.0, disc, mast),
        _link("stage", 4.0, _box((inner, inner, high), (MAST_X_M, 0.0, BASE_TOP_M + high / 2))),
        _link("carriage", 6.0, _box(CARRIAGE_SIZE_M, (plate, 0.0, 0.0))),
        _joint("base_x", "prismatic", "ground", "rail_x", "1 0 0", 100.0),
        _joint("base_y", "prismatic", "rail_x", "rail_y", "0 1 0", 100.0),
        _joint("base_yaw", "continuous", "rail_y", "base", "0 0 1", 0.0, rpy=(0.0, 0.0, ASKEW_RAD)),
        _joint("mast", "prismatic", "base", "stage", "0 0 1", LIFT_M * STAGE_SHARE, low=0.0),
        _joint(
            "lift", "prismatic", "stage", "carriage", "0 0 1", LIFT_M * (1 - STAGE_SHARE), low=0.0, at=low
        ),
        _joint(
            "mount", "fixed", "carriage", "panda_link0", "0 0 1", 0.0, at=(MOUNT_X_M, 0.0, 0.0), rpy=MOUNT_RPY
        ),
    ]


def _cylinder(radius_m: float, length_m: float, at: Vec3) -> tuple[ET.Element, Vec3]:
    """Upright cylinder and its middle in its link."""
    return ET.Element("cylinder", radius=str(radius_m), length=str(length_m)), at


def _box(size_m: Vec3, at: Vec3) -> tuple[ET.Element, Vec3]:
    """Box and its middle in its link."""
    return ET.Element("box", size=_row(size_m)), at


def _link(name: str, mass: float, *shapes: tuple[ET.Element, Vec3]) -> ET.Element:
    """Link whose visual shapes are its collision shapes."""
    link = ET.Element("link", name=name)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "mass", value=str(mass))
    ET.SubElement(inertial, "inertia", ixx="0.5", ixy="0", ixz="0", iyy="0.5", iyz="0", izz="0.5")
    for kind in ("visual", "collision"):
        for solid, at in shapes:
            shape = ET.SubElement(link, kind)
            ET.SubElement(shape, "origin", xyz=_row(at))
            ET.SubElement(shape, "geometry").append(solid)
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
    at: Vec3 = (0.0, 0.0, 0.0),
    rpy: Vec3 = (0.0, 0.0, 0.0),
) -> ET.Element:
    joint = ET.Element("joint", name=name, type=kind)
    ET.SubElement(joint, "origin", xyz=_row(at), rpy=_row(rpy))
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "axis", xyz=axis)
    if kind == "prismatic":
        lower = -upper if low is None else low
        ET.SubElement(joint, "limit", lower=str(lower), upper=str(upper), effort="1000", velocity="3")
    return joint


def _row(numbers: Vec3) -> str:
    return " ".join(str(number) for number in numbers)
