"""What is read in one go is what would be read one by one, and nothing that would be refused there."""

import json
import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fakes.scenes import kitchen_scene

from embomatrix.world.asset import Asset, Credit
from embomatrix.world.codec import object_from_field, scene_from_json, scene_to_json
from embomatrix.world.codec_asset import asset_from_field
from embomatrix.world.codec_plain import plain_assets, plain_objects
from embomatrix.world.field import Field
from embomatrix.world.scene import Scene, SceneObject
from embomatrix.world.state import State, SubstanceFact, SubstanceRelation
from embomatrix.world.tables import Tables, TableWriter

DUST = SubstanceFact(SubstanceRelation.COVERED, "dust.n.01")


def varied_scene() -> Scene:
    """The flat with an object that has every optional key, one that is cooked, and an asset with a credit."""
    flat = scene_from_json(scene_to_json(kitchen_scene()))  # every number a float, as the factory writes them
    first, *others, last = flat.objects
    absent = replace(last, name="apple_9", absent=True, host="", relation=None)
    last = replace(last, substances=frozenset({DUST}), pieces=("apple_9",), states=frozenset({State.COOKED}))
    credit = Credit("somebody", "CC0-1.0", "a place")
    assets = {**flat.assets, last.asset_id: replace(flat.assets[last.asset_id], credit=credit)}
    return replace(flat, objects=(first, *others, last, absent), assets=assets)


def written(scene: Scene) -> tuple[dict[str, Any], Tables]:
    writer = TableWriter()
    return json.loads(json.dumps(scene_to_json(scene, writer))), Tables(writer.arrays())


VALUE, TABLES = written(varied_scene())


def one_by_one(value: dict[str, Any], assets: dict[str, Asset]) -> tuple[SceneObject, ...]:
    field = Field(value["objects"], "objects", tables=TABLES)
    return tuple(object_from_field(item, assets) for item in field.items())


def assets_one_by_one(value: dict[str, Any]) -> dict[str, Asset]:
    return {
        key: asset_from_field(item) for key, item in Field(value["assets"], "assets", tables=TABLES).entries()
    }


def in_one_go(value: dict[str, Any], assets: dict[str, Asset]) -> tuple[SceneObject, ...] | None:
    items = value["objects"]
    return plain_objects(
        items,
        assets,
        TABLES,
        lambda index: object_from_field(Field(items[index], "object", tables=TABLES), assets),
    )


def test_a_scene_of_all_kinds_is_read_in_one_go_and_equal() -> None:
    assets = plain_assets(VALUE["assets"], TABLES)
    assert assets is not None
    assert repr(assets) == repr(assets_one_by_one(VALUE))
    objects = in_one_go(VALUE, assets)
    assert objects is not None
    assert repr(objects) == repr(one_by_one(VALUE, assets))
    assert scene_from_json(VALUE, TABLES) == varied_scene()


leaves = (
    st.none()
    | st.booleans()
    | st.integers(-2, 200)
    | st.sampled_from((math.nan, math.inf, -1.0, 0.0, 1.0, 1e300, 2e4))
    | st.sampled_from(("", "door", "cavity", "base", "ontop", "frozen", "a/b", "a\nb", "apple_1", "a" * 201))
)
replacements = leaves | st.lists(leaves, max_size=3) | st.dictionaries(st.sampled_from("ab"), leaves)


@given(st.data())
def test_one_value_replaced_is_read_alike_or_left_to_be_refused(data: st.DataObject) -> None:
    value = json.loads(json.dumps({"assets": VALUE["assets"], "objects": VALUE["objects"]}))
    place: Any = value[data.draw(st.sampled_from(("assets", "objects")))]
    while isinstance(place, dict | list) and place:
        keys = sorted(place) if isinstance(place, dict) else range(len(place))
        key = data.draw(st.sampled_from(keys))
        if not isinstance(place[key], dict | list) or data.draw(st.booleans()):
            if isinstance(place, dict) and data.draw(st.booleans()):
                place[data.draw(st.sampled_from(("link", "joint", "absent", "credit")))] = place.pop(key)
            else:
                place[key] = data.draw(replacements)
            break
        place = place[key]
    assets = plain_assets(value["assets"], TABLES)
    if assets is not None:
        assert repr(assets) == repr(assets_one_by_one(value))  # which raises for what breaks a rule
    known = assets if assets is not None else plain_assets(VALUE["assets"], TABLES)
    assert known is not None
    objects = in_one_go(value, known)
    if objects is not None:
        assert repr(objects) == repr(one_by_one(value, known))


@pytest.mark.parametrize("value", [None, [], {}, "text", 3, [[]], [{}], {"a": None}, {"a": {}}])
def test_what_is_no_scene_at_all_is_not_plain(value: Any) -> None:
    assets = plain_assets(VALUE["assets"], TABLES)
    assert assets is not None
    assert in_one_go({"objects": value}, assets) is None
    assert not plain_assets(value, TABLES)
