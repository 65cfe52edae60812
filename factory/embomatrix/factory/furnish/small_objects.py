"""Small objects: the kinds that suit each type of room, and the furniture that holds each category.

The task writer's vocabulary is small on purpose: policies with a word-level vocabulary learn from these tasks, and held-out
tasks recombine the same words.

Hosts are ordered by their frequency in the hand-made rooms of iTHOR (Kolve et al., "AI2-THOR", 2017): eggs in the fridge,
plates on dining table and counter before the cupboard, books on the desk, pillows on bed and sofa.
"""

from __future__ import annotations

import functools
import re
from enum import StrEnum
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping


class ItemKind(StrEnum):
    """Kind of small objects that are found together."""

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
"""Kinds of objects that people put on or in these hosts. Unlisted hosts take anything."""

NEVER_SWITCHED: Final = frozenset(
    {
        "electric_switch", "fire_alarm", "ceiling_fan", "room_light", "downlight", "square_light", "wall_mounted_light",
        "room_ventilator", "hand_dryer", "fire_extinguisher", "motorcycle",
    }
)  # fmt: skip
"""Categories with a switch that no task mentions: out of reach, for emergencies, outdoor, or hard to tell apart in words."""
FOR_DRINKS: Final = frozenset({"coffee_maker", "espresso_machine"})
"""Appliances that heat drinks but no food."""

COOKWARE: Final = frozenset({"frying_pan", "saucepan", "saucepot", "stockpot", "wok", "chopping_board"})
"""Categories that stay in kitchens."""
KITCHENS: Final = frozenset({"kitchen", "break_room", "bar"})
SEATS: Final = ("chair", "stool")
"""Endings of the category names of seats."""
BASKETS: Final = ("wicker_basket", "storage_box")
"""Open containers that a variant may put on the floor or on a table."""


def groups_for(room_type: str) -> tuple[ItemKind, ...]:
    """Return the kinds of small objects that suit a room, most likely ones first."""
    return ROOM_GROUPS.get(room_type, DEFAULT_GROUPS)


def belongs(category: str, room_type: str) -> bool:
    """True if objects of the category are found in rooms of this type."""
    if category in COOKWARE:
        return room_type in KITCHENS
    return any(category in MEMBERS[group] for group in groups_for(room_type))


def suits(category: str, host_category: str) -> bool:
    """True if people put objects of the category on or in this kind of host."""
    allowed = HOST_GROUPS.get(host_category)
    return allowed is None or any(category in MEMBERS[group] for group in allowed)


def is_left_on(category: str, host_category: str) -> bool:
    """True if objects of the category are left lying on this kind of host: no food or tableware on seats."""
    soft = any(category in MEMBERS[group] for group in _SOFT_GOODS)
    return suits(category, host_category) and (soft or not host_category.endswith(SEATS))


_COLD: Final = "grocery_fridge display_fridge fridge freezer wine_fridge"
_STORE: Final = "grocery_shelf snack_rack display_case"
_WORKTOP: Final = "countertop commercial_kitchen_table metal_bottom_cabinet bar bottom_cabinet"
_DINING: Final = "dining_table breakfast_table pedestal_table booth"
_PARLOUR: Final = "coffee_table garden_coffee_table console_table breakfast_table pedestal_table"
_CUPBOARDS: Final = "bottom_cabinet bottom_cabinet_no_top top_cabinet metal_bottom_cabinet"
_SHELVES: Final = "bookcase shelf commercial_kitchen_shelf"
_DESKS: Final = (
    "desk cubicle conference_table reception_desk lab_table pedestal_table breakfast_table coffee_table"
)
_LAB: Final = "lab_table desk bottom_cabinet bookcase"
_BATH: Final = (
    "countertop multi_station_tabletop_sink multi_station_furniture_sink furniture_sink shelf bottom_cabinet"
)

_BY_NAMES: Final[Mapping[str, str]] = {
    "microwave coffee_maker crock_pot electric_mixer food_slicer blender": f"{_WORKTOP} breakfast_table",
    "espresso_machine beer_tap popcorn_machine cloche cake_stand dessert_stand": f"bar {_WORKTOP}",
    "cash_register credit_card_terminal": f"checkout_counter reception_desk bar {_DESKS} countertop display_case",
    "laptop desk_phone printer gooseneck_microphone": f"{_DESKS} console_table bottom_cabinet",
    "monitor keyboard mouse mousepad desk_organizer": "desk cubicle conference_table lab_table reception_desk",
    "table_lamp": "nightstand console_table desk bottom_cabinet bookcase breakfast_table coffee_table",
    "alarm_clock": "nightstand desk console_table bottom_cabinet",
    "pillow": "bed sofa armchair bench garden_chair",
    "teddy_bear blanket quilt": "bed sofa armchair toy_box cedar_chest",
    "pot_plant flower bouquet vase outline_vase": f"console_table {_PARLOUR} bookcase bottom_cabinet cedar_chest booth desk",
    "standing_tv": "bottom_cabinet console_table bookcase coffee_table breakfast_table",
    "loudspeaker sound_system": "bookcase console_table bottom_cabinet desk",
    "menu salt_shaker pepper_shaker bottle_of_mustard bottle_of_catsup jar_of_sugar dinner_napkin place_mat coaster "
    "tablefork table_knife tablespoon teaspoon chopstick table_runner": f"{_DINING} bar countertop coffee_table",
    "plate bowl saucer": f"{_DINING} {_WORKTOP} {_CUPBOARDS} {_SHELVES}",
    "water_glass wineglass beer_glass mug coffee_cup teacup": f"{_DINING} bar {_WORKTOP} {_PARLOUR} desk {_CUPBOARDS} shelf",
    "soda_cup paper_cup": f"bar {_WORKTOP} {_DINING} {_SHELVES}",
    "saucepot frying_pan stockpot wok": f"stove flat_top_grill {_WORKTOP} {_CUPBOARDS} {_SHELVES}",
    "lid tray teapot jug casserole gravy_boat electric_cauldron": f"{_WORKTOP} {_SHELVES} {_CUPBOARDS} {_DINING} coffee_table",
    "chopping_board knife_block carving_knife cleaver spatula whisk tongs soup_ladle wooden_spoon skimmer potato_masher "
    "pasta_server toasting_fork pestle": f"{_WORKTOP} breakfast_table",
    "phonograph_record": "jukebox bar booth bookcase",
    "cap": "bar console_table bottom_cabinet",
    "hardback paperback_book notebook magazine newspaper": f"bookcase desk coffee_table nightstand {_DESKS}",
    "pen pencil marker pencil_holder notepad folder paper_sheet stapler clipboard legal_document globe": f"{_DESKS} bookcase",
    "soap_dispenser shampoo_dispenser conditioner_dispenser toothbrush comb bar_soap soap_dish tissue_dispenser "
    "hair_dryer lipstick bottle_of_lotion bottle_of_shampoo hand_towel": f"{_BATH} bookcase",
    "beaker erlenmeyer_flask round_bottom_flask graduated_cylinder test_tube_rack petri_dish microscope reagent_bottle buret "
    "test_tube buret_clamp digital_scale magnetic_stirrer spirit_lamp funnel specimen_bottle test_tube_holder "
    "test_tube_clamp flask_clamp": f"{_LAB} {_WORKTOP}",
    "toy_figure toy_car toy_dice beach_toy alphabet_abacus chess_set": f"toy_box bookcase coffee_table {_DESKS} bottom_cabinet",
    "trophy statue bust hourglass": f"display_case bookcase shelf console_table {_PARLOUR}",
    "dishtowel towel toilet_paper": f"{_SHELVES} {_BATH} {_CUPBOARDS}",
    "free_weight weight_bar": "free_weight_rack bench bookcase",
    "gym_shoe sandal high_heel hat": "hall_tree bench bookcase wardrobe",
}
_BY_NAME: Final[Mapping[str, tuple[str, ...]]] = {
    name: tuple(hosts.split()) for names, hosts in _BY_NAMES.items() for name in names.split()
}

_PERISHABLE: Final = re.compile(
    r".*(milk|cream|yogurt|butter|cheese|egg|juice|steak|chicken|fish|salad|tofu|sushi|beer|champagne|water|soda|pop|tea|lasagna)s?"
)
_PACKED: Final = re.compile(
    r"(bottle|can|jar|box|bag|carton|pack|cup|tube)_of_.*|boxed_.*|canned_.*|.*_jar|.*_bottle|can|cigar"
)
_FRESH: Final = re.compile(
    r"apple|pear|orange|lemon|lime|mango|banana|bunch_of_bananas|pineapple|watermelon|cantaloup|durian|grape|eggplant|"
    r"zucchini|carrot|potato|sweet_corn|beefsteak_tomato|half_.*|soft_roll|croissant|tiramisu|kebab|wrapped_hamburger|frail"
)
_BY_KIND: Final = (
    (_FRESH, f"{_STORE} {_WORKTOP} {_DINING} fridge"),
    (_PACKED, f"{_STORE} {_SHELVES} {_CUPBOARDS} {_WORKTOP} {_DINING} {_COLD}"),
)
_COLD_NAMES: Final = frozenset(_COLD.split())

_CUPBOARD_NAMES: Final = (
    "plate bowl mug tray saucepot stockpot frying_pan lid jug teapot teacup saucer wineglass water_glass casserole gravy_boat "
    "canned_food towel hand_towel toilet_paper beer_glass coffee_cup cap"
)
_CUPBOARD: Final = frozenset(_CUPBOARD_NAMES.split())

_NO_HOST_NAMES: Final = (
    "toilet taboret straight_chair swivel_chair eames_chair garden_chair rocking_chair music_stool bench ottoman bathtub "
    "urinal fridge furniture_sink pedestal_sink commercial_kitchen_sink multi_station_furniture_sink public_trash_can "
    "trash_can floor_lamp bed sofa armchair stove flat_top_grill deep_fryer jukebox shower_stall oven crib treadmill "
    "drop_in_sink tabletop_sink multi_station_tabletop_sink burner wall_mounted_sink hamper stadium_stand gym_mat hot_tub "
    "bush tree boulder car bicycle motorcycle drinking_fountain locker wardrobe hospital_bed massage_bed radiator "
    "sauna_bench hammam_bench charcoal_grill electric_cauldron pool_table playground garden_statue elliptical_machine "
    "exercise_bike washer clothes_dryer dishwasher freezer grocery_fridge display_fridge wine_fridge vending_machine "
    "shopping_cart coatrack suitcase swing_set sandbox wading_pool low_resolution_tree garden_plant photocopier"
)
NO_HOSTS: Final = frozenset(_NO_HOST_NAMES.split())
"""Categories that hold no small objects unless the tables above name them as hosts."""


@functools.cache
def hosts_of(category: str) -> tuple[str, ...]:
    """Return the preferred hosts of a small object, best first; empty if any surface will do."""
    if category in _BY_NAME:
        return _BY_NAME[category]
    cold = tuple(_COLD.split()) if _PERISHABLE.fullmatch(category) else ()
    for kind, hosts in _BY_KIND:
        if kind.fullmatch(category):
            return tuple(dict.fromkeys((*cold, *hosts.split())))
    return cold


def kept_behind_doors(category: str, host: str) -> bool:
    """True if people keep objects of this category behind the doors of this host: crockery, provisions, cold food."""
    if host in _COLD_NAMES:
        return host in hosts_of(category)
    return category in _CUPBOARD or _PACKED.fullmatch(category) is not None
