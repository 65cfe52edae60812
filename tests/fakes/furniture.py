"""Hand-made assets with round dimensions, which keep the expected values of tests simple."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from embomatrix.world.asset import Asset, Interior, Joint, JointKind, Link, SupportSurface
from embomatrix.world.geometry import ConvexPart, Pose, Shape

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from embomatrix.world.geometry import Vec3

PANEL_M = 0.02
MODEL = "fakeaa"
FOOD = {"cookable": {"cook_temperature": 70.0}, "freezable": {}, "heatable": {}}
"""Abilities of what can be cooked, frozen and heated, with BEHAVIOR-1K's parameters."""


def box(center: Vec3, size: Vec3) -> ConvexPart:
    return ConvexPart(Shape.BOX, Pose(center), size)


def asset(
    category: str,
    synset: str,
    size: Vec3,
    parts: Sequence[ConvexPart],
    *,
    mass_kg: float = 20.0,
    links: Sequence[Link] = (),
    supports: Sequence[SupportSurface] = (),
    interiors: Sequence[Interior] = (),
    abilities: Mapping[str, Mapping[str, float]] | None = None,
) -> Asset:
    return Asset(
        f"{category}-{MODEL}",
        category,
        synset,
        size,
        mass_kg,
        (Link("base", tuple(parts)), *links),
        tuple(supports),
        tuple(interiors),
        abilities or {},
    )


def top_of(size: Vec3, clearance_m: float = 1.0) -> SupportSurface:
    return SupportSurface("top", (0.0, 0.0, size[2] / 2), (size[0], size[1]), clearance_m)


def block(category: str, synset: str, size: Vec3, abilities: Mapping[str, Mapping[str, float]]) -> Asset:
    """Solid box with a support on top: counters, stoves."""
    return asset(
        category,
        synset,
        size,
        [box((0, 0, 0), size)],
        mass_kg=60.0,
        supports=[top_of(size)],
        abilities=abilities,
    )


def table(category: str, synset: str, size: Vec3) -> Asset:
    """Board on four legs with space above and below."""
    x, y, z = size
    board = box((0, 0, z / 2 - 0.02), (x, y, 0.04))
    leg = z - 0.04
    legs = [
        box((sx * (x / 2 - 0.03), sy * (y / 2 - 0.03), -0.02), (0.05, 0.05, leg))
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    return asset(category, synset, size, [board, *legs], supports=[top_of(size)])


def cupboard(
    category: str,
    synset: str,
    size: Vec3,
    *,
    boards: int = 0,
    mass_kg: float = 40.0,
    abilities: Mapping[str, Mapping[str, float]],
) -> Asset:
    """Carcass of panels with evenly spaced boards inside and one hinged door, which swings outwards by 90 degrees."""
    x, y, z = size
    t = PANEL_M
    depth = x - t  # the door takes the rest
    panels = [
        box((-t / 2, 0, z / 2 - t / 2), (depth, y, t)),
        box((-t / 2, 0, -z / 2 + t / 2), (depth, y, t)),
        box((-t / 2, y / 2 - t / 2, 0), (depth, t, z - 2 * t)),
        box((-t / 2, -y / 2 + t / 2, 0), (depth, t, z - 2 * t)),
        box((-x / 2 + t / 2, 0, 0), (t, y - 2 * t, z - 2 * t)),
    ]
    pitch = (z - 2 * t) / (boards + 1)
    supports = [top_of(size)]
    inner = (x - 2 * t, y - 2 * t)
    for number in range(boards + 1):
        level = -z / 2 + t + number * pitch
        if number:
            panels.append(box((0, 0, level - t / 2), (*inner, t)))
        supports.append(SupportSurface(f"board_{number}", (0, 0, level), inner, pitch - t, "main"))
    hinge = Joint(JointKind.REVOLUTE, (x / 2 - t / 2, y / 2, 0.0), (0.0, 0.0, 1.0), math.pi / 2)
    door = Link("door", (box((x / 2 - t / 2, 0, 0), (t, y, z)),), hinge)
    interior = Interior("main", (0, 0, 0), (*inner, z - 2 * t), ("door",))
    return asset(
        category,
        synset,
        size,
        panels,
        mass_kg=mass_kg,
        links=[door],
        supports=supports,
        interiors=[interior],
        abilities={"openable": {}, **abilities},
    )


def open_shelf(category: str, synset: str, size: Vec3, boards: int) -> Asset:
    """Boards between two sides and a back, open in front. Objects on a board are on top of the shelf."""
    x, y, z = size
    t = PANEL_M
    panels = [
        box((0, y / 2 - t / 2, 0), (x, t, z)),
        box((0, -y / 2 + t / 2, 0), (x, t, z)),
        box((-x / 2 + t / 2, 0, 0), (t, y - 2 * t, z)),
    ]
    pitch = (z - t) / (boards - 1)
    inner = (x - t, y - 2 * t)
    supports = []
    for number in range(boards):
        level = -z / 2 + t + number * pitch
        panels.append(box((t / 2, 0, level - t / 2), (*inner, t)))
        roofed = number < boards - 1
        clearance = pitch - t if roofed else 1.0
        supports.append(SupportSurface(f"board_{number}", (t / 2, 0, level), inner, clearance, framed=roofed))
    return asset(category, synset, size, panels, supports=supports)


def tub(
    category: str,
    synset: str,
    size: Vec3,
    wall_m: float,
    floor_m: float,
    *,
    mass_kg: float,
    abilities: Mapping[str, Mapping[str, float]],
) -> Asset:
    """Box without a lid: bowls, and sinks with a thick floor."""
    x, y, z = size
    w = wall_m
    panels = [
        box((0, 0, -z / 2 + floor_m / 2), (x, y, floor_m)),
        box((x / 2 - w / 2, 0, floor_m / 2), (w, y, z - floor_m)),
        box((-x / 2 + w / 2, 0, floor_m / 2), (w, y, z - floor_m)),
        box((0, y / 2 - w / 2, floor_m / 2), (x - 2 * w, w, z - floor_m)),
        box((0, -y / 2 + w / 2, floor_m / 2), (x - 2 * w, w, z - floor_m)),
    ]
    inner = (x - 2 * w, y - 2 * w)
    return asset(
        category,
        synset,
        size,
        panels,
        mass_kg=mass_kg,
        supports=[SupportSurface("bottom", (0, 0, -z / 2 + floor_m), inner, 1.0, "basin")],
        interiors=[Interior("basin", (0, 0, floor_m / 2), (*inner, z - floor_m))],
        abilities=abilities,
    )


def apple() -> Asset:
    ball = ConvexPart(Shape.SPHERE, Pose((0, 0, 0)), (0.08, 0.08, 0.08))
    return asset("apple", "apple.n.01", (0.08, 0.08, 0.08), [ball], mass_kg=0.2, abilities=FOOD)


def chicken_leg() -> Asset:
    """Hull that is wider in the middle than at its flat bottom and top."""
    size = (0.14, 0.06, 0.05)
    rings = ((-0.025, 0.8), (0.0, 1.0), (0.025, 0.8))
    vertices = tuple((sx * 0.07 * k, sy * 0.03 * k, z) for z, k in rings for sx in (-1, 1) for sy in (-1, 1))
    hull = ConvexPart(Shape.HULL, Pose((0, 0, 0)), size, vertices)
    return asset("chicken_leg", "chicken_leg.n.01", size, [hull], mass_kg=0.15, abilities=FOOD)


def mug() -> Asset:
    size = (0.09, 0.09, 0.1)
    return asset(
        "mug",
        "mug.n.04",
        size,
        [ConvexPart(Shape.CYLINDER, Pose((0, 0, 0)), size)],
        mass_kg=0.3,
        abilities={"heatable": {}},
    )


def table_lamp() -> Asset:
    parts = [
        ConvexPart(Shape.CYLINDER, Pose((0, 0, -0.19)), (0.16, 0.16, 0.02)),
        ConvexPart(Shape.CYLINDER, Pose((0, 0, -0.05)), (0.02, 0.02, 0.26)),
        ConvexPart(Shape.CYLINDER, Pose((0, 0, 0.14)), (0.2, 0.2, 0.12)),
    ]
    toggle = {"toggleable": {"requires_closed": 0.0}}
    return asset("table_lamp", "table_lamp.n.01", (0.2, 0.2, 0.4), parts, mass_kg=1.5, abilities=toggle)


def fridge() -> Asset:
    cold = {
        "temperature": -18.0,
        "requires_toggled_on": 0.0,
        "requires_closed": 1.0,
        "requires_inside": 1.0,
    }
    return cupboard(
        "fridge",
        "electric_refrigerator.n.01",
        (0.7, 0.7, 1.7),
        boards=3,
        mass_kg=70.0,
        abilities={"coldSource": cold},
    )


def microwave() -> Asset:
    heat = {
        "temperature": 100.0,
        "requires_toggled_on": 1.0,
        "requires_closed": 1.0,
        "requires_inside": 1.0,
    }
    abilities = {"heatSource": heat, "toggleable": {"requires_closed": 1.0}}
    return cupboard("microwave", "microwave.n.02", (0.4, 0.5, 0.3), mass_kg=12.0, abilities=abilities)


def cabinet() -> Asset:
    return cupboard("cabinet", "cabinet.n.01", (0.45, 0.8, 0.9), boards=1, abilities={})


def stove() -> Asset:
    heat = {
        "temperature": 1980.0,
        "requires_toggled_on": 1.0,
        "requires_closed": 0.0,
        "requires_inside": 0.0,
    }
    abilities = {"heatSource": heat, "toggleable": {"requires_closed": 0.0}}
    return block("stove", "stove.n.01", (0.6, 0.6, 0.9), abilities)


def sink() -> Asset:
    abilities: dict[str, dict[str, float]] = {"waterSource": {}, "toggleable": {"requires_closed": 0.0}}
    return tub("sink", "sink.n.01", (0.6, 0.8, 0.9), 0.05, 0.7, mass_kg=40.0, abilities=abilities)


def bowl() -> Asset:
    return tub("bowl", "bowl.n.01", (0.2, 0.2, 0.07), 0.01, 0.01, mass_kg=0.4, abilities={"heatable": {}})


def drawer_cabinet() -> Asset:
    """Carcass 0.5 m deep, 0.6 m wide and 0.5 m high, open in front, with two drawers that slide out by 0.36 m."""
    size = (0.5, 0.6, 0.5)
    x, y, z = size
    t, w = PANEL_M, 0.01
    panels = [
        box((0, 0, z / 2 - t / 2), (x, y, t)),
        box((0, 0, -z / 2 + t / 2), (x, y, t)),
        box((0, y / 2 - t / 2, 0), (x, t, z - 2 * t)),
        box((0, -y / 2 + t / 2, 0), (x, t, z - 2 * t)),
        box((-x / 2 + t / 2, 0, 0), (t, y - 2 * t, z - 2 * t)),
    ]
    links, supports, interiors = [], [top_of(size)], []
    inner = (0.44, 0.54)
    for name, floor in (("upper", 0.01), ("lower", -0.22)):
        center = (0.02, 0.0, floor + 0.08)
        parts = (
            box((0.02, 0, floor - w / 2), (inner[0] + 2 * w, inner[1] + 2 * w, w)),
            box((0.02 + inner[0] / 2 + w / 2, 0, floor + 0.08), (w, inner[1], 0.16)),
            box((0.02 - inner[0] / 2 - w / 2, 0, floor + 0.05), (w, inner[1], 0.1)),
            box((0.02, inner[1] / 2 + w / 2, floor + 0.05), (inner[0], w, 0.1)),
            box((0.02, -inner[1] / 2 - w / 2, floor + 0.05), (inner[0], w, 0.1)),
        )
        joint = Joint(JointKind.PRISMATIC, (x / 2, 0.0, floor + 0.05), (1.0, 0.0, 0.0), 0.36)
        links.append(Link(name, parts, joint))
        supports.append(SupportSurface(f"{name}_floor", (0.02, 0.0, floor), inner, 0.17, name, name))
        interiors.append(Interior(name, center, (*inner, 0.16), (name,), name))
    return asset(
        "bottom_cabinet",
        "cabinet.n.01",
        size,
        panels,
        links=links,
        supports=supports,
        interiors=interiors,
        abilities={"openable": {}},
    )


def counter() -> Asset:
    return block("countertop", "countertop.n.01", (0.6, 1.6, 0.9), {})


def kitchen_table() -> Asset:
    return table("breakfast_table", "breakfast_table.n.01", (0.8, 1.2, 0.75))


def coffee_table() -> Asset:
    return table("coffee_table", "coffee_table.n.01", (0.6, 1.0, 0.45))


def shelf() -> Asset:
    return open_shelf("shelf", "shelf.n.01", (0.3, 0.9, 1.6), 4)
