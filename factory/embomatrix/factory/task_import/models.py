"""Which models of a type are tried for an object that a problem brings, the best first."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.scenes.view import is_liftable
from embomatrix.factory.task_import.search import serves
from embomatrix.factory.task_import.size_requirements import CavityFit, Demand, floor_needed_m2, room_for
from embomatrix.sim.geometry.candidates import candidates, surfaces_for
from embomatrix.sim.planner.subgoals import CANDIDATES, MIDDLE
from embomatrix.world.catalog import Catalog
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import numpy as np

    from embomatrix.factory.task_import.binding import Addition
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


SMALLER: Final = (0.9, 0.8, 0.7, 0.6, 0.5)
LARGER: Final = (1.2, 1.4, 1.6)
"""Shares at which models are tried, the nearest to their own size first."""
KEPT: Final = 2
"""Models of another size that are tried before the catalog's own."""


@dataclass(frozen=True, slots=True)
class HostPlacement:
    """Where a thing is, or is to be: in ``relation`` to a host, at most at this share of its size."""

    relation: Relation
    host: Asset
    share: float


def sized(
    orders: Mapping[str, Sequence[Model]],
    additions: Sequence[Addition],
    demands: Mapping[str, Demand],
    found: Mapping[str, Asset],
    *,
    snug: bool = False,
) -> dict[str, list[Model]]:
    """Models to try for each addition: those of its order that do what is asked first, else some of another size.

    ``demands`` are those on each thing of the problem, ``found`` assets of the scene's objects that it is bound to. Things that
    bear others are chosen first, so that those know what they are to be put on. When ``snug``, what shares a cavity or a
    surface is small enough for all to lie side by side.
    """
    chosen = {name: list(models) for name, models in orders.items()}
    for addition in sorted(additions, key=lambda each: not demands[each.name].bears):
        demand = demands[addition.name] if snug else replace(demands[addition.name], burden=())
        places = [
            HostPlacement(relation, host, _share_of_all(host, demands[name]) if snug else math.inf)
            for relation, name in demand.places
            if (host := found.get(name) or _first(chosen.get(name, ()))) is not None
        ]
        models = _ordered(chosen[addition.name], demand, places)
        if snug and (demand.contents or demand.burden) and not _suits(models[0], demand, places):
            models = [*_grown(models, demand, places), *models]
        chosen[addition.name] = models
    return chosen


def _share_of_all(host: Asset, demand: Demand) -> float:
    """Share of their size at which all that goes into or onto a host has floor there; no limit where all has it."""
    least = math.inf
    for relation, types in ((Relation.INSIDE, demand.contents), (Relation.ONTOP, demand.burden)):
        floor_m2 = sum(math.prod(surface.size_m) for surface in surfaces_for(host, relation))
        needed_m2 = floor_needed_m2(types)
        if needed_m2 > floor_m2:
            least = min(least, math.sqrt(floor_m2 / needed_m2))
    return least


def _ordered(models: list[Model], demand: Demand, places: Sequence[HostPlacement]) -> list[Model]:
    most = max(SMALLER[-1], min((place.share for place in places), default=math.inf))
    fit = [model for model in models if model.share <= most and _suits(model, demand, places)]
    if fit:
        return [*fit, *(model for model in models if model not in fit)]
    made = [
        model for model in _resized(models, demand) if model.share <= most and _suits(model, demand, places)
    ]
    if not made and demand.carried:
        # what does not do all of it is at least to be carried
        made = [model for model in (*models, *_resized(models, Demand())) if _is_liftable(model)]
    return [*made[:KEPT], *models]


def _grown(models: Sequence[Model], demand: Demand, places: Sequence[HostPlacement]) -> list[Model]:
    """The models as large as can be, for more than any has room for: what goes in is made smaller too."""
    largest = [model.at(LARGER[-1]) for model in models if model.share == 1]
    less = replace(demand, contents=(), burden=())
    return [model for model in largest if _suits(model, less, places)][:KEPT]


def _resized(models: Sequence[Model], demand: Demand) -> Iterator[Model]:
    """The models at other shares of their size: larger ones of what others go into, then smaller ones."""
    for share in (*(LARGER if demand.contents or demand.burden else ()), *SMALLER):
        for model in models:
            yield model.at(share)


def _suits(model: Model, demand: Demand, places: Sequence[HostPlacement]) -> bool:
    asset = _asset(model)
    if demand.carried and not _is_liftable(model):
        return False
    if demand.contents and room_for(asset, demand.contents) is not CavityFit.FOR_ALL:
        return False
    if demand.burden and room_for(asset, demand.burden, Relation.ONTOP) is not CavityFit.FOR_ALL:
        return False
    return all(_goes(asset, place) for place in places)


def _is_liftable(model: Model) -> bool:
    asset = _asset(model)
    return is_liftable(asset.size_m, asset.mass_kg)


def _goes(asset: Asset, place: HostPlacement) -> bool:
    """Whether a thing has a pose on or in its host, by geometry alone."""
    return next(candidates(asset, place.host, place.relation, MIDDLE, CANDIDATES), None) is not None


def _first(models: Sequence[Model]) -> Asset | None:
    return _asset(models[0]) if models else None
