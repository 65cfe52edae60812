"""Models of untrusted URDF files: links, joints, boxes, cylinders, spheres, and mesh files beside the URDF.

Entities and document types are rejected before parsing, and mesh paths must stay within the URDF's folder. Links must form
one tree. Masses must not be negative; they are unused, because the catalog has its own.
"""

import math
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from embomatrix.factory.importers.meshes import read_groups
from embomatrix.factory.importers.model import (
    AxisConvention,
    Mesh,
    ModelFileError,
    Motion,
    RawLink,
    RawModel,
    read_bytes,
    triple,
)
from embomatrix.world.asset import JointKind
from embomatrix.world.geometry import FloatArray

MAX_TEXT: Final = 4 * 1024 * 1024
MAX_LINKS: Final = 100
MAX_EXTENT_M: Final = 100.0
_FORBIDDEN: Final = re.compile(r"<!\s*(DOCTYPE|ENTITY)", re.IGNORECASE)
_PACKAGE: Final = "package://"
_KINDS: Final = {"fixed": None, "revolute": JointKind.REVOLUTE, "prismatic": JointKind.PRISMATIC}


@dataclass(frozen=True, slots=True)
class _Joint:
    name: str
    kind: JointKind | None
    parent: str
    child: str
    transform: FloatArray  # (4, 4): the child's frame in the parent's
    axis: FloatArray  # (3,), in the child's frame
    upper: float


def read_urdf(path: Path) -> RawModel:
    """Read a URDF file. Raises ModelFileError with the name of the wrong element."""
    try:
        # Another encoding could hide a declaration from the check below.
        text = read_bytes(path).decode("utf-8")
    except UnicodeDecodeError:
        raise ModelFileError(f"{path} is not UTF-8: expected a plain URDF") from None
    if len(text) > MAX_TEXT or _FORBIDDEN.search(text):
        raise ModelFileError(
            f"{path} is longer than {MAX_TEXT} characters or declares entities: expected a plain URDF"
        )
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise ModelFileError(f"{path} is not XML ({error}): expected a plain URDF") from None
    try:
        return _model(root, path.parent)
    except ModelFileError as error:
        raise ModelFileError(f"{path}: {error}") from None


def _model(root: ET.Element, folder: Path) -> RawModel:
    elements: dict[str, ET.Element] = {}
    for element in root.findall("link"):
        name = _name(element)
        if name in elements:
            raise ModelFileError(f"two links are named {name!r}: rename one")
        elements[name] = element
    if not 0 < len(elements) <= MAX_LINKS:
        raise ModelFileError(f"it has {len(elements)} links: expected 1 to {MAX_LINKS}")
    joints = [_joint(element, elements) for element in root.findall("joint")]
    order = _tree(list(elements), joints)
    return _gathered(elements, joints, order, folder)


def _tree(links: list[str], joints: list[_Joint]) -> list[str]:
    """Return the links from the root downwards. Raises ModelFileError if they are not one tree."""
    parents: dict[str, str] = {}
    for joint in joints:
        if joint.child in parents:
            raise ModelFileError(
                f"the link {joint.child!r} has two parents, {parents[joint.child]!r} and {joint.parent!r}"
            )
        parents[joint.child] = joint.parent
    roots = [name for name in links if name not in parents]
    if len(roots) != 1:
        found = ", ".join(map(repr, roots)) or "none: its joints form a cycle"
        raise ModelFileError(
            f"found the links {found} without a parent: expected one; connect the others with joints"
        )
    order = roots
    for name in order:  # grows during the iteration
        order.extend(joint.child for joint in joints if joint.parent == name)
    if len(order) != len(links):
        lost = sorted(set(links) - set(order))
        raise ModelFileError(
            f"the links {', '.join(map(repr, lost))} form a cycle without a connection to the root"
        )
    return order


def _gathered(
    elements: dict[str, ET.Element], joints: list[_Joint], order: list[str], folder: Path
) -> RawModel:
    """Merge fixed children into their links, in the root's frame with every joint at zero."""
    into = {joint.child: joint for joint in joints}
    frames: dict[str, FloatArray] = {order[0]: np.eye(4)}
    owner: dict[str, str] = {order[0]: order[0]}
    meshes: dict[str, list[Mesh]] = {order[0]: []}
    motions: dict[str, Motion] = {}
    for name in order:
        joint = into.get(name)
        if joint is not None:
            frames[name] = frames[joint.parent] @ joint.transform
            owner[name] = name if joint.kind is not None else owner[joint.parent]
            if joint.kind is not None:
                if owner[joint.parent] != order[0]:
                    raise ModelFileError(
                        f"the joint {joint.name!r} moves on the moving link {owner[joint.parent]!r}: "
                        "an asset has one joint between its base and a link; make one of the two joints fixed"
                    )
                meshes[name] = []
                axis = frames[name][:3, :3] @ joint.axis
                motions[name] = Motion(joint.kind, triple(frames[name][:3, 3]), triple(axis), joint.upper)
        meshes[owner[name]].extend(_shapes(elements[name], frames[name], folder))
    empty = [name for name, found in meshes.items() if not found]
    if empty:
        raise ModelFileError(f"the link {empty[0]!r} has no shape: give it a collision or a visual element")
    return RawModel(
        tuple(RawLink(name, tuple(found), motions.get(name)) for name, found in meshes.items()),
        AxisConvention.Z_UP,
    )


def _joint(element: ET.Element, links: dict[str, ET.Element]) -> _Joint:
    name, kind = _name(element), element.get("type", "")
    if kind not in _KINDS:
        raise ModelFileError(f"the joint {name!r} is of type {kind!r}: expected one of {', '.join(_KINDS)}")
    ends = []
    for end in ("parent", "child"):
        found = element.find(end)
        link = found.get("link", "") if found is not None else ""
        if link not in links:
            raise ModelFileError(f"the {end} of the joint {name!r} is {link!r}: expected the name of a link")
        ends.append(link)
    axis = np.array(_numbers(element.find("axis"), "xyz", (1.0, 0.0, 0.0), name))
    length = float(np.linalg.norm(axis))
    if length < 1e-6:
        raise ModelFileError(f"the axis of the joint {name!r} is zero")
    upper = 0.0
    if _KINDS[kind] is not None:
        limit = element.find("limit")
        low, high = (_number(limit, key, name) for key in ("lower", "upper"))
        upper = high if abs(high) >= abs(low) else low
        if upper == 0.0:
            raise ModelFileError(f"the joint {name!r} has no travel: expected limits other than 0")
    return _Joint(name, _KINDS[kind], ends[0], ends[1], _origin(element, name), axis / length, upper)


def _shapes(link: ET.Element, frame: FloatArray, folder: Path) -> list[Mesh]:
    """Return the collision shapes of a link, or its visual shapes if it has none, in the root's frame."""
    name = _name(link)
    inertial = link.find("inertial/mass")
    if inertial is not None and _number(inertial, "value", name) < 0:
        raise ModelFileError(f"the mass of the link {name!r} is negative")
    found = []
    for element in link.findall("collision") or link.findall("visual"):
        geometry = element.find("geometry")
        shape = next(iter(geometry), None) if geometry is not None else None
        if shape is None:
            raise ModelFileError(f"a shape of the link {name!r} has no geometry")
        transform = frame @ _origin(element, name)
        for mesh in _geometry(shape, name, folder):
            points = mesh.vertices @ transform[:3, :3].T + transform[:3, 3]
            found.append(Mesh(points, mesh.faces, mesh.convex))
    return found


def _geometry(shape: ET.Element, name: str, folder: Path) -> list[Mesh]:
    match shape.tag:
        case "box":
            made = trimesh.creation.box(extents=_extents(shape, "size", name, count=3))
        case "cylinder":
            (radius,), (length,) = (_extents(shape, key, name) for key in ("radius", "length"))
            made = trimesh.creation.cylinder(radius=radius, height=length, sections=16)
        case "sphere":
            made = trimesh.creation.icosphere(subdivisions=2, radius=_extents(shape, "radius", name)[0])
        case "mesh":
            scale = np.array(_numbers(shape, "scale", (1.0, 1.0, 1.0), name))
            groups = read_groups(_mesh_path(shape.get("filename", ""), name, folder))
            return [Mesh(mesh.vertices * scale, mesh.faces) for mesh in groups.values()]
        case tag:
            raise ModelFileError(
                f"a shape of the link {name!r} is a {tag!r}: expected box, cylinder, sphere or mesh"
            )
    return [Mesh(np.asarray(made.vertices), np.asarray(made.faces, dtype=np.int64), convex=True)]


def _mesh_path(filename: str, name: str, folder: Path) -> Path:
    relative = filename.removeprefix(_PACKAGE)
    path = (folder / relative).resolve()
    if not relative or not path.is_relative_to(folder.resolve()):
        raise ModelFileError(f"the mesh {filename!r} of the link {name!r} lies outside the URDF's folder")
    return path


def _origin(element: ET.Element, name: str) -> FloatArray:
    """Return the (4, 4) transform of an ``origin`` child: translation, and roll, pitch, yaw about fixed axes."""
    origin = element.find("origin")
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_euler("xyz", _numbers(origin, "rpy", (0.0, 0.0, 0.0), name)).as_matrix()
    transform[:3, 3] = _numbers(origin, "xyz", (0.0, 0.0, 0.0), name)
    return transform


def _name(element: ET.Element) -> str:
    name = element.get("name", "")
    if not name:
        raise ModelFileError(f"a {element.tag} has no name")
    return name


def _number(element: ET.Element | None, key: str, name: str) -> float:
    """Return an attribute, 0 if it is missing."""
    return _numbers(element, key, (0.0,), name, count=1)[0]


def _numbers(
    element: ET.Element | None, key: str, default: tuple[float, ...] | None, name: str, count: int = 3
) -> tuple[float, ...]:
    text = element.get(key) if element is not None else None
    if text is None:
        if default is None:
            raise ModelFileError(f"{name!r}: {key!r} is missing")
        return default
    try:
        values = tuple(map(float, text.split()))
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        raise ModelFileError(f"{name!r}: {key} is {text[:40]!r}, expected {count} finite numbers")
    return values


def _extents(shape: ET.Element, key: str, name: str, *, count: int = 1) -> tuple[float, ...]:
    """Return lengths of a shape in metres, checked against MAX_EXTENT_M."""
    values = _numbers(shape, key, None, name, count)
    if not all(0 < value <= MAX_EXTENT_M for value in values):
        raise ModelFileError(
            f"{name!r}: {key} is {shape.get(key, '')[:40]!r}, expected metres above 0, at most {MAX_EXTENT_M:g}"
        )
    return values
