"""Which constraints the things on one plane are given, by rules: the first half of the Planar-Level Placement Generator.

What belongs together stands together, one of a kind beside the other in a row; centrepieces stand in the middle, what would
be in the way at the edge.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.factory.furnish.roles import FurnitureRole, role_of
from embomatrix.factory.layout.values import Arrangement, Kind, PlacementConstraint, PlacementConstraints

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from embomatrix.factory.layout.values import ObjectBrief, PlaneCompany

_COMPANIONS: Final[Mapping[str, str]] = {
    "tablefork table_knife tablespoon teaspoon chopstick dinner_napkin": "plate bowl place_mat",
    "water_glass wineglass mug teacup beer_glass": "plate bowl teapot coaster",
    "teapot jar_of_sugar carton_of_milk": "teacup mug",
    "salt_shaker": "pepper_shaker",
    "tube_of_toothpaste": "toothbrush",
    "bottle_of_shampoo bar_soap": "hand_towel sponge",
    "mouse": "keyboard laptop mousepad",
    "headset calculator notepad pencil_case stapler": "laptop keyboard notebook",
    "gaming_controller": "standing_tv",
    "bagel croissant steak pizza hamburger hotdog salmon chicken_leg": "plate chopping_board frying_pan",
    "apple pear orange peach lemon avocado banana": "bowl plate",
    "table_knife carving_knife parer": "chopping_board",
}
COMPANIONS: Final = {
    category: frozenset(others.split()) for names, others in _COMPANIONS.items() for category in names.split()
}
"""What a thing is put beside where both are on one table."""
_CENTREPIECES: Final = "vase pillar_candle snow_globe fruit_bowl candelabrum bouquet wicker_basket"
CENTREPIECES: Final = frozenset(_CENTREPIECES.split())
_BOARDS: Final = "breakfast_table dining_table coffee_table conference_table pedestal_table garden_coffee_table garden_table"
BOARDS: Final = frozenset(_BOARDS.split())
"""Tables that people stand or sit around: their middle is for show."""
TABLES: Final = BOARDS | {"desk", "booth", "lab_table"}
"""What seats are drawn up to."""
SEATED: Final = frozenset(["plate", "bowl", "place_mat", "laptop", "notebook"])
"""What is laid where somebody sits: at the edge of such a table."""
_BACKED: Final = (
    "alarm_clock picture_frame radio table_lamp microwave toaster coffee_maker box_of_tissues hardback "
    "paperback_book folder magazine newspaper comic_book board_game jigsaw_puzzle clipboard envelope box_of_cereal "
    "box_of_crackers"
)
BACKED: Final = frozenset(_BACKED.split())
"""What stands or lies at an edge, out of the way."""


def wish(company: PlaneCompany) -> PlacementConstraints:
    """Constraints for each thing of a plane, the most important first; none for what may stand anywhere."""
    return PlacementConstraints(
        {thing.name: tuple(dict.fromkeys(_wishes(thing, company))) for thing in company.things}
    )


def _wishes(thing: ObjectBrief, company: PlaneCompany) -> Iterator[PlacementConstraint]:
    others = dict(company.others)
    rank = company.things.index(thing)
    before = {**others, **{each.name: each.category for each in company.things[:rank]}}
    for other in thing.beside:
        yield PlacementConstraint(Arrangement.NEXT_TO, other, required=True)
    if company.on_floor:
        yield from _on_floor(thing, before)
        return
    alike = next((name for name, category in before.items() if category == thing.category), "")
    if alike:
        yield PlacementConstraint(Arrangement.NEXT_TO, alike)
        yield PlacementConstraint(Arrangement.CENTER_ALIGNED, alike)
        return
    everyone = {**before, **{each.name: each.category for each in company.things[rank + 1 :]}}
    likes = COMPANIONS.get(thing.category, frozenset())
    friend = next((name for name, category in everyone.items() if category in likes), "")
    if friend:
        yield PlacementConstraint(Arrangement.NEXT_TO, friend)
        yield PlacementConstraint(Arrangement.SIDE_OF, friend)
        return
    if company.host in BOARDS and thing.category in CENTREPIECES:
        yield PlacementConstraint(Arrangement.MIDDLE)
    elif thing.category in BACKED or (company.host in BOARDS and thing.category in SEATED):
        yield PlacementConstraint(Arrangement.EDGE)


def _on_floor(thing: ObjectBrief, before: Mapping[str, str]) -> Iterator[PlacementConstraint]:
    """Seats go to a table, tables stand in the open, the rest at a wall."""
    role = role_of(thing.category, thing.size_m, 0.0) if thing.kind is Kind.FURNITURE else None
    table = next((name for name, category in before.items() if category in TABLES), "")
    if role is FurnitureRole.SEAT and table:
        yield PlacementConstraint(Arrangement.FACE_TO, table)
        yield PlacementConstraint(Arrangement.NEXT_TO, table)
    elif role in (FurnitureRole.LOW_TABLE, FurnitureRole.OPEN) or thing.category in BOARDS:
        yield PlacementConstraint(Arrangement.MIDDLE)
    else:
        yield PlacementConstraint(Arrangement.EDGE)
