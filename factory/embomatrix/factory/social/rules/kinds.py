"""Abilities of kinds of objects, from the models of the catalog: a kind can do whatever one of its models can."""

import functools
from dataclasses import dataclass
from typing import Final

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.scenes.view import is_liftable
from embomatrix.skills.appliances import cold_source, cooks, freezes, heat_source, heats
from embomatrix.world.asset import Asset
from embomatrix.world.catalog import Catalog
from embomatrix.world.state import State

MIN_HOST_M: Final = 0.05
"""Minimum extents of a surface or a cavity that holds anything."""
SMALLEST_SHARE: Final = 0.5
"""Smallest scale of a model in a layout."""
MAX_MODELS: Final = 12
"""Number of models of a kind that are examined."""


@dataclass(frozen=True, slots=True)
class KindAbilities:
    """Abilities of a kind. ``smallest_m`` are the sorted extents of its smallest portable model."""

    is_portable: bool
    is_openable: bool
    is_switchable: bool
    is_sliceable: bool
    surfaces_m: tuple[tuple[float, float], ...]
    cavities_m: tuple[tuple[float, float, float], ...]
    smallest_m: tuple[float, float, float]

    def takes(self, guest: "KindAbilities", *, inside: bool) -> bool:
        """True if a surface or a cavity is larger than the guest's smallest model."""
        low, middle, high = guest.smallest_m
        if inside:
            return any(low < a and middle < b and high < c for a, b, c in self.cavities_m)
        return any(low < a and middle < b for a, b in self.surfaces_m)


@functools.cache
def abilities_of(kind: str) -> KindAbilities:
    """Return the abilities of a kind. Raise CatalogError for an unknown one."""
    assets = _assets(kind)
    portable = [asset for asset in assets if _is_liftable_scaled(asset)]
    smallest = min((portable or list(assets)), key=lambda asset: sorted(asset.size_m))
    low, middle, high = sorted(smallest.size_m)
    surfaces = {_sorted_pair(surface.size_m) for asset in assets for surface in asset.open_supports}
    cavities = {_sorted_triple(inner.size_m) for asset in assets for inner in asset.interiors}
    return KindAbilities(
        is_portable=bool(portable),
        is_openable=any(asset.joints and asset.can("openable") for asset in assets),
        is_switchable=any(asset.can("toggleable") for asset in assets),
        is_sliceable=any(asset.can("sliceable") for asset in assets),
        surfaces_m=tuple(sorted(pair for pair in surfaces if pair[0] >= MIN_HOST_M)),
        cavities_m=tuple(sorted(triple for triple in cavities if triple[0] >= MIN_HOST_M)),
        smallest_m=(low, middle, high),
    )


def _is_liftable_scaled(asset: Asset) -> bool:
    """True if the robot lifts the model at the smallest scale that a layout uses."""
    width, depth, height = (extent * SMALLEST_SHARE for extent in asset.size_m)
    return is_liftable((width, depth, height), asset.mass_kg * SMALLEST_SHARE**3)


@functools.cache
def effects_of(source: str, food: str) -> frozenset[State]:
    """Return the states that some model of the source gives the food. Raise CatalogError."""
    found: set[State] = set()
    eaten = _assets(food)[0]
    for asset in _assets(source):
        heat, cold = heat_source(asset), cold_source(asset)
        if cold is not None and freezes(cold) and eaten.can("freezable"):
            found.add(State.FROZEN)
        if heat is not None and heats(heat) and eaten.can("heatable"):
            found.add(State.HOT)
        if heat is not None and cooks(heat, eaten):
            found.add(State.COOKED)
    return frozenset(found)


def can_become(kind: str, state: State) -> bool:
    """True if heat or cold can bring the state about, regardless of its source. Raise CatalogError."""
    ability = {State.COOKED: "cookable", State.HOT: "heatable", State.FROZEN: "freezable"}[state]
    return any(asset.can(ability) for asset in _assets(kind))


@functools.cache
def _assets(kind: str) -> tuple[Asset, ...]:
    catalog = Catalog.load()
    models = catalog.models_of(kind)
    return tuple(build_asset(catalog, kind, model.model_id) for model in models[:MAX_MODELS])


def _sorted_pair(size_m: tuple[float, float]) -> tuple[float, float]:
    low, high = sorted(size_m)
    return low, high


def _sorted_triple(size_m: tuple[float, float, float]) -> tuple[float, float, float]:
    low, middle, high = sorted(size_m)
    return low, middle, high
