"""Models are scaled only if no model of the type meets the requirements."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import pytest

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.furnish.roles import is_portable
from embomatrix.factory.task_import.binding import Addition
from embomatrix.factory.task_import.models import with_sizes
from embomatrix.factory.task_import.size_requirements import Requirement
from embomatrix.sim.geometry.candidates import candidates, surfaces_for
from embomatrix.sim.planner.subgoals import CANDIDATES, MIDDLE
from embomatrix.world.catalog import Catalog
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from embomatrix.world.asset import Asset
    from embomatrix.world.catalog import Model

CATALOG = Catalog.load()


def chosen(
    categories: dict[str, str], requirements: dict[str, Requirement], *, compact: bool = False
) -> dict[str, list[Model]]:
    """Return models for objects of some categories, all of them additions."""
    orders = {name: CATALOG.models_of(category) for name, category in categories.items()}
    additions = [Addition(name, "", None, "", "") for name in categories]
    wanted = {name: requirements.get(name, Requirement()) for name in categories}
    return with_sizes(orders, additions, wanted, {}, compact=compact)


def asset_of(model: Model) -> Asset:
    return build_asset(CATALOG, model.category, model.model_id)


def test_graspable_object_keeps_its_size_and_others_are_scaled_down() -> None:
    found = chosen(
        {"mug": "mug", "backpack": "backpack"},
        {"mug": Requirement(carried=True), "backpack": Requirement(carried=True)},
    )
    assert found["mug"] == [model for model in CATALOG.models_of("mug") if is_portable(asset_of(model))] + [
        model for model in CATALOG.models_of("mug") if not is_portable(asset_of(model))
    ]
    assert not any(is_portable(asset_of(model)) for model in CATALOG.models_of("backpack"))
    first = found["backpack"][0]
    assert first.share < 1
    assert is_portable(asset_of(first))
    assert tuple(found["backpack"][-1:]) == CATALOG.models_of("backpack")[-1:], (
        "its own size is the last resort"
    )


def test_carried_container_is_portable_even_without_space_for_all_contents() -> None:
    requirement = Requirement(bears=True, carried=True, contents=("hardback.n.01",) * 40)
    assert is_portable(asset_of(chosen({"backpack": "backpack"}, {"backpack": requirement})["backpack"][0]))


def test_uncarried_object_keeps_its_size() -> None:
    assert chosen({"backpack": "backpack"}, {})["backpack"] == list(CATALOG.models_of("backpack"))


def test_sausage_fits_into_its_box() -> None:
    found = chosen(
        {"sausage": "chorizo", "box": "tupperware"},
        {
            "sausage": Requirement(carried=True, places=((Relation.INSIDE, "box"),)),
            "box": Requirement(bears=True),
        },
    )
    box, sausage = asset_of(found["box"][0]), asset_of(found["sausage"][0])
    whole = asset_of(CATALOG.models_of("chorizo")[0])
    assert next(candidates(whole, box, Relation.INSIDE, MIDDLE, CANDIDATES), None) is None
    assert next(candidates(sausage, box, Relation.INSIDE, MIDDLE, CANDIDATES), None) is not None
    assert sausage.mass_kg == pytest.approx(whole.mass_kg * found["sausage"][0].share ** 3)


def test_bag_is_scaled_up_for_its_contents() -> None:
    requirement = Requirement(bears=True, contents=("bag__of__brown_rice.n.01",))
    found = chosen({"bag": "paper_bag"}, {"bag": Requirement(bears=True)})
    assert found["bag"][0].share == 1
    grown = chosen({"bag": "shopping_basket"}, {"bag": Requirement(bears=True, contents=("belt.n.02",))})
    assert grown["bag"][0].share > 1
    assert chosen({"bag": "paper_bag"}, {"bag": requirement})["bag"][0] in CATALOG.models_of("paper_bag"), (
        "a predicate that no share can satisfy changes nothing"
    )


@pytest.mark.parametrize("relation", [Relation.INSIDE, Relation.ONTOP])
def test_objects_sharing_a_host_have_more_space_in_a_compact_layout(relation: Relation) -> None:
    names = [f"book_{number}" for number in range(24)]
    types = ("hardback.n.01",) * len(names)
    requirements = {name: Requirement(carried=True, places=((relation, "host"),)) for name in names}
    requirements["host"] = (
        Requirement(bears=True, contents=types)
        if relation is Relation.INSIDE
        else Requirement(bears=True, burden=types)
    )
    category = {Relation.INSIDE: "shopping_basket", Relation.ONTOP: "coffee_table"}[relation]
    categories = {**dict.fromkeys(names, "hardback"), "host": category}

    def filled(found: dict[str, list[Model]]) -> float:
        floor_m2 = sum(math.prod(each.size_m) for each in surfaces_for(asset_of(found["host"][0]), relation))
        return sum(math.prod(found[name][0].size_m[:2]) for name in names) / floor_m2

    assert filled(chosen(categories, requirements, compact=True)) < filled(chosen(categories, requirements))
