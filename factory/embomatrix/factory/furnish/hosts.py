"""Preferred furniture of small objects, best first: by category, else by a pattern of the category's name.

Hosts are ordered by their frequency in the hand-made rooms of iTHOR (Kolve et al., "AI2-THOR", 2017): eggs in the fridge,
plates on dining table and counter before the cupboard, books on the desk, pillows on bed and sofa.
"""

import functools
import re
from collections.abc import Mapping
from typing import Final

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
