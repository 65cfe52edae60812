"""The flat with objects for cutting, cleaning and soaking: knife, cloths, dishwasher, soap, halves of fruit."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from tests.fakes import furniture as make
from tests.fakes.plans import with_objects
from tests.fakes.scenes import kitchen_scene, placed, upright

from embomatrix.world.geometry import ConvexPart, Pose, Shape
from embomatrix.world.state import Relation, State, SubstanceFact, SubstanceRelation

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.world.asset import Asset
    from embomatrix.world.scene import Scene, SceneObject

BOARD_M = 0.75
"""Height of the kitchen table's board."""
COVERED, FILLED = SubstanceRelation.COVERED, SubstanceRelation.FILLED


def small(
    category: str, synset: str, size: tuple[float, float, float], **abilities: Mapping[str, float]
) -> Asset:
    """Return a light block."""
    return replace(make.block(category, synset, size, abilities), mass_kg=0.3, supports=())


def knife() -> Asset:
    return small("table_knife", "table_knife.n.01", (0.2, 0.03, 0.02), slicer={})


def rag() -> Asset:
    return small("rag", "rag.n.01", (0.12, 0.12, 0.02), particleRemover={})


def vacuum() -> Asset:
    return small("vacuum", "vacuum.n.04", (0.2, 0.2, 0.25), particleRemover={}, toggleable={})


def plate() -> Asset:
    return small("plate", "plate.n.04", (0.16, 0.16, 0.02))


def cup() -> Asset:
    return replace(make.mug(), abilities={"fillable": {}}, asset_id="cup-fakeaa", category="cup")


def soap_bottle() -> Asset:
    return small("liquid_soap__bottle", "liquid_soap__bottle.n.01", (0.06, 0.06, 0.15), fillable={})


def melon() -> Asset:
    return small("melon", "cantaloup.n.02", (0.16, 0.12, 0.1), sliceable={}, **make.FOOD)


def half_melon() -> Asset:
    return small("half_melon", "half__cantaloup.n.01", (0.08, 0.12, 0.1), **make.FOOD)


def loaf() -> Asset:
    ball = ConvexPart(Shape.BOX, Pose((0, 0, 0)), (0.18, 0.08, 0.08))
    return make.asset(
        "loaf",
        "loaf_of_bread.n.01",
        (0.18, 0.08, 0.08),
        [ball],
        mass_kg=0.4,
        abilities={"sliceable": {}, **make.FOOD},
    )


def dishwasher() -> Asset:
    return make.cupboard(
        "dishwasher",
        "dishwasher.n.01",
        (0.6, 0.6, 0.85),
        abilities={"toggleable": {"requires_closed": 1.0}},
    )


def household_scene() -> Scene:
    """Return the kitchen scene with twelve more objects, two of them absent: the halves of the melon."""
    kitchen = "kitchen_0"
    board = "breakfast_table_1"
    washer, bottle, half = dishwasher(), soap_bottle(), half_melon()

    def on_board(name: str, asset: Asset, x: float, y: float) -> tuple[SceneObject, Asset]:
        pose = upright(x, y, BOARD_M, asset)
        item = placed(name, asset, kitchen, pose, host=board, relation=Relation.ONTOP)
        return item, asset

    extra = [
        (placed("dishwasher_1", washer, kitchen, upright(4.6, 0.35, 0, washer, 1.5708), fixed=True), washer),
        on_board("table_knife_1", knife(), 2.2, 1.3),
        on_board("rag_1", rag(), 1.75, 1.15),
        on_board("plate_1", plate(), 2.2, 1.7),
        on_board("plate_2", plate(), 1.8, 0.85),
        on_board("cup_1", cup(), 2.3, 1.45),
        on_board("melon_1", melon(), 1.95, 1.35),
        on_board("loaf_1", loaf(), 1.75, 1.8),
        on_board("vacuum_1", vacuum(), 2.0, 0.82),
        (placed("liquid_soap__bottle_1", bottle, kitchen, upright(2.0, 3.6, 0.9, bottle)), bottle),
        (placed("half_melon_1", half, kitchen, upright(1.0, 1.0, 0, half)), half),
        (placed("half_melon_2", half, kitchen, upright(1.0, 1.2, 0, half)), half),
    ]
    scene = with_objects(kitchen_scene(), extra)
    changed = {
        "plate_1": {"states": frozenset({State.DUSTY})},
        "plate_2": {"substances": frozenset({SubstanceFact(COVERED, "stain.n.01")})},
        "mug_1": {"substances": frozenset({SubstanceFact(COVERED, "mud.n.03")})},
        "vacuum_1": {"substances": frozenset({SubstanceFact(COVERED, "rust.n.01")})},
        "liquid_soap__bottle_1": {"substances": frozenset({SubstanceFact(FILLED, "liquid_soap.n.01")})},
        "melon_1": {"pieces": ("half_melon_1", "half_melon_2"), "states": frozenset({State.FROZEN})},
        "half_melon_1": {"absent": True},
        "half_melon_2": {"absent": True},
    }
    objects = tuple(replace(item, **changed.get(item.name, {})) for item in scene.objects)
    return replace(scene, scene_id="flat_household", objects=objects)
