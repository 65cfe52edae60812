"""Assets and poses as plain JSON values, and back. Decoding trusts nothing, see ``codec``."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from embomatrix.world.asset import Asset, Credit, Interior, Joint, JointKind, Link, SupportSurface
from embomatrix.world.field import Field
from embomatrix.world.geometry import ConvexPart, Pose, Shape
from embomatrix.world.tables import (
    FLAT_HULL,
    MAX_COORDINATE_M,
    MAX_VERTICES,
    MIN_EXTENT_M,
    QUAT_TOLERANCE,
    has_volume,
)

if TYPE_CHECKING:
    from embomatrix.world.geometry import Vec3
    from embomatrix.world.tables import TableWriter

    Json = dict[str, Any]

ASSET_KEYS: Final = (
    "asset_id",
    "category",
    "synset",
    "size_m",
    "mass_kg",
    "links",
    "supports",
    "interiors",
    "abilities",
)
SUPPORT_KEYS: Final = ("name", "center_m", "size_m", "clearance_m", "interior")
INTERIOR_KEYS: Final = ("name", "center_m", "size_m", "closed_by")
MAX_PARTS: Final = 16
"""Parts of a link: Bullet drops the rest of a compound in silence."""
MAX_LINKS: Final = 100
MAX_MASS_KG: Final = 1e6


def asset_to_json(asset: Asset, tables: TableWriter | None = None) -> Json:
    """JSON values. Parts are rows of ``tables`` where they are given."""
    value: Json = {
        "asset_id": asset.asset_id,
        "category": asset.category,
        "synset": asset.synset,
        "size_m": [*asset.size_m],
        "mass_kg": asset.mass_kg,
        "links": [_link_to_json(link, tables) for link in asset.links],
        "supports": [
            {
                "name": surface.name,
                "center_m": [*surface.center_m],
                "size_m": [*surface.size_m],
                "clearance_m": surface.clearance_m,
                "interior": surface.interior,
                **({"link": surface.link} if surface.link else {}),
            }
            for surface in asset.supports
        ],
        "interiors": [
            {
                "name": interior.name,
                "center_m": [*interior.center_m],
                "size_m": [*interior.size_m],
                "closed_by": [*interior.closed_by],
                **({"link": interior.link} if interior.link else {}),
            }
            for interior in asset.interiors
        ],
        "abilities": {key: dict(sorted(params.items())) for key, params in sorted(asset.abilities.items())},
    }
    if asset.credit is not None:
        credit = asset.credit
        value["credit"] = {"creator": credit.creator, "licence": credit.licence, "source": credit.source}
    return value


def asset_from_json(value: object) -> Asset:
    """A valid asset. Raises SceneInvalidError naming the field that is wrong."""
    return asset_from_field(Field(value, "asset"))


def pose_to_json(pose: Pose, tables: TableWriter | None = None) -> list[float] | int:
    """x, y, z in metres and the quaternion x, y, z, w; or the row of ``tables`` that holds them."""
    if tables is not None:
        return tables.pose(pose)
    return [*map(float, pose.position_m), *map(float, pose.quat_xyzw)]


def pose_from_field(field: Field) -> Pose:
    """A pose with a unit quaternion and a position within reason."""
    if field.tables is not None:
        return field.tables.pose(field)
    x, y, z, qx, qy, qz, qw = field.numbers(7)
    norm = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    if abs(norm - 1.0) > QUAT_TOLERANCE:
        field.fail(f"the quaternion has length {norm:.6g}: expected 1")
    if max(abs(x), abs(y), abs(z)) > MAX_COORDINATE_M:
        field.fail(
            f"the position ({x:g}, {y:g}, {z:g}) is further than {MAX_COORDINATE_M:g} m from the origin"
        )
    return Pose((x, y, z), (qx, qy, qz, qw))


def part_to_json(part: ConvexPart, tables: TableWriter | None = None) -> Json | int:
    """JSON values, or the row of ``tables`` that holds the part."""
    if tables is not None:
        return tables.part(part)
    value: Json = {"shape": part.shape.value, "pose": pose_to_json(part.pose), "size_m": [*part.size_m]}
    if part.vertices_m:
        value["vertices_m"] = [[*vertex] for vertex in part.vertices_m]
    return value


def part_from_field(field: Field) -> ConvexPart:
    """A part with extents above 1 mm, and vertices where it is a hull."""
    if field.tables is not None:
        return field.tables.part(field)
    fields = field.record("shape", "pose", "size_m", optional=("vertices_m",))
    shape = fields["shape"].member(Shape)
    vertices: tuple[Vec3, ...] = ()
    if "vertices_m" in fields:
        vertices = tuple(item.vec3() for item in fields["vertices_m"].items(at_most=MAX_VERTICES))
    if (shape is Shape.HULL) != (len(vertices) >= 4):
        field.fail(
            f"a {shape.value} has {len(vertices)} vertices: expected {'4 or more' if shape is Shape.HULL else 0}"
        )
    if shape is Shape.HULL and not has_volume(np.asarray(vertices)):
        fields["vertices_m"].fail(FLAT_HULL)
    return ConvexPart(shape, pose_from_field(fields["pose"]), _extent(fields["size_m"]), vertices)


def _extent(field: Field) -> Vec3:
    size = field.vec3()
    if min(size) <= MIN_EXTENT_M or max(size) > MAX_COORDINATE_M:
        field.fail(f"found {size}: expected every extent above {MIN_EXTENT_M} m")
    return size


def _link_to_json(link: Link, tables: TableWriter | None) -> Json:
    value: Json = {"name": link.name, "parts": [part_to_json(part, tables) for part in link.parts]}
    if link.joint is not None:
        value["joint"] = {
            "kind": link.joint.kind.value,
            "origin_m": [*link.joint.origin_m],
            "axis": [*link.joint.axis],
            "upper": link.joint.upper,
        }
    return value


def _link(field: Field) -> Link:
    fields = field.record("name", "parts", optional=("joint",))
    parts = tuple(part_from_field(item) for item in fields["parts"].items(at_most=MAX_PARTS))
    if not parts:
        fields["parts"].fail("is empty: expected at least one part")
    return Link(
        fields["name"].name(), parts, joint_from_field(fields["joint"]) if "joint" in fields else None
    )


def joint_from_field(field: Field) -> Joint:
    """A joint with a travel, about or along an axis of length 1. Raises SceneInvalidError."""
    fields = field.record("kind", "origin_m", "axis", "upper")
    axis = fields["axis"].vec3()
    length = math.hypot(*axis)
    if not abs(length - 1.0) <= QUAT_TOLERANCE:
        fields["axis"].fail(f"the axis has length {length:.6g}: expected 1")
    origin = fields["origin_m"].vec3()
    upper = fields["upper"].number()
    if max(map(abs, (*origin, upper))) > MAX_COORDINATE_M:
        field.fail(f"found the origin {origin} and the travel {upper}: expected at most {MAX_COORDINATE_M:g}")
    if upper == 0:
        fields["upper"].fail("the joint has no travel: expected a number other than 0")
    return Joint(fields["kind"].member(JointKind), origin, axis, upper)


def asset_from_field(field: Field) -> Asset:
    fields = field.record(*ASSET_KEYS, optional=("credit",))
    links = tuple(_link(item) for item in fields["links"].items(at_most=MAX_LINKS))
    if not links or links[0].joint is not None or any(link.joint is None for link in links[1:]):
        fields["links"].fail("expected a base without a joint first, and a joint for every other link")
    check_unique(fields["links"], [link.name for link in links], "link")
    bodies = sum(1 + sum(part.shape is Shape.HULL for part in link.parts) for link in links)
    if bodies > MAX_LINKS:
        fields["links"].fail(f"make {bodies} bodies: expected at most {MAX_LINKS}; use fewer hulls or links")
    mass = fields["mass_kg"].number()
    if not 0.0 < mass <= MAX_MASS_KG:
        fields["mass_kg"].fail(f"found {mass}: expected more than 0 kg and at most {MAX_MASS_KG:g} kg")
    interiors = tuple(_interior(item, links) for item in fields["interiors"].items())
    return Asset(
        asset_id=fields["asset_id"].name(),
        category=fields["category"].name(),
        synset=fields["synset"].text(),
        size_m=_extent(fields["size_m"]),
        mass_kg=mass,
        links=links,
        supports=tuple(_support(item, interiors, links) for item in fields["supports"].items()),
        interiors=interiors,
        abilities={
            ability: {key: number.number() for key, number in params.entries()}
            for ability, params in fields["abilities"].entries()
        },
        credit=_credit(fields["credit"]) if "credit" in fields else None,
    )


def _credit(field: Field) -> Credit:
    fields = field.record("creator", "licence", "source")
    return Credit(fields["creator"].text(), fields["licence"].text(), fields["source"].text())


def _support(field: Field, interiors: tuple[Interior, ...], links: tuple[Link, ...]) -> SupportSurface:
    fields = field.record(*SUPPORT_KEYS, optional=("link",))
    interior = fields["interior"].text()
    if interior and interior not in {item.name for item in interiors}:
        fields["interior"].fail(f"unknown interior {interior!r}")
    size = fields["size_m"].vec2()
    if min(size) <= MIN_EXTENT_M:
        fields["size_m"].fail(f"found {size}: expected every extent above {MIN_EXTENT_M} m")
    return SupportSurface(
        name=fields["name"].name(),
        center_m=fields["center_m"].vec3(),
        size_m=size,
        clearance_m=fields["clearance_m"].number(),
        interior=interior,
        link=_moving_link(fields["link"], links) if "link" in fields else "",
    )


def _interior(field: Field, links: tuple[Link, ...]) -> Interior:
    fields = field.record(*INTERIOR_KEYS, optional=("link",))
    closed_by = fields["closed_by"].texts()
    unknown = set(closed_by) - {link.name for link in links if link.joint is not None}
    if unknown:
        fields["closed_by"].fail(f"unknown moving link {min(unknown)!r}")
    return Interior(
        name=fields["name"].name(),
        center_m=fields["center_m"].vec3(),
        size_m=_extent(fields["size_m"]),
        closed_by=closed_by,
        link=_moving_link(fields["link"], links) if "link" in fields else "",
    )


def _moving_link(field: Field, links: tuple[Link, ...]) -> str:
    name = field.name()
    if name not in {link.name for link in links if link.joint is not None}:
        field.fail(f"unknown moving link {name!r}")
    return name


def check_unique(field: Field, names: list[str], kind: str) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            field.fail(f"two of them have the {kind} {name!r}: expected each once")
        seen.add(name)
