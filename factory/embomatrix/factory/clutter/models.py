"""Models of background objects: small ones of each category, few of them in one scene."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from embomatrix.factory.assets.library import build_asset
from embomatrix.world.asset import Asset
from embomatrix.world.catalog import Catalog, Model
from embomatrix.world.geometry import Vec3

_MODELS: Final[Mapping[str, int]] = {"hardback": 5, "painting": 3, "shelf": 3, "picture": 2, "vase": 2}
"""Models of a category in one scene, 1 for the others: a bundle holds every model, and loading reads it."""
_LARGEST_M: Final[Vec3] = (0.35, 0.35, 0.4)
_LARGEST: Final[Mapping[str, Vec3]] = {
    "painting": (0.05, 1.1, 0.9),
    "picture": (0.8, 0.8, 0.05),
    "poster": (0.05, 0.8, 1.0),
    "mirror": (0.05, 0.8, 1.1),
    "wall_clock": (0.06, 0.4, 0.4),
    "electric_switch": (0.04, 0.12, 0.12),
    "towel_rack": (0.05, 0.6, 0.1),
    "bath_towel": (1.2, 0.6, 0.05),
    "hand_towel": (0.3, 0.3, 0.05),
    "shelf": (0.36, 1.6, 0.17),
    "pillow": (0.55, 0.7, 0.25),
    "teddy_bear": (0.35, 0.4, 0.4),
    "laptop": (0.35, 0.45, 0.06),
    "table_lamp": (0.35, 0.35, 0.55),
    "hardback": (0.26, 0.22, 0.06),
    "paperback_book": (0.26, 0.22, 0.06),
    "vase": (0.22, 0.22, 0.35),
    "statue": (0.22, 0.25, 0.35),
    "pot_plant": (0.3, 0.3, 0.45),
    "newspaper": (0.42, 0.35, 0.02),
}  # fmt: skip
_SMALLEST: Final[Mapping[str, Vec3]] = {
    "painting": (0.0, 0.3, 0.24),
    "picture": (0.25, 0.2, 0.0),
    "shelf": (0.14, 0.5, 0.0),
    "mirror": (0.0, 0.3, 0.4),
    "pillow": (0.3, 0.35, 0.08),
    "hardback": (0.15, 0.1, 0.012),
    "paperback_book": (0.15, 0.1, 0.008),
    "statue": (0.0, 0.0, 0.1),
    "vase": (0.0, 0.0, 0.1),
    "pot_plant": (0.1, 0.1, 0.12),
}


class ModelShelf:
    """Models that one scene uses for its background, chosen by its generator and built once."""

    def __init__(self, catalog: Catalog, rng: np.random.Generator) -> None:
        self._catalog = catalog
        self._rng = rng
        self._models: dict[str, list[Model]] = {}
        self._assets: dict[str, Asset] = {}

    def pick(self, category: str) -> Asset | None:
        """Return one of the scene's models of a category; None if no model is small enough."""
        models = self._models.get(category)
        if models is None:
            models = self._models[category] = self._chosen(category)
        if not models:
            return None
        model = models[int(self._rng.integers(len(models)))]
        if model.asset_id not in self._assets:
            self._assets[model.asset_id] = build_asset(self._catalog, category, model.model_id)
        return self._assets[model.asset_id]

    def _chosen(self, category: str) -> list[Model]:
        low, high = _SMALLEST.get(category, (0.0, 0.0, 0.0)), _LARGEST.get(category, _LARGEST_M)
        fitting = [
            model
            for model in self._catalog.models_of(category)
            if all(a <= size <= b for a, size, b in zip(low, model.size_m, high, strict=True))
        ]
        count = min(_MODELS.get(category, 1), len(fitting))
        return (
            [fitting[int(i)] for i in self._rng.choice(len(fitting), count, replace=False)] if count else []
        )
