"""Where no model of a type can do what a problem asks, one is made of another size; what can is taken as it is."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import pytest

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.furnish.roles import is_portable
from embomatrix.factory.task_import.binding import Addition
from embomatrix.factory.task_import.models import sized
from embomatrix.factory.task_import.size_requirements import Demand
from embomatrix.sim.geometry.candidates import candidates, surfaces_for
from embomatrix.sim.planner.subgoals import CANDIDATES, MIDDLE
from embomatrix.world.catalog import Catalog
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from embomatrix.world.asset import Asset
    from embomatrix.world.catalog import Model

CATALOG = Catalog.load()


def chosen(
    categories: dict[str, str], demands: dict[str, Demand], *, snug: bool = False
) -> dict[str, list[Model]]:
    """Models for things of some categories, all of which are additions."""
    orders = {name: CATALOG.models_of(category) for name, category in categories.items()}
    additions = [Addition(name, "", None, "", "") for name in categories]
    wanted = {name: demands.get(name, Demand()) for name in categories}
    return sized(orders, additions, wanted, {}, snug=snug)


def asset_of(model: Model) -> Asset:
    return build_asset(CATALOG, model.category, model.model_id)


def test_what_the_gripper_takes_keeps_its_size_and_what_it_does_not_is_made_smaller() -> None:
    found = chosen(
        {"mug": "mug", "backpack": "backpack"},
        {"mug": Demand(carried=True), "backpack": Demand(carried=True)},
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


def test_what_must_be_carried_can_be_even_where_it_has_not_room_for_all() -> None:
    demand = Demand(bears=True, carried=True, contents=("hardback.n.01",) * 40)
    assert is_portable(asset_of(chosen({"backpack": "backpack"}, {"backpack": demand})["backpack"][0]))


def test_what_is_only_looked_at_keeps_its_size() -> None:
    assert chosen({"backpack": "backpack"}, {})["backpack"] == list(CATALOG.models_of("backpack"))


def test_a_sausage_goes_into_the_box_that_a_problem_puts_it_in() -> None:
    found = chosen(
        {"sausage": "chorizo", "box": "tupperware"},
        {
            "sausage": Demand(carried=True, places=((Relation.INSIDE, "box"),)),
            "box": Demand(bears=True),
        },
    )
    box, sausage = asset_of(found["box"][0]), asset_of(found["sausage"][0])
    whole = asset_of(CATALOG.models_of("chorizo")[0])
    assert next(candidates(whole, box, Relation.INSIDE, MIDDLE, CANDIDATES), None) is None
    assert next(candidates(sausage, box, Relation.INSIDE, MIDDLE, CANDIDATES), None) is not None
    assert sausage.mass_kg == pytest.approx(whole.mass_kg * found["sausage"][0].share ** 3)


def test_a_bag_grows_for_what_is_to_go_in() -> None:
    demand = Demand(bears=True, contents=("bag__of__brown_rice.n.01",))
    found = chosen({"bag": "paper_bag"}, {"bag": Demand(bears=True)})
    assert found["bag"][0].share == 1
    grown = chosen({"bag": "shopping_basket"}, {"bag": Demand(bears=True, contents=("belt.n.02",))})
    assert grown["bag"][0].share > 1
    assert chosen({"bag": "paper_bag"}, {"bag": demand})["bag"][0] in CATALOG.models_of("paper_bag"), (
        "what no share brings about changes nothing"
    )


@pytest.mark.parametrize("relation", [Relation.INSIDE, Relation.ONTOP])
def test_things_that_share_a_host_have_more_room_when_it_is_to_be_snug(relation: Relation) -> None:
    names = [f"book_{number}" for number in range(24)]
    types = ("hardback.n.01",) * len(names)
    demands = {name: Demand(carried=True, places=((relation, "host"),)) for name in names}
    demands["host"] = (
        Demand(bears=True, contents=types)
        if relation is Relation.INSIDE
        else Demand(bears=True, burden=types)
    )
    category = {Relation.INSIDE: "shopping_basket", Relation.ONTOP: "coffee_table"}[relation]
    categories = {**dict.fromkeys(names, "hardback"), "host": category}

    def filled(found: dict[str, list[Model]]) -> float:
        floor_m2 = sum(math.prod(each.size_m) for each in surfaces_for(asset_of(found["host"][0]), relation))
        return sum(math.prod(found[name][0].size_m[:2]) for name in names) / floor_m2

    assert filled(chosen(categories, demands, snug=True)) < filled(chosen(categories, demands))
