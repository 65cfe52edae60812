"""Vocabulary of the task writer: which small things suit which rooms, by category of the catalog.

The words are few on purpose: a policy with a word-level vocabulary learns from these tasks, and held-out tasks combine the
same words anew.
"""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping


class Group(StrEnum):
    """Kinds of small things that are found together."""

    FOOD = "food"
    FRUIT = "fruit"
    TABLEWARE = "tableware"
    PACKAGES = "packages"
    BOOKS = "books"
    TOYS = "toys"
    DEVICES = "devices"
    OFFICE = "office"
    TOILETRIES = "toiletries"
    DECORATION = "decoration"


MEMBERS: Final[Mapping[Group, tuple[str, ...]]] = {
    Group.FOOD: (
        "chicken_leg", "steak", "potato", "sweet_corn", "salmon", "hotdog", "pizza", "carrot", "bagel", "hamburger",
        "croissant", "broccoli", "mushroom", "eggplant", "beefsteak_tomato",
    ),
    Group.FRUIT: ("apple", "banana", "orange", "pear", "peach", "lemon", "avocado"),
    Group.TABLEWARE: (
        "mug", "bowl", "plate", "teacup", "water_glass", "wineglass", "tablefork", "table_knife", "tablespoon",
        "chopping_board", "frying_pan", "saucepan",
    ),
    Group.PACKAGES: (
        "can_of_soda", "box_of_crackers", "box_of_cereal", "bottle_of_water", "carton_of_milk", "jar_of_jam",
        "bag_of_chips", "bottle_of_wine",
    ),
    Group.BOOKS: ("hardback", "paperback_book", "comic_book", "notebook", "magazine", "newspaper"),
    Group.TOYS: ("teddy_bear", "toy_car", "tennis_ball", "board_game", "jigsaw_puzzle", "toy_figure"),
    Group.DEVICES: ("cell_phone", "digital_camera", "gaming_controller", "headset", "radio", "calculator"),
    Group.OFFICE: ("pencil_case", "stapler", "folder", "envelope", "clipboard"),
    Group.TOILETRIES: (
        "toothbrush", "tube_of_toothpaste", "bar_soap", "hairbrush", "bottle_of_shampoo", "hand_towel", "sponge",
        "box_of_tissues", "toilet_paper", "comb",
    ),
    Group.DECORATION: ("vase", "picture_frame", "alarm_clock", "pillar_candle", "snow_globe", "wallet", "eyeglasses"),
}  # fmt: skip
"""Categories of each group. All of them can be carried; the food can be heated, cooked and frozen."""

COOKABLE_GROUPS: Final = frozenset({Group.FOOD, Group.FRUIT})

_KITCHEN: Final = (Group.FOOD, Group.FOOD, Group.FRUIT, Group.TABLEWARE, Group.PACKAGES)
_DINING: Final = (Group.FRUIT, Group.TABLEWARE, Group.PACKAGES, Group.FOOD, Group.DECORATION)
_LIVING: Final = (Group.BOOKS, Group.TOYS, Group.DEVICES, Group.DECORATION, Group.TABLEWARE)
_OFFICE: Final = (Group.OFFICE, Group.BOOKS, Group.DEVICES, Group.TABLEWARE)
_BATH: Final = (Group.TOILETRIES, Group.TOILETRIES, Group.DECORATION)

ROOM_GROUPS: Final[Mapping[str, tuple[Group, ...]]] = {
    "kitchen": _KITCHEN,
    "break_room": _KITCHEN,
    "pantry_room": _KITCHEN,
    "bar": _DINING,
    "dining_room": _DINING,
    "grocery_store": (Group.PACKAGES, Group.FRUIT, Group.FOOD),
    "living_room": _LIVING,
    "television_room": _LIVING,
    "playroom": (Group.TOYS, Group.BOOKS),
    "childs_room": (Group.TOYS, Group.BOOKS, Group.DECORATION),
    "bedroom": (Group.BOOKS, Group.DECORATION, Group.DEVICES, Group.TOYS),
    "bathroom": _BATH,
    "spa": _BATH,
    "locker_room": _BATH,
    "private_office": _OFFICE,
    "shared_office": _OFFICE,
    "classroom": _OFFICE,
    "computer_lab": _OFFICE,
    "meeting_room": _OFFICE,
    "copy_room": _OFFICE,
}
DEFAULT_GROUPS: Final = (Group.DECORATION, Group.BOOKS, Group.OFFICE)

BASKETS: Final = ("wicker_basket", "storage_box")
"""Open containers that a variant may put on the floor or on a table."""


def groups_for(room_type: str) -> tuple[Group, ...]:
    """Groups of small things that suit a room; the first are the most likely."""
    return ROOM_GROUPS.get(room_type, DEFAULT_GROUPS)
