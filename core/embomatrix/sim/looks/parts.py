"""Material of each part of an object: leaves and pot, shade and stem, mattress and frame, doors before their body."""

import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from embomatrix.sim.looks.materials import MATERIALS, Material, MaterialKind, Pattern
from embomatrix.sim.looks.words import content_by_words, kind_by_words
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import ConvexPart, Shape

_K: Final = MaterialKind
_TREES: Final = frozenset({"tree", "low_resolution_tree", "christmas_tree", "christmas_tree_decorated"})
_BEDS: Final = frozenset({"bed", "bunk_bed", "hospital_bed", "crib", "mattress"})
_STANDING_LAMPS: Final = frozenset({"floor_lamp", "table_lamp"})
_DARK_DOORS: Final = frozenset({"oven", "microwave", "toaster_oven", "washer", "clothes_dryer"})
"""Appliances with a pane of dark glass."""
_PACKED: Final = frozenset({_K.BOTTLE, _K.JAR, _K.TIN, _K.PACKAGE})
_LARGE_M: Final = 0.6
"""Objects of unknown material are wood from this size on, and plastic below it."""
_SINK_BODY_M: Final = 0.6
"""Sinks from this height on stand on the floor in a cabinet."""
_LIGHTER: Final = 0.25
"""Share by which doors and drawers are lighter than the body that they close."""


def part_materials(asset: Asset) -> list[Material]:
    """Return the materials of the parts of all links, in order.

    Models of things with many colours, such as books, differ from one another.
    """
    body = material_of(asset.category, large=max(asset.size_m) >= _LARGE_M, salt=asset.asset_id)
    parts = [part for link in asset.links for part in link.parts]
    return [
        _moving(asset.category, body) if number else _still(asset, parts, part, body)
        for number, link in enumerate(asset.links)
        for part in link.parts
    ]


def material_of(category: str, *, large: bool = False, salt: str = "") -> Material:
    """Return the material of a category; a package has the colour of its content, as far as a word tells."""
    kind = kind_by_words(category) or (_K.OAK if large else _K.PLASTIC)
    material = MATERIALS[kind]
    content = content_by_words(category) if kind in _PACKED else None
    if content is not None and content not in _PACKED:
        return replace(material, color=MATERIALS[content].color)
    if material.palette:
        number = zlib.crc32(f"{category}{salt}".encode()) % len(material.palette)
        return replace(material, color=material.palette[number])
    return material


def _still(asset: Asset, parts: Sequence[ConvexPart], part: ConvexPart, body: Material) -> Material:
    """Return the material of a part of the base."""
    category, first = asset.category, part is parts[0]
    match kind_by_words(category):
        case _K.MIRROR if len(parts) > 1:
            return body if part is max(parts, key=_front) else MATERIALS[_K.WALNUT]
        case _K.SCREEN if len(parts) > 1:
            return body if part is max(parts, key=_front) else MATERIALS[_K.BLACK_PLASTIC]
        case _K.FOLIAGE | _K.FLOWER if part.shape is not Shape.HULL and len(parts) > 1:
            return MATERIALS[_K.BARK if category in _TREES else _K.TERRACOTTA]
        case _K.LAMPSHADE if len(parts) > 1 and not _is_shade(asset, part):
            return MATERIALS[_K.IRON]
    if category in _BEDS:
        return material_of("quilt", salt=asset.asset_id) if first else MATERIALS[_K.OAK]
    if category.endswith("sink") and first and asset.size_m[2] >= _SINK_BODY_M:
        return MATERIALS[_K.LACQUER]
    return body


def _moving(category: str, body: Material) -> Material:
    """Return the material of a door or a drawer."""
    if category in _DARK_DOORS:
        return replace(MATERIALS[_K.BLACK_PLASTIC], pattern=Pattern.SCREEN)
    red, green, blue = (channel + _LIGHTER * (1.0 - channel) for channel in body.color)
    pattern = Pattern.PANEL if body.pattern in (Pattern.GRAIN, Pattern.PLAIN) else body.pattern
    return replace(body, color=(red, green, blue), pattern=pattern)


def _front(part: ConvexPart) -> float:
    return part.size_m[1] * part.size_m[2]


def _is_shade(asset: Asset, part: ConvexPart) -> bool:
    """Return True for a wide part of a lamp, but for its foot."""
    wide = max(part.size_m[:2]) > 0.3 * max(asset.size_m[:2])
    return wide and not (
        asset.category in _STANDING_LAMPS and part.pose.position_m[2] < -0.25 * asset.size_m[2]
    )
