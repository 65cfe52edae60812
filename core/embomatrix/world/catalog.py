"""Catalog of BEHAVIOR-1K from package data: categories, object models, abilities and scene inventories.

A category is a kind of solid object; substances (water, salt, diced apple) are synsets with the ability "substance". The
tables in ``data/`` (see their NOTICE) are derived from the ``bddl`` package. The only run-time changes are the corrections in
this module and in `appliance_rules`. Sizes are metres (depth x, width y, height z), masses kilograms, temperatures degrees
Celsius.
"""

from __future__ import annotations

import difflib
import functools
import gzip
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from importlib import resources
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from embomatrix.world.appliance_rules import corrected

if TYPE_CHECKING:
    from embomatrix.world.geometry import Vec2, Vec3

Json = Any
Count = tuple[str, str, int]
"""Category, model and number of copies."""

MIN_EXTENT_M: Final = 0.003
"""Smallest extent: thinner boxes (paper, glue) grow to it, since contact margins of physics engines are of this order."""
SHARE_MARK: Final = "@"
LEAST_SHARE, MOST_SHARE = 0.5, 2.0
"""Scale factors that a model may be made at."""

WITH_A_SWITCH: Final = frozenset({"fairy_light.n.01", "icicle_lights.n.01"})
"""Strings of lights, which tasks switch on and off; the derived table lacks this ability."""


class CatalogError(LookupError):
    """Unknown scene, category, model or synset; the message names close matches."""


@dataclass(frozen=True, slots=True)
class Category:
    """Kind of object. ``abilities`` maps e.g. "heatSource" to its numeric parameters."""

    name: str
    synset: str
    mass_kg: float
    abilities: Mapping[str, Mapping[str, float]]


@dataclass(frozen=True, slots=True)
class Model:
    """Model of a category; ``meta_links`` lists its features: "joint", "togglebutton", "fillable", "heatsource" ...

    A ``model_id`` that ends with ``@`` and a number, ``kfeuep@0.8``, denotes the model scaled by this factor.
    """

    category: str
    model_id: str
    size_m: Vec3
    meta_links: frozenset[str] = frozenset()

    @property
    def asset_id(self) -> str:
        return f"{self.category}-{self.model_id}"

    @property
    def share(self) -> float:
        """Scale against the catalog's model; the mass scales with its cube."""
        return share_of(self.model_id)

    @property
    def listed_id(self) -> str:
        """Model id in the catalog, without the scale."""
        return self.model_id.partition(SHARE_MARK)[0]

    def at(self, share: float) -> Model:
        """Scale a model of the catalog's size. Raises CatalogError."""
        return _at_share(self, str(share))


@dataclass(frozen=True, slots=True)
class RoomInventory:
    """Inventory of one room.

    ``floor_m`` is (depth x, width y) of the largest floor, ``more_floors_m`` those of the others. ``floor_estimated`` marks
    the few rooms without a floor in their inventory; these take the median floor of their room type. A door is listed in each
    of the rooms that it joins.
    """

    name: str
    type: str
    floor_m: Vec2
    items: tuple[Count, ...]
    doors: tuple[Count, ...]
    windows: tuple[Count, ...]
    more_floors_m: tuple[Vec2, ...] = ()
    floor_estimated: bool = False


@dataclass(frozen=True, slots=True)
class SceneInventory:
    """Rooms of one of the 51 scenes, by name."""

    scene_id: str
    description: str
    rooms: tuple[RoomInventory, ...]


@dataclass(frozen=True, slots=True)
class SizeRule:
    """Bounds on the extents of a category's models; an extent outside them moves to the bound."""

    reason: str
    low_m: Vec3 = (0.0, 0.0, 0.0)
    high_m: Vec3 = (100.0, 100.0, 100.0)

    def apply(self, size_m: Vec3) -> Vec3:
        x, y, z = (min(max(v, lo), hi) for v, lo, hi in zip(size_m, self.low_m, self.high_m, strict=True))
        return (x, y, z)


SIZE_RULES: Final[Mapping[str, SizeRule]] = MappingProxyType(
    {
        "wardrobe": SizeRule("native scale: 2.84 m high, 1.9 m deep", high_m=(0.7, 2.4, 2.2)),
        "breakfast_table": SizeRule("native scale: tops at 0.29 to 0.65 m", low_m=(0.6, 0.6, 0.7)),
        "desk": SizeRule("native scale: tops at 0.47 to 0.65 m", low_m=(0.45, 0.7, 0.7)),
        "straight_chair": SizeRule("one model is 0.37 m high", low_m=(0.34, 0.34, 0.72)),
        "bottom_cabinet": SizeRule("native scale: 0.18 m deep; nothing fits inside", low_m=(0.42, 0.42, 0.5)),
        "bottom_cabinet_no_top": SizeRule("goes beside bottom_cabinet", low_m=(0.42, 0.42, 0.5)),
        "top_cabinet": SizeRule("native scale: 0.16 m high; nothing fits inside", low_m=(0.32, 0.4, 0.4)),
        "microwave": SizeRule("native scale: 0.26 m deep, less than a plate", low_m=(0.38, 0.46, 0.27)),
        "oven": SizeRule("native scale: 0.39 m deep", low_m=(0.5, 0.5, 0.49)),
        "stove": SizeRule("native scale: a range 0.48 m high", low_m=(0.5, 0.55, 0.85)),
        "dishwasher": SizeRule("native scale: 0.44 m deep", low_m=(0.55, 0.52, 0.65)),
    }
)  # fmt: skip
"""Corrections of native scales in BEHAVIOR-1K that are wrong in a house (its scenes rescale those instances)."""


class Catalog:
    """Read-only access to the tables: 1,826 categories with their models, 51 scenes. Use `Catalog.load`."""

    def __init__(self, tables: Json, scenes: Json) -> None:
        self._synsets: Mapping[str, Json] = tables["synsets"]
        self._categories: Mapping[str, Json] = tables["categories"]
        self._scenes: Mapping[str, Json] = scenes["scenes"]
        self._activity_synsets: tuple[str, ...] = tuple(tables.get("activity_synsets", ()))

    @staticmethod
    @functools.cache
    def load() -> Catalog:
        """Return the catalog of the installed package; the first call of a process reads it (about 0.1 s)."""
        return Catalog(_read("catalog.json.gz"), _read("scenes.json.gz"))

    @property
    def scene_ids(self) -> tuple[str, ...]:
        return tuple(sorted(self._scenes))

    @property
    def category_names(self) -> tuple[str, ...]:
        return tuple(sorted(self._categories))

    @functools.cached_property
    def used_categories(self) -> tuple[str, ...]:
        """Categories that an inventory or an activity of BEHAVIOR-1K mentions, sorted."""
        found = {name for synset in self._activity_synsets for name in self.categories_of(synset)}
        for scene in self._scenes.values():
            for room in scene["rooms"].values():
                keys = (key for part in ("objects", "doors", "windows") for key in room[part])
                found.update(_split(key)[0] for key in keys)
        return tuple(sorted(found))

    def inventory(self, scene_id: str) -> SceneInventory:
        """Rooms and models of a scene. Raises CatalogError for an unknown scene."""
        entry = _look_up(self._scenes, scene_id, "scene")
        rooms = tuple(_room(name, room) for name, room in sorted(entry["rooms"].items()))
        return SceneInventory(scene_id, _description(scene_id, rooms), rooms)

    @functools.cache  # noqa: B019 - the one instance lives as long as the process
    def category(self, name: str) -> Category:
        """Synset, mass and abilities of a category after `SOURCE_RULES`. Raises CatalogError."""
        entry = _look_up(self._categories, name, "category")
        return Category(
            name=name,
            synset=entry["synset"],
            mass_kg=entry["mass_kg"],
            abilities=corrected(name, self.abilities_of(entry["synset"])),
        )

    @functools.cache  # noqa: B019
    def model(self, category: str, model_id: str) -> Model:
        """Size and features of a model after `SIZE_RULES` and the scale in its id. Raises CatalogError."""
        models = _look_up(self._categories, category, "category")["models"]
        listed, _, share = model_id.partition(SHARE_MARK)
        x, y, z, *links = _look_up(models, listed, f"model of {category}")
        size = (max(x, MIN_EXTENT_M), max(y, MIN_EXTENT_M), max(z, MIN_EXTENT_M))
        rule = SIZE_RULES.get(category)
        size = rule.apply(size) if rule else size
        return _at_share(Model(category, listed, size, frozenset(links[0] if links else ())), share)

    def models_of(self, category: str) -> tuple[Model, ...]:
        """All models of a category, by id. Raises CatalogError."""
        models = _look_up(self._categories, category, "category")["models"]
        return tuple(self.model(category, model_id) for model_id in sorted(models))

    def synset_of(self, category: str) -> str:
        """WordNet-like synset of a category, ``apple.n.01``. Raises CatalogError."""
        return str(_look_up(self._categories, category, "category")["synset"])

    @functools.cache  # noqa: B019
    def categories_of(self, synset: str) -> tuple[str, ...]:
        """Categories of a synset and all its descendants, sorted. Raises CatalogError."""
        return tuple(sorted({name for s in self._descendants(synset) for name in self._by_synset.get(s, ())}))

    def is_a(self, synset: str, ancestor: str) -> bool:
        """True when ``synset`` is ``ancestor`` or one of its descendants. Raises CatalogError for unknown names."""
        _look_up(self._synsets, synset, "synset")
        return synset in self._descendants(ancestor)

    def has_synset(self, synset: str) -> bool:
        return synset in self._synsets

    @functools.cache  # noqa: B019
    def abilities_of(self, synset: str) -> Mapping[str, Mapping[str, float]]:
        """Abilities and numeric parameters of a synset; empty for inner nodes. Raises CatalogError.

        The twelve abilities of every solid object (it can become dusty, stained, wet ...) are left out. Substances have the
        ability "substance".
        """
        raw = _look_up(self._synsets, synset, "synset").get("abilities", {})
        if synset in WITH_A_SWITCH:
            raw = {**raw, "toggleable": {}}
        return MappingProxyType({name: MappingProxyType(values) for name, values in raw.items()})

    @functools.cached_property
    def _by_synset(self) -> Mapping[str, list[str]]:
        found: dict[str, list[str]] = {}
        for name, entry in self._categories.items():
            found.setdefault(entry["synset"], []).append(name)
        return found

    @functools.cache  # noqa: B019
    def _descendants(self, synset: str) -> frozenset[str]:
        _look_up(self._synsets, synset, "synset")
        seen = {synset}
        waiting = [synset]
        while waiting:
            fresh = set(self._synsets[waiting.pop()]["children"]) - seen
            seen |= fresh
            waiting.extend(sorted(fresh))
        return frozenset(seen)


def _read(name: str) -> Json:
    data = resources.files("embomatrix.world").joinpath("data").joinpath(name).read_bytes()
    return json.loads(gzip.decompress(data))


def _look_up(table: Mapping[str, Json], name: str, kind: str) -> Json:
    try:
        return table[name]
    except KeyError:
        words = set(name.split("_"))
        # For *bread* a slice of bread, rather than a bra.
        sharing = [known for known in table if words & set(known.partition(".")[0].split("_"))]
        close = difflib.get_close_matches(name, sharing, n=3, cutoff=0.0) or difflib.get_close_matches(
            name, table, n=3, cutoff=0.5
        )
        hint = f"did you mean {', '.join(close)}?" if close else f"for example {', '.join(sorted(table)[:3])}"
        if kind == "scene":
            hint += " A scene of your own is named by its file, such as scenes/my_flat.json"
        raise CatalogError(f"unknown {kind} {name!r} (the catalog holds {len(table)}): {hint}") from None


def _room(name: str, entry: Json) -> RoomInventory:
    first, *more = [(depth, width) for depth, width in entry["floors"]]
    return RoomInventory(
        name=name,
        type=entry["type"],
        floor_m=first,
        items=_counts(entry["objects"].items()),
        doors=_counts(entry["doors"].items()),
        windows=_counts(entry["windows"].items()),
        more_floors_m=tuple(more),
        floor_estimated=entry.get("floor_estimated", False),
    )


def share_of(name: str) -> float:
    """Scale factor in a model id or an asset id; 1 without one."""
    _, mark, share = name.partition(SHARE_MARK)
    return float(share) if mark else 1.0


def _at_share(model: Model, share: str) -> Model:
    if not share:
        return model
    try:
        factor = float(share)
    except ValueError:
        factor = math.nan
    if not LEAST_SHARE <= factor <= MOST_SHARE:
        raise CatalogError(
            f"{model.asset_id} at a share of {share!r} of its size: expected a number from {LEAST_SHARE} to {MOST_SHARE}"
        )
    x, y, z = (max(factor * extent, MIN_EXTENT_M) for extent in model.size_m)
    return replace(model, model_id=f"{model.model_id}{SHARE_MARK}{share}", size_m=(x, y, z))


def _counts(entries: Iterable[tuple[str, int]]) -> tuple[Count, ...]:
    return tuple((*_split(asset_id), count) for asset_id, count in sorted(entries))


def _split(asset_id: str) -> tuple[str, str]:
    category, _, model = asset_id.rpartition("-")
    return category, model


def _description(scene_id: str, rooms: tuple[RoomInventory, ...]) -> str:
    """Describe an inventory: ``Rs_int: 5 rooms (bathroom, bedroom ...), 55 objects, 71 m2 of floor.``"""
    types = Counter(room.type.replace("_", " ") for room in rooms)
    listed = ", ".join(name if n == 1 else f"{n} {name}s" for name, n in sorted(types.items()))
    objects = sum(count for room in rooms for _, _, count in room.items)
    area = sum(room.floor_m[0] * room.floor_m[1] for room in rooms)
    noun = "room" if len(rooms) == 1 else "rooms"
    return f"{scene_id}: {len(rooms)} {noun} ({listed}), {objects} objects, {area:.0f} m2 of floor."
