"""Models and sizes for the objects that a problem adds.

The catalog has only one model, of one size, for many types: a sausage larger than its box, a backpack too wide for
the gripper. If no model of a type meets the requirements, a scaled model is used, within limits.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.scenes.view import is_liftable
from embomatrix.factory.task_import.binding import Addition
from embomatrix.factory.task_import.search import has_abilities
from embomatrix.factory.task_import.size_requirements import CavityFit, Requirement, floor_needed_m2, room_for
from embomatrix.sim.geometry.candidates import candidates, surfaces_for
from embomatrix.sim.planner.subgoals import CANDIDATES, MIDDLE
from embomatrix.world.asset import Asset
from embomatrix.world.catalog import Catalog, Model
from embomatrix.world.state import Relation

MODEL_TRIES: Final = 5
"""Maximum number of models tried for an object."""
LOOKED_AT: Final = 4 * MODEL_TRIES
"""Maximum number of models whose abilities are checked."""


def models_for(
    addition: Addition,
    rng: np.random.Generator,
    requirement: Requirement,
    categories: Sequence[str] | None = None,
    imported: Mapping[str, Asset] | None = None,
) -> list[Model]:
    """Return at most five models of the type, or of these categories, with the required abilities, liftable ones first.

    Among liftable models, large ones come first if the object supports others, otherwise small ones. Among furniture,
    two of medium size come first, then the smallest. On other furniture only small models are used. If no liftable
    model has space for all contents, models that do come first, unless the object is carried. The scene's ``imported`` models,
    by asset id, come before all others.
    """
    own = imported or {}

    def asset_of(model: Model) -> Asset:
        return own.get(model.asset_id) or _asset(model)

    catalog = Catalog.load()
    models = [
        (model, catalog.category(category).mass_kg)
        for category in categories or catalog.categories_of(addition.type)
        for model in catalog.models_of(category)
    ]
    light: list[tuple[float, Model]] = []
    heavy: list[tuple[float, Model]] = []
    for model, mass in models:
        volume = math.prod(model.size_m) * float(rng.uniform(0.7, 1.4))
        if is_liftable(model.size_m, mass):
            light.append((-math.prod(model.size_m) if requirement.bears else volume, model))
        else:
            heavy.append((volume, model))
    order = [*_ranked(light), *(_ranked(heavy) if addition.host else _middling_first(heavy))]
    order.sort(key=lambda model: model.asset_id not in own)
    able = [model for model in order[:LOOKED_AT] if has_abilities(asset_of(model), addition.needs)]
    if requirement.contents:
        # A stable sort: models with space for everything come first.
        carried = [model for _, model in light] if requirement.carried else []
        able.sort(
            key=lambda model: (
                bool(carried) and model not in carried,
                room_for(asset_of(model), requirement.contents),
            )
        )
    return able[:MODEL_TRIES]


def _asset(model: Model) -> Asset:
    return build_asset(Catalog.load(), model.category, model.model_id)


def _ranked(models: Sequence[tuple[float, Model]]) -> list[Model]:
    """Return the models sorted by their number, the smallest first."""
    return [model for _, model in sorted(models, key=lambda item: item[0])]


def _middling_first(models: Sequence[tuple[float, Model]]) -> list[Model]:
    """Return the models by volume, the smallest first, after two of medium size."""
    order = _ranked(models)
    middle = len(order) // 2
    first = order[max(0, middle - 1) : middle + 1]
    return [*reversed(first), *(model for model in order if model not in first)]


SMALLER: Final = (0.9, 0.8, 0.7, 0.6, 0.5)
LARGER: Final = (1.2, 1.4, 1.6)
"""Scale factors of models, the nearest to 1 first."""
KEPT: Final = 2
"""Maximum number of scaled models tried before the catalog's own."""


@dataclass(frozen=True, slots=True)
class HostPlacement:
    """Placement of an object at the start or in the goal: relation, host, and maximum scale of the object."""

    relation: Relation
    host: Asset
    share: float


def with_sizes(
    orders: Mapping[str, Sequence[Model]],
    additions: Sequence[Addition],
    requirements: Mapping[str, Requirement],
    found: Mapping[str, Asset],
    *,
    compact: bool = False,
) -> dict[str, list[Model]]:
    """Return the models to try for each addition. Models that meet the requirements come first, otherwise scaled ones.

    ``requirements`` are those of each object of the problem; ``found`` holds the assets of bound scene objects. Hosts
    are chosen before the objects on them. With ``compact``, objects that share a host are scaled to fit side by side.
    """
    chosen = {name: list(models) for name, models in orders.items()}
    for addition in sorted(additions, key=lambda each: not requirements[each.name].bears):
        requirement = (
            requirements[addition.name] if compact else replace(requirements[addition.name], burden=())
        )
        places = [
            HostPlacement(relation, host, _share_of_all(host, requirements[name]) if compact else math.inf)
            for relation, name in requirement.places
            if (host := found.get(name) or next(map(_asset, chosen.get(name, ())), None)) is not None
        ]
        models = _ordered(chosen[addition.name], requirement, places)
        if (
            compact
            and (requirement.contents or requirement.burden)
            and not _meets(models[0], requirement, places)
        ):
            models = [*_enlarged(models, requirement, places), *models]
        chosen[addition.name] = models
    return chosen


def _share_of_all(host: Asset, requirement: Requirement) -> float:
    """Return the scale at which all objects fit into or onto a host; infinite if they fit at full size."""
    least = math.inf
    for relation, types in ((Relation.INSIDE, requirement.contents), (Relation.ONTOP, requirement.burden)):
        floor_m2 = sum(math.prod(surface.size_m) for surface in surfaces_for(host, relation))
        needed_m2 = floor_needed_m2(types)
        if needed_m2 > floor_m2:
            least = min(least, math.sqrt(floor_m2 / needed_m2))
    return least


def _ordered(models: list[Model], requirement: Requirement, places: Sequence[HostPlacement]) -> list[Model]:
    most = max(SMALLER[-1], min((place.share for place in places), default=math.inf))
    fit = [model for model in models if model.share <= most and _meets(model, requirement, places)]
    if fit:
        return [*fit, *(model for model in models if model not in fit)]
    made = [
        model
        for model in _resized(models, requirement)
        if model.share <= most and _meets(model, requirement, places)
    ]
    if not made and requirement.carried:
        # a model that meets only part of the requirements must at least be portable
        made = [model for model in (*models, *_resized(models, Requirement())) if _is_liftable(model)]
    return [*made[:KEPT], *models]


def _enlarged(
    models: Sequence[Model], requirement: Requirement, places: Sequence[HostPlacement]
) -> list[Model]:
    """Return the models at the largest scale, for more contents than any model has space for.

    The contents are scaled down too.
    """
    largest = [model.at(LARGER[-1]) for model in models if model.share == 1]
    less = replace(requirement, contents=(), burden=())
    return [model for model in largest if _meets(model, less, places)][:KEPT]


def _resized(models: Sequence[Model], requirement: Requirement) -> Iterator[Model]:
    """Yield the models at other scales: larger ones for hosts, then smaller ones."""
    for share in (*(LARGER if requirement.contents or requirement.burden else ()), *SMALLER):
        for model in models:
            yield model.at(share)


def _meets(model: Model, requirement: Requirement, places: Sequence[HostPlacement]) -> bool:
    asset = _asset(model)
    if requirement.carried and not _is_liftable(model):
        return False
    if requirement.contents and room_for(asset, requirement.contents) is not CavityFit.FOR_ALL:
        return False
    if requirement.burden and room_for(asset, requirement.burden, Relation.ONTOP) is not CavityFit.FOR_ALL:
        return False
    # The object has a pose on or in each of its hosts, by geometry alone.
    return all(
        next(candidates(asset, place.host, place.relation, MIDDLE, CANDIDATES), None) is not None
        for place in places
    )


def _is_liftable(model: Model) -> bool:
    asset = _asset(model)
    return is_liftable(asset.size_m, asset.mass_kg)
