"""Heat and cold sources of the catalog act as their appliances do in the world."""

from __future__ import annotations

import pytest

from embomatrix.factory.assets.library import build_asset
from embomatrix.skills.appliances import cold_source, cook_temperature_c, freezes, heat_source, heats
from embomatrix.world.appliance_rules import SOURCE_RULES
from embomatrix.world.asset import Asset
from embomatrix.world.catalog import Catalog


@pytest.fixture(scope="module")
def assets() -> dict[str, Asset]:
    """Return one asset of every category with a heat or cold source."""
    catalog = Catalog.load()
    found = {}
    for name in catalog.category_names:
        if {"heatSource", "coldSource"} & catalog.category(name).abilities.keys():
            found[name] = build_asset(catalog, name, catalog.models_of(name)[0].model_id)
    return found


def test_every_rule_changes_a_source_of_its_category(assets: dict[str, Asset]) -> None:
    catalog = Catalog.load()
    for name, rule in SOURCE_RULES.items():
        listed = catalog.abilities_of(catalog.synset_of(name))[rule.ability]
        assert {key: listed[key] for key in rule.parameters} != dict(rule.parameters), name
        assert assets[name].abilities[rule.ability] == {**listed, **rule.parameters}


def test_only_fridge_freezers_and_freezers_freeze(assets: dict[str, Asset]) -> None:
    freezing = {name for name, asset in assets.items() if (source := cold_source(asset)) and freezes(source)}
    assert freezing == {"fridge", "freezer"}
    assert all(assets[name].abilities["coldSource"]["requires_closed"] == 1.0 for name in freezing)


def test_a_corrected_category_leaves_the_others_of_its_synset_alone() -> None:
    catalog = Catalog.load()
    kinds = [catalog.category(name) for name in ("fridge", "wine_fridge", "display_fridge")]
    assert len({kind.synset for kind in kinds}) == 1
    assert [kind.abilities["coldSource"]["temperature"] for kind in kinds] == [-18.0, 12.0, 4.0]


@pytest.mark.parametrize("name", ["coffee_maker", "espresso_machine", "radiator"])
def test_drink_machines_and_radiators_warm_but_do_not_cook(assets: dict[str, Asset], name: str) -> None:
    catalog = Catalog.load()
    source = heat_source(assets[name])
    assert source is not None
    assert heats(source)
    foods = [kind for kind in catalog.category_names if "cookable" in catalog.category(kind).abilities]
    coolest = min(
        cook_temperature_c(build_asset(catalog, kind, catalog.models_of(kind)[0].model_id)) for kind in foods
    )
    assert source.temperature_c < coolest
