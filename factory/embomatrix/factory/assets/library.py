"""`build_asset`: the geometry and abilities of a catalog model."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

from embomatrix.factory.assets.cabinets import MAX_PARTS
from embomatrix.factory.assets.families import GENERATORS
from embomatrix.factory.assets.naming import family_of_model
from embomatrix.world.asset import Asset, Link

if TYPE_CHECKING:
    from embomatrix.world.catalog import Catalog


@functools.cache
def build_asset(catalog: Catalog, category: str, model: str) -> Asset:
    """Asset of one model, of exactly its catalog size or the share of it that the id tells; the same on every machine.

    Raises CatalogError for an unknown category or model.
    """
    kind = catalog.category(category)
    entry = catalog.model(category, model)
    family = family_of_model(catalog, category, model)
    body = GENERATORS[family](entry.size_m)
    links = (Link("base", tuple(body.parts)), *body.moving)
    for link in links:
        if not 0 < len(link.parts) <= MAX_PARTS:
            raise AssertionError(
                f"{entry.asset_id}: link {link.name!r} has {len(link.parts)} parts, the engine takes 1 to {MAX_PARTS}: "
                f"mend the generator of {family}"
            )
    return Asset(
        asset_id=entry.asset_id,
        category=category,
        synset=kind.synset,
        size_m=entry.size_m,
        mass_kg=kind.mass_kg * entry.share**3,
        links=links,
        supports=tuple(body.supports),
        interiors=tuple(body.interiors),
        abilities=kind.abilities if not body.moving else {"openable": {}, **kind.abilities},
    )
