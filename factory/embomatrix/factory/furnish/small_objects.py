"""Small objects and household conventions: groups, suitable rooms and hosts, by catalog category.

The vocabulary is small on purpose: a policy with a word-level vocabulary learns from these tasks, and held-out tasks
recombine the same words.
"""

import functools
from collections.abc import Mapping
from enum import StrEnum
from typing import Final

from embomatrix.factory.furnish.hosts import NO_HOSTS, hosts_of


class ItemKind(StrEnum):
    """Group of small objects that are found together."""

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
"""Categories of each group. All are portable; the food can be heated, cooked and frozen."""

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
"""Groups that people put on or in these hosts. Hosts without an entry accept everything."""

NEVER_SWITCHED: Final = frozenset(
    {
        "electric_switch", "fire_alarm", "ceiling_fan", "room_light", "downlight", "square_light", "wall_mounted_light",
        "room_ventilator", "hand_dryer", "fire_extinguisher", "motorcycle",
    }
)  # fmt: skip
"""Categories with a switch that no task uses: out of reach, for emergencies, for outdoors, or ambiguous by name."""
FOR_DRINKS: Final = frozenset({"coffee_maker", "espresso_machine"})
"""Appliances that heat drinks but no food."""

COOKWARE: Final = frozenset({"frying_pan", "saucepan", "saucepot", "stockpot", "wok", "chopping_board"})
"""Categories that stay in kitchens."""
KITCHENS: Final = frozenset({"kitchen", "break_room", "bar"})
SEATS: Final = ("chair", "stool")
"""Endings of the names of seats."""
BASKETS: Final = ("wicker_basket", "storage_box")
"""Open containers that a variant may add."""


def groups_for(room_type: str) -> tuple[ItemKind, ...]:
    """Return the groups that suit a room, the likeliest first."""
    return ROOM_GROUPS.get(room_type, DEFAULT_GROUPS)


def belongs(category: str, room_type: str) -> bool:
    """True if a small object belongs in such a room."""
    if category in COOKWARE:
        return room_type in KITCHENS
    return any(category in MEMBERS[group] for group in groups_for(room_type))


def suits(category: str, host_category: str) -> bool:
    """True if people put the category on or in such a host."""
    allowed = HOST_GROUPS.get(host_category)
    return allowed is None or any(category in MEMBERS[group] for group in allowed)


def is_left_on(category: str, host_category: str) -> bool:
    """True if people leave the object on such a host. Seats hold neither food nor tableware."""
    soft = any(category in MEMBERS[group] for group in _SOFT_GOODS)
    return suits(category, host_category) and (soft or not host_category.endswith(SEATS))


_TABLES: Final = "breakfast_table dining_table pedestal_table"
_BY_GROUP: Final[Mapping[ItemKind, str]] = {
    ItemKind.FOOD: f"countertop fridge {_TABLES} commercial_kitchen_table bar bottom_cabinet plate",
    ItemKind.FRUIT: f"countertop {_TABLES} fridge bar bottom_cabinet coffee_table bowl",
    ItemKind.TABLEWARE: f"{_TABLES} countertop bar bottom_cabinet top_cabinet coffee_table booth",
    ItemKind.PACKAGES: f"countertop bottom_cabinet top_cabinet grocery_shelf shelf {_TABLES} bar",
    ItemKind.BOOKS: f"bookcase desk nightstand coffee_table shelf console_table {_TABLES}",
    ItemKind.TOYS: f"bed bookcase toy_box sofa coffee_table shelf {_TABLES}",
    ItemKind.DEVICES: f"coffee_table desk console_table nightstand bookcase sofa bottom_cabinet {_TABLES}",
    ItemKind.OFFICE: f"desk conference_table reception_desk bookcase shelf console_table {_TABLES} bottom_cabinet",
    ItemKind.TOILETRIES: "countertop furniture_sink pedestal_sink shelf bottom_cabinet multi_station_furniture_sink",
    ItemKind.DECORATION: f"console_table bookcase nightstand coffee_table bottom_cabinet shelf desk {_TABLES}",
}
_APPLIANCES: Final = frozenset(
    (
        "oven", "microwave", "toaster_oven", "fridge", "freezer", "wine_fridge", "display_fridge", "grocery_fridge",
        "dishwasher", "washer", "clothes_dryer", "coffee_maker", "toaster", "hot_tub", "range_hood",
    )
)  # fmt: skip
"""Appliances that people put nothing on."""


@functools.cache
def preferred_hosts(category: str) -> tuple[str, ...]:
    """Return the furniture for a category, the best first; empty if nothing is known."""
    found = hosts_of(category)
    group = next((group for group, members in MEMBERS.items() if category in members), None)
    return tuple(dict.fromkeys((*found, *_BY_GROUP[group].split()))) if group else found


def is_usual_host(host: str, category: str) -> bool:
    nothing = HOST_GROUPS.get(host) == frozenset() or host in _APPLIANCES
    return (
        not nothing and suits(category, host) and (host in preferred_hosts(category) or host not in NO_HOSTS)
    )


def is_appliance_top(host: str) -> bool:
    """True if the host is an appliance that people put nothing on."""
    return host in _APPLIANCES
