"""The objects and assets of a bundle as they usually are, read in one go.

``codec`` and ``codec_asset`` look at one value after another and can name each that breaks a rule; that is half of loading
a scene. Here values are put together first, and the rules are checked over all of them at once: all numbers are finite, all
names are names. Whatever is unusual, broken or only written in another way (a whole number for a float), is None, and is
read there: nothing is taken here that would be refused, or read as something else, there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final

from embomatrix.world.asset import Asset, Interior, Link, SupportSurface
from embomatrix.world.codec_asset import (
    ASSET_KEYS,
    INTERIOR_KEYS,
    MAX_LINKS,
    MAX_MASS_KG,
    MAX_PARTS,
    SUPPORT_KEYS,
    asset_from_field,
    joint_from_field,
)
from embomatrix.world.field import FORBIDDEN, MAX_NAME, Field
from embomatrix.world.geometry import Shape
from embomatrix.world.scene import SceneObject
from embomatrix.world.state import Relation, State
from embomatrix.world.tables import MAX_COORDINATE_M, MIN_EXTENT_M

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from embomatrix.world.tables import Tables

OBJECT_KEYS: Final = (
    "name",
    "asset_id",
    "room",
    "pose",
    "fixed",
    "joints",
    "host",
    "relation",
    "states",
)
_object: Final = itemgetter(*OBJECT_KEYS)
_asset: Final = itemgetter(*ASSET_KEYS)
_support: Final = itemgetter(*SUPPORT_KEYS)
_interior: Final = itemgetter(*INTERIOR_KEYS)
_RELATIONS: Final[Mapping[str, Relation | None]] = {
    "": None,
    **{relation.value: relation for relation in Relation},
}
_STATES: Final[Mapping[str, State]] = {state.value: state for state in State}
_STATELESS: Final[frozenset[State]] = frozenset()
UNUSUAL: Final = (KeyError, TypeError, ValueError, AttributeError, IndexError)
"""What comes of a value that is not of the shape it is taken for. SceneInvalidError is a ValueError."""


class _UnusualError(ValueError):
    """Values are not plain."""


@dataclass(slots=True)
class _Columns:
    """Values that were taken as they are, to be looked at together."""

    texts: list[Any] = field(default_factory=list)
    names: list[Any] = field(default_factory=list)
    numbers: list[Any] = field(default_factory=list)
    extents: list[Any] = field(default_factory=list)
    """Of assets and their cavities and surfaces; they are among ``numbers`` too."""

    def check(self) -> None:
        """Raise unless all are what they were taken for."""
        _expect(set(map(type, self.texts)) <= {str})
        _expect(set(map(type, self.names)) <= {str} and all(self.names))
        _expect(max(map(len, self.names), default=0) <= MAX_NAME)
        joined = "".join(self.names)
        _expect(joined.isprintable() and FORBIDDEN.isdisjoint(joined))
        _expect(set(map(type, self.numbers)) <= {float} and math.isfinite(sum(self.numbers)))
        _expect(min(self.extents, default=1.0) > MIN_EXTENT_M)


def plain_objects(
    values: object,
    assets: Mapping[str, Asset],
    tables: Tables,
    odd: Callable[[int], SceneObject],
) -> tuple[SceneObject, ...] | None:
    """The objects of a scene; None where any of them is not plain.

    ``odd`` reads the one at an index, if it has other keys than most, and raises SceneInvalidError.
    """
    try:
        return _objects(values, assets, tables, odd)
    except UNUSUAL:
        return None


def plain_assets(values: object, tables: Tables) -> dict[str, Asset] | None:
    """The assets of a scene by their ids; None for any that are not plain."""
    try:
        return _assets(values, tables)
    except UNUSUAL:
        return None


def _objects(
    values: Any, assets: Mapping[str, Asset], tables: Tables, odd: Callable[[int], SceneObject]
) -> tuple[SceneObject, ...]:
    _expect(set(map(type, _list(values))) == {dict})
    others = {index: odd(index) for index, value in enumerate(values) if len(value) != len(OBJECT_KEYS)}
    plain = [_object(value) for value in values if len(value) == len(OBJECT_KEYS)]
    names, ids, rooms, rows, fixed, joints, hosts, relations, states = zip(*plain, strict=True)
    columns = _Columns(texts=[*rooms, *hosts], names=[*names])
    _expect(set(map(type, fixed)) == {bool} and set(map(type, (*joints, *states))) == {list})
    moving = {key: len(asset.joints) for key, asset in assets.items()}
    for key, shares in zip(ids, joints, strict=True):
        _expect(len(shares) == moving[key])
        columns.numbers += shares
    columns.check()
    _expect(min(columns.numbers, default=0.0) >= 0.0 and max(columns.numbers, default=0.0) <= 1.0)
    # Equal texts of a file become one text: fewer pages to copy when a fork counts references.
    shared = {text: text for text in columns.texts}
    made = (
        SceneObject(
            name,
            assets[key].asset_id,
            shared[room],
            pose,
            still,
            tuple(shares),
            shared[host],
            _RELATIONS[relation],
            frozenset([_STATES[state] for state in found]) if found else _STATELESS,
        )
        for name, key, room, pose, still, shares, host, relation, found in zip(
            names, ids, rooms, tables.poses_at(rows), fixed, joints, hosts, relations, states, strict=True
        )
    )
    return tuple([others[index] if index in others else next(made) for index in range(len(values))])


def _assets(values: Any, tables: Tables) -> dict[str, Asset]:
    columns = _Columns()
    assets = {key: _asset_of(value, columns, tables) for key, value in values.items()}
    columns.check()
    _expect(max(columns.extents, default=0.0) <= MAX_COORDINATE_M)
    _expect(all(0.0 < asset.mass_kg <= MAX_MASS_KG for asset in assets.values()))
    _expect(all(key == asset.asset_id for key, asset in assets.items()))
    return assets


def _asset_of(value: Any, columns: _Columns, tables: Tables) -> Asset:
    if len(value) != len(ASSET_KEYS):
        return asset_from_field(Field(value, "asset", tables=tables))
    asset_id, category, synset, size, mass, links, supports, interiors, abilities = _asset(value)
    columns.names += (asset_id, category)
    columns.texts.append(synset)
    columns.numbers.append(mass)
    made, moving = _links(links, columns, tables)
    cavities = tuple([_interior_of(item, columns, moving) for item in _list(interiors)])
    inside = {"", *(item.name for item in cavities)}
    for params in abilities.values():
        columns.numbers += params.values()
    return Asset(
        asset_id,
        category,
        synset,
        _vec3(size, columns, extent=True),
        mass,
        made,
        tuple([_support_of(item, columns, inside, moving) for item in _list(supports)]),
        cavities,
        abilities,
    )


def _links(values: Any, columns: _Columns, tables: Tables) -> tuple[tuple[Link, ...], set[str]]:
    """Links, and the names of those that move."""
    _expect(0 < len(_list(values)) <= MAX_LINKS)
    links: list[Link] = []
    for index, value in enumerate(values):
        _expect(len(value) == (3 if index else 2))
        parts = tables.parts_at(_list(value["parts"]))
        _expect(0 < len(parts) <= MAX_PARTS)
        joint = joint_from_field(Field(value["joint"], "joint")) if index else None
        links.append(Link(value["name"], parts, joint))
        columns.names.append(value["name"])
    names = [link.name for link in links]
    _expect(len(set(names)) == len(names))
    # A hull is a body of its own.
    bodies = sum(1 + sum(part.shape is Shape.HULL for part in link.parts) for link in links)
    _expect(bodies <= MAX_LINKS)
    return tuple(links), set(names[1:])


def _support_of(value: Any, columns: _Columns, inside: set[str], moving: set[str]) -> SupportSurface:
    name, center, (width, depth), clearance, interior = _support(value)
    columns.names.append(name)
    columns.numbers += (width, depth, clearance)
    columns.extents += (width, depth)
    _expect(interior in inside and type(value["size_m"]) is list)
    link = _link_below(value, len(SUPPORT_KEYS), moving)
    return SupportSurface(name, _vec3(center, columns), (width, depth), clearance, interior, link)


def _interior_of(value: Any, columns: _Columns, moving: set[str]) -> Interior:
    name, center, size, closed_by = _interior(value)
    columns.names.append(name)
    _expect(moving.issuperset(_list(closed_by)))
    link = _link_below(value, len(INTERIOR_KEYS), moving)
    return Interior(name, _vec3(center, columns), _vec3(size, columns, extent=True), tuple(closed_by), link)


def _link_below(value: Any, keys: int, moving: set[str]) -> str:
    """The moving link that a surface or a cavity rides on."""
    if len(value) == keys:
        return ""
    _expect(len(value) == keys + 1 and value["link"] in moving)
    return str(value["link"])


def _vec3(value: Any, columns: _Columns, *, extent: bool = False) -> tuple[float, float, float]:
    x, y, z = _list(value)
    columns.numbers += (x, y, z)
    if extent:
        columns.extents += (x, y, z)
    return (x, y, z)


def _list(value: Any) -> Sequence[Any]:
    _expect(type(value) is list)
    items: Sequence[Any] = value
    return items


def _expect(plain: bool) -> None:
    if not plain:
        raise _UnusualError
