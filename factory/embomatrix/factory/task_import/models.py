"""Which models of a type are tried for an object that a problem brings, the best first."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.scenes.view import is_liftable
from embomatrix.factory.task_import.demands import room_for
from embomatrix.factory.task_import.search import serves
from embomatrix.world.catalog import Catalog

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from embomatrix.factory.task_import.binding import Addition
    from embomatrix.factory.task_import.demands import CavityFit, Demand
    from embomatrix.world.asset import Asset
    from embomatrix.world.catalog import Model

MODEL_TRIES: Final = 5
"""Models of a type that are tried before it counts as not fitting its place."""
LOOKED_AT: Final = 4 * MODEL_TRIES
"""Models of which it is asked whether they can do what they must."""


def models_for(addition: Addition, rng: np.random.Generator, demand: Demand) -> list[Model]:
    """At most five models of the type that can do what is asked, the liftable ones before furniture.

    Of what can be lifted large ones come first where it bears others, else small ones. Of furniture two of a middling
    size come first, then the smallest: where these don't fit, none does. On other furniture only small ones go. Where none
    that can be lifted takes all that goes in, what does so comes first, unless the thing is to be carried.
    """
    catalog = Catalog.load()
    models = [
        (model, catalog.category(category).mass_kg)
        for category in catalog.categories_of(addition.type)
        for model in catalog.models_of(category)
    ]
    light: list[tuple[float, Model]] = []
    heavy: list[tuple[float, Model]] = []
    for model, mass in models:
        volume = math.prod(model.size_m) * float(rng.uniform(0.7, 1.4))
        if is_liftable(model.size_m, mass):
            light.append((-math.prod(model.size_m) if demand.bears else volume, model))
        else:
            heavy.append((volume, model))
    order = [*_ranked(light), *(_ranked(heavy) if addition.host else _middling_first(heavy))]
    able = [model for model in order[:LOOKED_AT] if serves(_asset(model), addition.needs)]
    if demand.contents:
        # A sort that keeps the order: among those that take everything, and among the others.
        carried = [model for _, model in light] if demand.carried else []
        able.sort(key=lambda model: (bool(carried) and model not in carried, _room(model, demand)))
    return able[:MODEL_TRIES]


def _room(model: Model, demand: Demand) -> CavityFit:
    return room_for(_asset(model), demand.contents)


def _asset(model: Model) -> Asset:
    return build_asset(Catalog.load(), model.category, model.model_id)


def _ranked(models: Sequence[tuple[float, Model]]) -> list[Model]:
    """Models by a number, the least first."""
    return [model for _, model in sorted(models, key=lambda item: item[0])]


def _middling_first(models: Sequence[tuple[float, Model]]) -> list[Model]:
    """Models by volume, the least first, after two from the middle."""
    order = _ranked(models)
    middle = len(order) // 2
    first = order[max(0, middle - 1) : middle + 1]
    return [*reversed(first), *(model for model in order if model not in first)]
