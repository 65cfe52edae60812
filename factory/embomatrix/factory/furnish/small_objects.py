"""Vocabulary of the task writer: which small things suit which rooms, by category of the catalog.

The words are few on purpose: a policy with a word-level vocabulary learns from these tasks, and held-out tasks combine the
same words anew.
"""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping


class ItemKind(StrEnum):
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


MEMBERS: Final[Mapping[ItemKind, tuple[str, ...]]] = {
    ItemKind.FOOD: (
        "chicken_leg", "steak", "potato", "sweet_corn", "salmon", "hotdog", "pizza", "carrot", "bagel", "hamburger",
        "croissant", "broccoli", "mushroom", "eggplant", "beefsteak_tomato",
    ),
    ItemKind.FRUIT: ("apple", "banana", "orange", "pear", "peach", "lemon", "avocado"),
    ItemKind.TABLEWARE: (
        "mug", "bowl", "plate", "teacup", "water_glass", "wineglass", "tablefork", "table_knife", "tablespoon",
        "chopping_board", "frying_pan", "saucepan",
    ),
    ItemKind.PACKAGES: (
        "can_of_soda", "box_of_crackers", "box_of_cereal", "bottle_of_water", "carton_of_milk", "jar_of_jam",
        "bag_of_chips", "bottle_of_wine",
    ),
    ItemKind.BOOKS: ("hardback", "paperback_book", "comic_book", "notebook", "magazine", "newspaper"),
    ItemKind.TOYS: ("teddy_bear", "toy_car", "tennis_ball", "board_game", "jigsaw_puzzle", "toy_figure"),
    ItemKind.DEVICES: ("cell_phone", "digital_camera", "gaming_controller", "headset", "radio", "calculator"),
    ItemKind.OFFICE: ("pencil_case", "stapler", "folder", "envelope", "clipboard"),
    ItemKind.TOILETRIES: (
        "toothbrush", "tube_of_toothpaste", "bar_soap", "hairbrush", "bottle_of_shampoo", "hand_towel", "sponge",
        "box_of_tissues", "toilet_paper", "comb",
    ),
    ItemKind.DECORATION: ("vase", "picture_frame", "alarm_clock", "pillar_candle", "snow_globe", "wallet", "eyeglasses"),
}  # fmt: skip
"""Categories of each group. All of them can be carried; the food can be heated, cooked and frozen."""

_KITCHEN: Final = (ItemKind.FOOD, ItemKind.FOOD, ItemKind.FRUIT, ItemKind.TABLEWARE, ItemKind.PACKAGES)
_DINING: Final = (ItemKind.FRUIT, ItemKind.TABLEWARE, ItemKind.PACKAGES, ItemKind.FOOD, ItemKind.DECORATION)
_LIVING: Final = (ItemKind.BOOKS, ItemKind.TOYS, ItemKind.DEVICES, ItemKind.DECORATION, ItemKind.TABLEWARE)
_OFFICE: Final = (ItemKind.OFFICE, ItemKind.BOOKS, ItemKind.DEVICES, ItemKind.TABLEWARE)
_BATH: Final = (ItemKind.TOILETRIES, ItemKind.TOILETRIES, ItemKind.DECORATION)

ROOM_GROUPS: Final[Mapping[str, tuple[ItemKind, ...]]] = {
    "kitchen": _KITCHEN,
    "break_room": _KITCHEN,
    "pantry_room": _KITCHEN,
    "bar": _DINING,
    "dining_room": _DINING,
    "grocery_store": (ItemKind.PACKAGES, ItemKind.FRUIT, ItemKind.FOOD),
    "living_room": _LIVING,
    "television_room": _LIVING,
    "playroom": (ItemKind.TOYS, ItemKind.BOOKS),
    "childs_room": (ItemKind.TOYS, ItemKind.BOOKS, ItemKind.DECORATION),
    "bedroom": (ItemKind.BOOKS, ItemKind.DECORATION, ItemKind.DEVICES, ItemKind.TOYS),
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
DEFAULT_GROUPS: Final = (ItemKind.DECORATION, ItemKind.BOOKS, ItemKind.OFFICE)

_KITCHEN_GOODS: Final = frozenset({ItemKind.FOOD, ItemKind.FRUIT, ItemKind.TABLEWARE, ItemKind.PACKAGES})
_SOFT_GOODS: Final = frozenset(
    {ItemKind.BOOKS, ItemKind.TOYS, ItemKind.DEVICES, ItemKind.OFFICE, ItemKind.DECORATION}
)
_WASHABLE: Final = frozenset({ItemKind.FRUIT, ItemKind.FOOD, ItemKind.TABLEWARE, ItemKind.TOILETRIES})
_COOKING: Final = frozenset({ItemKind.FOOD, ItemKind.FRUIT, ItemKind.TABLEWARE})
_ROASTED: Final = frozenset({ItemKind.FOOD, ItemKind.TABLEWARE})
_NOTHING: Final[frozenset[ItemKind]] = frozenset()

HOST_GROUPS: Final[Mapping[str, frozenset[ItemKind]]] = {
    **dict.fromkeys(
        (
            "sofa", "armchair", "bed", "straight_chair", "swivel_chair", "ottoman", "taboret", "bench", "booth",
            "stool", "folding_chair", "carpet",
        ),
        _SOFT_GOODS,
    ),
    **dict.fromkeys(("furniture_sink", "pedestal_sink", "commercial_kitchen_sink", "sink"), _WASHABLE),
    **dict.fromkeys(("stove", "flat_top_grill", "oven", "toaster_oven"), _ROASTED),
    "microwave": _COOKING,
    **dict.fromkeys(("fridge", "freezer", "cooler", "wine_fridge"), _KITCHEN_GOODS),
    "dishwasher": frozenset({ItemKind.TABLEWARE}),
    **dict.fromkeys(MEMBERS[ItemKind.TABLEWARE], frozenset({ItemKind.FOOD, ItemKind.FRUIT})),
    **dict.fromkeys(MEMBERS[ItemKind.DECORATION], _NOTHING),
    **dict.fromkeys(
        (
            "coffee_maker", "deep_fryer", "popcorn_machine", "toilet", "shower_stall", "bathtub", "pot_plant",
            "loudspeaker", "standing_loudspeaker", "laptop", "standing_tv", "wall_mounted_tv", "jukebox", "pay_phone",
            "grandfather_clock", "table_lamp", "floor_lamp", "towel_rack", "range_hood", "public_trash_can",
            "trash_can", "electric_switch", "picture", "mirror", "fire_extinguisher", "beer_tap", "cash_register",
            "washer", "clothes_dryer", "hat", "cap", "ceiling_rack", "coatrack", "treadmill", "exercise_bike",
        ),
        _NOTHING,
    ),
}  # fmt: skip
"""What a person would put on or in these hosts. Hosts that are not listed take anything."""

NEVER_SWITCHED: Final = frozenset(
    {
        "electric_switch", "fire_alarm", "ceiling_fan", "room_light", "downlight", "square_light", "wall_mounted_light",
        "room_ventilator", "hand_dryer", "fire_extinguisher", "motorcycle",
    }
)  # fmt: skip
"""Things with a switch that no task asks for: out of reach, for an emergency, not for indoors, or no words tell one from
another."""
FOR_DRINKS: Final = frozenset({"coffee_maker", "espresso_machine"})
"""What heats drinks, and no food."""

COOKWARE: Final = frozenset({"frying_pan", "saucepan", "saucepot", "stockpot", "wok", "chopping_board"})
"""What leaves no kitchen."""
KITCHENS: Final = frozenset({"kitchen", "break_room", "bar"})
SEATS: Final = ("chair", "stool")
"""Names of furniture to sit on end so."""
BASKETS: Final = ("wicker_basket", "storage_box")
"""Open containers that a variant may put on the floor or on a table."""


def groups_for(room_type: str) -> tuple[ItemKind, ...]:
    """Groups of small things that suit a room; the first are the most likely."""
    return ROOM_GROUPS.get(room_type, DEFAULT_GROUPS)


def belongs(category: str, room_type: str) -> bool:
    """Whether a small thing is found in such a room."""
    if category in COOKWARE:
        return room_type in KITCHENS
    return any(category in MEMBERS[group] for group in groups_for(room_type))


def suits(category: str, host_category: str) -> bool:
    """Whether a person would put a thing of the category on or in such a host."""
    allowed = HOST_GROUPS.get(host_category)
    return allowed is None or any(category in MEMBERS[group] for group in allowed)


def is_left_on(category: str, host_category: str) -> bool:
    """Whether a thing that is lying about lies there: on seats neither food nor tableware."""
    soft = any(category in MEMBERS[group] for group in _SOFT_GOODS)
    return suits(category, host_category) and (soft or not host_category.endswith(SEATS))
