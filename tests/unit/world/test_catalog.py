"""Contents of the catalog, its corrections, and errors for unknown names."""

from __future__ import annotations

import pytest

from embomatrix.world.catalog import MIN_EXTENT_M, SIZE_RULES, Catalog, CatalogError


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return Catalog.load()


def test_catalog_holds_every_scene_and_category(catalog: Catalog) -> None:
    assert len(catalog.scene_ids) == 51
    assert {"Rs_int", "Wainscott_0_int", "restaurant_diner"} <= set(catalog.scene_ids)
    assert len(catalog.category_names) == 1826


def test_loading_twice_gives_the_same_catalog() -> None:
    assert Catalog.load() is Catalog.load()


def test_inventory_has_true_floors_and_splits_doors_from_objects(catalog: Catalog) -> None:
    rooms = {room.name: room for room in catalog.inventory("Rs_int").rooms}
    assert rooms["living_room_0"].floor_m == (4.02, 5.656)
    assert rooms["bedroom_0"].doors == (("door", "ktydvs", 1),)
    assert rooms["kitchen_0"].windows == (("openable_window", "ithrgo", 1),)
    assert ("fridge", "xyejdx", 1) in rooms["kitchen_0"].items
    assert not {"floors", "walls", "ceilings", "door"} & {item[0] for item in rooms["kitchen_0"].items}


def test_every_inventory_names_models_that_the_catalog_holds(catalog: Catalog) -> None:
    for scene_id in catalog.scene_ids:
        for room in catalog.inventory(scene_id).rooms:
            assert min(room.floor_m) > 0.0, (scene_id, room.name)
            for category, model, count in (*room.items, *room.doors, *room.windows):
                assert catalog.model(category, model).asset_id == f"{category}-{model}"
                assert count > 0


def test_only_twelve_rooms_have_an_estimated_floor(catalog: Catalog) -> None:
    rooms = [room for scene in catalog.scene_ids for room in catalog.inventory(scene).rooms]
    assert (len(rooms), sum(room.floor_estimated for room in rooms)) == (374, 12)


def test_description_counts_rooms_and_objects(catalog: Catalog) -> None:
    text = catalog.inventory("Rs_int").description
    assert text.startswith("Rs_int: 5 rooms (bathroom, bedroom, entryway, kitchen, living room), ")
    assert "objects" in text


def test_model_has_the_size_and_features_of_the_source(catalog: Catalog) -> None:
    fridge = catalog.model("fridge", "xyejdx")
    assert fridge.size_m == pytest.approx((0.7364, 0.633, 1.6764))
    assert {"joint", "fillable"} <= fridge.meta_links


def test_abilities_carry_their_parameters(catalog: Catalog) -> None:
    microwave = catalog.category("microwave").abilities
    assert {name: microwave["heatSource"][name] for name in ("temperature", "requires_closed")} == {
        "temperature": 100.0,
        "requires_closed": 1.0,
    }
    assert microwave["toggleable"]["requires_closed"] == 1.0
    assert "openable" in microwave
    assert catalog.category("apple").abilities["cookable"]["cook_temperature"] == 58.0
    assert "coldSource" in catalog.category("fridge").abilities
    assert "openable" not in catalog.category("sofa").abilities


def test_strings_of_lights_have_a_switch(catalog: Catalog) -> None:
    assert {"toggleable"} <= catalog.category("fairy_light").abilities.keys()
    assert "toggleable" not in catalog.category("hanging_banners").abilities


def test_abilities_are_read_only(catalog: Catalog) -> None:
    with pytest.raises(TypeError):
        catalog.category("apple").abilities["cookable"]["cook_temperature"] = 0.0  # type: ignore[index]


def test_synsets_reach_their_descendants(catalog: Catalog) -> None:
    tables = catalog.categories_of("table.n.02")
    assert {"breakfast_table", "coffee_table", "desk"} <= set(tables)
    assert tables == tuple(sorted(tables))
    assert catalog.is_a(catalog.synset_of("apple"), "entity.n.01")
    assert not catalog.is_a("apple.n.01", "table.n.02")


def test_substances_are_recognised_by_their_ability(catalog: Catalog) -> None:
    assert "substance" in catalog.abilities_of("water.n.06")
    assert "substance" not in catalog.abilities_of("apple.n.01")


def test_wrong_native_scales_are_corrected(catalog: Catalog) -> None:
    for category, rule in SIZE_RULES.items():
        assert rule.reason
        for model in catalog.models_of(category):
            assert all(
                lo <= v <= hi for lo, v, hi in zip(rule.low_m, model.size_m, rule.high_m, strict=True)
            ), model


def test_no_model_is_thinner_than_a_contact_margin(catalog: Catalog) -> None:
    for name in catalog.category_names:
        assert all(min(model.size_m) >= MIN_EXTENT_M for model in catalog.models_of(name)), name


def test_every_category_has_a_mass_and_a_model(catalog: Catalog) -> None:
    for name in catalog.category_names:
        assert catalog.category(name).mass_kg > 0.0, name
        assert catalog.models_of(name), name


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda c: c.category("frige"), "fridge"),
        (lambda c: c.model("fridge", "xyejd"), "xyejdx"),
        (lambda c: c.inventory("Rs_in"), "Rs_int"),
        (lambda c: c.categories_of("aple.n.01"), "apple.n.01"),
        (lambda c: c.synset_of("qqqqqqq"), "for example"),
        (lambda c: c.synset_of("bread"), "bread_slice"),
        (lambda c: c.synset_of("towel"), "hand_towel"),
    ],
)
def test_unknown_name_error_suggests_close_matches(catalog: Catalog, ask, said: str) -> None:
    with pytest.raises(CatalogError, match="unknown") as caught:
        ask(catalog)
    assert said in str(caught.value)


def test_scaled_model_keeps_its_shape_and_scales_its_mass_with_the_cube() -> None:
    catalog = Catalog.load()
    (whole,) = catalog.models_of("chorizo")
    small = catalog.model("chorizo", f"{whole.model_id}@0.8")
    assert small.size_m == pytest.approx(tuple(0.8 * extent for extent in whole.size_m))
    assert (small.share, whole.share) == (0.8, 1.0)
    assert small.asset_id == f"{whole.asset_id}@0.8"
    assert catalog.models_of("chorizo") == (whole,), "no dedicated model"


@pytest.mark.parametrize("share", ["0.1", "3", "nan", "half", "-1"])
def test_scale_out_of_range_is_refused(share: str) -> None:
    catalog = Catalog.load()
    (whole,) = catalog.models_of("chorizo")
    with pytest.raises(CatalogError, match=r"expected a number from 0\.5 to 2\.0"):
        catalog.model("chorizo", f"{whole.model_id}@{share}")
