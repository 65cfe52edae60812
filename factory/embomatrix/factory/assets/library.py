"""Assets of catalog models: the family of each category, and the asset that it builds.

A category gets its family from the table of names, else from a pattern of names, else from the taxonomy, else a plain block.
"""

import functools
import re
import zlib
from collections.abc import Mapping
from typing import Final

from embomatrix.factory.assets.cabinets import MAX_PARTS
from embomatrix.factory.assets.corners import is_corner
from embomatrix.factory.assets.families import Family
from embomatrix.world.asset import Asset, Link
from embomatrix.world.catalog import Catalog


@functools.cache
def build_asset(catalog: Catalog, category: str, model: str) -> Asset:
    """Build the asset of one model at its catalog size, or at the share of that size that the model id names.

    Equal arguments give equal bytes on every machine. Raises CatalogError for an unknown category or model.
    """
    kind = catalog.category(category)
    entry = catalog.model(category, model)
    family = family_of_model(catalog, category, model)
    body = family.build(entry.size_m)
    links = (Link("base", tuple(body.parts)), *body.moving)
    for link in links:
        if not 0 < len(link.parts) <= MAX_PARTS:
            raise AssertionError(
                f"{entry.asset_id}: link {link.name!r} has {len(link.parts)} parts, the engine takes 1 to {MAX_PARTS}: "
                f"fix the generator of family {family}"
            )
    return Asset(
        asset_id=entry.asset_id,
        category=category,
        synset=kind.synset,
        size_m=entry.size_m,
        mass_kg=kind.mass_kg * entry.share**3,
        links=links,
        supports=tuple(body.supports),
        interiors=tuple(body.interiors),
        abilities=kind.abilities if not body.moving else {"openable": {}, **kind.abilities},
    )


_NAMES: Final[Mapping[Family, str]] = {
    Family.CUPBOARD: "bottom_cabinet bottom_cabinet_no_top metal_bottom_cabinet recreational_vehicle mailbox hutch",
    Family.WALL_CUPBOARD: "top_cabinet",
    Family.LOCKER: "locker",
    Family.FRIDGE: "fridge display_fridge wine_fridge",
    Family.FREEZER: "freezer grocery_fridge",
    Family.MICROWAVE: "microwave",
    Family.OVEN: "oven toaster_oven",
    Family.DISHWASHER: "dishwasher",
    Family.WASHER: "washer clothes_dryer",
    Family.SHELVING: "shelf bookcase grocery_shelf commercial_kitchen_shelf snack_rack magazine_rack magazine_stand "
    "shoe_rack dish_rack_cart storage_organizer  hall_tree test_tube_rack "
    "free_weight_rack dry_food_dispenser_shelf candy_dispenser_shelf",
    Family.CUBBY: "nightstand stand wood_fireplace dessert_stand chicken_coop",
    Family.WARDROBE: "wardrobe lab_exhaust_hood",
    Family.CHEST: "carton cedar_chest cooler toolbox violin_case recycling_bin backpack tank tackle_box",
    Family.OPEN_BOX: "desk_organizer packing_box storage_box toy_box crib hamper trash_can public_trash_can "
    "ice_tray litter_box compost_bin shopping_basket shopping_cart tote paper_bag lunch_box "
    "pencil_case pizza_box suitcase kayak skiff wheelbarrow dish_rack tupperware birdcage stroller "
    "shoulder_bag briefcase outline_tray drying_rack roasting_pan ice_bucket mop_bucket burlap_bag "
    "cash_register sandbox soap_dish dustpan waffle_maker toaster french_fry_holder knife_block "
    "umbrella_rack first_aid_kit deep_fryer shoe_box pet_bed shower terrarium christmas_stocking",
    Family.TRAY: "tray baking_sheet",
    Family.TABLE: "breakfast_table coffee_table conference_table console_table garden_coffee_table pool_table booth "
    "gaming_table ironing_board massage_bed trampoline",
    Family.DESK: "desk lab_table",
    Family.SHELF_TABLE: "commercial_kitchen_table serving_cart",
    Family.PEDESTAL_TABLE: "pedestal_table cake_stand garden_umbrella",
    Family.COUNTER: "bar reception_desk checkout_counter display_case chopping_block pedestal",
    Family.CHAIR: "straight_chair folding_chair garden_chair rocking_chair highchair bench eames_chair",
    Family.SWIVEL_CHAIR: "swivel_chair",
    Family.STOOL: "taboret bar_stool music_stool footstool ottoman flat_bench bench_press_machine pommel_horse",
    Family.TIERS: "stadium_stand sauna_bench hammam_bench",
    Family.SOFA: "sofa armchair infant_car_seat",
    Family.BED: "bed hospital_bed chaise_longue",
    Family.BUNK_BED: "bunk_bed",
    Family.LAMP: "floor_lamp table_lamp garden_light coatrack clothesline_pole globe trophy electric_fan",
    Family.SLAB: "countertop carpet mattress place_mat mat gym_mat yoga_mat chopping_board cutting_board board "
    "clipboard hardback paperback_book comic_book notebook notepad textbook magazine catalog "
    "newspaper folder menu pallet plywood chess_set board_game paver paving_stone ceramic_tile tile "
    "doily coaster mousepad keyboard digital_scale kitchen_analog_scale table_runner dinner_napkin "
    "griddle_pan loudspeaker standing_loudspeaker printer photocopier radiator gas_fireplace piano "
    "jukebox vending_machine box_of_tissues structural_element pegboard butter tofu bean_curd feta "
    "cheddar mozzarella swiss_cheese bleu brownie lasagna tiramisu toast bread_slice french_toast "
    "gelatin chocolate_bar granola_bar sushi club_sandwich bar_soap sponge waffle wafer ramen "
    "sugar_cube bouillon_cube ice_cube bookcase_back bookcase_baseboard bookcase_shelf bookcase_side "
    "bookcase_top cabinet_base desk_top tablet calculator game_console scanner desktop_computer "
    "sound_system radio projector router shredder dehumidifier package legal_document "
    "architectural_plan paper_sheet space_heater popcorn_machine folderal",
    Family.ROUND: "bowl mixing_bowl wok petri_dish ashtray mortar sieve colander steamer_basket china jigger "
    "cauldron crock_pot water_glass beer_glass paper_cup soda_cup beaker graduated_cylinder test_tube "
    "vase outline_vase bucket plant_pot canister pencil_holder candle_holder hingeless_jar "
    "bucket_of_paint cup_of_ranch cup_of_yogurt cast glass_lantern erlenmeyer_flask "
    "round_bottom_flask specimen_bottle shaker hourglass funnel cup_holder wicker_basket frail "
    "bird_feeder hanging_basket",
    Family.CUP: "mug coffee_cup teacup measuring_cup dipper jug pitcher cream_pitcher carafe decanter "
    "electric_kettle watering_can jug_of_milk cruet coffee_grinder",
    Family.GOBLET: "wineglass goblet chalice cocktail_glass",
    Family.PAN: "frying_pan saucepan",
    Family.POT: "saucepot stockpot casserole copper_pot dutch_oven teapot pewter_teapot kettle gravy_boat "
    "instant_pot pressure_cooker drip_pot food_processor electric_mixer",
    Family.LIDDED_VESSEL: "electric_cauldron hinged_jar rice_cooker",
    Family.BLENDER: "blender",
    Family.PLATE: "plate platter saucer",
    Family.CAN: "can beer_keg fuel_can toilet_paper paper_towel can_of_soda fire_extinguisher hockey_puck pillar "
    "pill_bottle lip_balm beeswax_candle pillar_candle dip_candle duct_tape masking_tape battery "
    "water_filter lens reed_diffuser deodorant_stick spirit_lamp firewood_chopping_block lipstick "
    "french_press air_filter",
    Family.SOFT: "pillow teddy_bear satchel hat cap baseball_cap sandal high_heel gym_shoe hiking_boot rubber_boot "
    "baby_shoe slingback rubber_glove sock work_helmet sleeping_bag baseball_glove batting_gloves "
    "boxing_gloves goalkeeper_gloves skates life_jacket wallet sanitary_napkin mouse",
    Family.DISC: "lid phonograph_record pizza tortilla dartboard trampoline_top",
    Family.UTENSIL: "table_knife carving_knife cleaver parer tablefork tablespoon teaspoon soupspoon spatula whisk "
    "tongs wooden_spoon soup_ladle pasta_server skimmer potato_masher toasting_fork vegetable_peeler "
    "pocketknife utility_knife putty_knife chisel axe hammer mallet screwdriver plier allen_wrench "
    "open_end_wrench toothbrush hairbrush paintbrush broom mop rake hoe shovel trowel scraper "
    "scrub_brush chopstick pestle paint_roller golf_club hockey_stick tennis_racket guitar violin "
    "trumpet trombone saxophone fishing_rod squeegee comb scoop hair_dryer leaf_blower "
    "meat_thermometer tobacco_pipe dart antlers magnifying_glass grater paddle syringe honing_steel "
    "feather handset",
    Family.SINK: "furniture_sink commercial_kitchen_sink drop_in_sink tabletop_sink",
    Family.MULTI_SINK: "multi_station_furniture_sink multi_station_tabletop_sink",
    Family.PEDESTAL_SINK: "pedestal_sink wall_mounted_sink multi_station_wall_mounted_sink drinking_fountain",
    Family.TUB: "bathtub hot_tub swimming_pool wading_pool",
    Family.TOILET: "toilet",
    Family.SHOWER_STALL: "shower_stall",
    Family.COOKTOP: "stove burner sauna_heater oden_cooker",
    Family.GRILL: "flat_top_grill charcoal_grill smoker",
    Family.COFFEE_MACHINE: "coffee_maker espresso_machine beer_tap drink_dispenser jam_dispenser water_dispenser",
    Family.DOOR: "door gate",
    Family.SLIDING_DOOR: "sliding_door elevator_door",
    Family.GARAGE_DOOR: "garage_door",
    Family.WINDOW: "openable_window",
    Family.LAPTOP: "laptop",
    Family.SCREEN: "standing_tv monitor standing_mirror",
    Family.MIRROR: "mirror",
    Family.PLANT: "pot_plant pottable_cactus pottable_chili pottable_daffodil pottable_dahlia pottable_marigold "
    "pottable_beefsteak_tomato flower bouquet garden_plant",
    Family.TREE: "tree low_resolution_tree christmas_tree christmas_tree_decorated",
    Family.CAR: "car",
    Family.CLOTH: "apron bath_towel bed_sheet blanket bikini blouse boxers bra cardigan dishtowel dress dress_shirt "
    "fur_coat hand_towel hoodie jeans jersey legging leotard maillot national_flag necktie onesie "
    "pants pillowcase quilt rag raincoat sauna_suit scarf shorts skirt sweatshirt t_shirt tablecloth "
    "tank_top tarp tights vest wool_coat belt bandana ceremonial_robe pajamas microfiber_cloth lace "
    "hammock diaper bandage",
    Family.BREAD: "baguette bap meat_loaf sourdough pastry croissant soft_roll hotdog hotdog_bun cheese_danish "
    "scone burrito biscuit edible_cookie_dough sugar_cookie_dough pizza_dough banana_bread fruitcake "
    "half_banana_bread half_fruitcake half_baguette half_meat_loaf half_sourdough half_pastry "
    "half_cookie_dough half_edible_cookie_dough half_sugar_cookie_dough half_spice_cookie_dough "
    "half_chocolate_cookie_dough half_bagel_dough half_biscuit_dough half_roll_dough half_pizza_dough "
    "half_garlic_bread half_hotdog half_hotdog_bun half_club_sandwich half_burrito half_enchilada "
    "half_croissant half_cinnamon_roll half_doughnut",
    Family.CAKE_SLICE: "chocolate_cake sliced_chocolate_cake sliced_watermelon sliced_melon half_cheesecake "
    "half_chocolate_cake half_tiramisu half_scone",
    Family.BAR: "log half_log firewood branch half_branch umbrella flashlight cork ski skyrocket wrapping_paper "
    "half_wrapping_paper plastic_wrap rolled_yoga_mat poster_roll rolling_pin baseball_bat "
    "test_tube_holder twine steel_wool",
    Family.HEAP: "bush boulder pebble jade geode seashell conch paraffin_wax sod salad scoop_of_ice_cream "
    "heap_of_granola heap_of_gravel heap_of_raisins quartz crystal paper_coffee_filter bell cloche "
    "lampshade broken_glass",
    Family.TENT: "tent roof",
    Family.HOOP: "wreath valentine_wreath hose copper_wire bracelet dog_collar cellulose_tape whitewall_tire "
    "car_wheel skateboard_wheel",
    Family.FIGURE: "bust statue toy_figure doll garden_statue classroom_mock_up pepper_grinder nativity_figurine "
    "snow_globe mannequin centerpiece water_cooler",
    Family.DUMBBELL: "free_weight weight_bar",
    Family.POST: "camera_tripod flag_pole pole buret_clamp flask_clamp test_tube_clamp cymbal gooseneck_microphone "
    "signpost easel flagpole makeup_mirror",
    Family.PENDANT: "chandelier ceiling_fan paper_lantern room_light wind_chime ceiling_mounted_projector",
    Family.FENCE: "rail_fence railing chicken_wire volleyball_net bed_screen towel_rack",
    Family.CANOPY: "arbor pergola swing_set playground swing clothesline skeletal_frame",
    Family.BARS: "parallel_bars kayak_rack",
    Family.RUNGS: "bicycle_rack",
    Family.STALL: "farm_stand",
    Family.STAIRCASE: "stairs",
    Family.LADDER: "ladder",
    Family.TREADMILL: "treadmill elliptical_machine exercise_bike",
    Family.LORRY: "lorry pickup_truck trailer_truck toy_car toy_train",
    Family.CYCLE: "bicycle motorcycle",
    Family.RANGE_HOOD: "range_hood",
    Family.URINAL: "urinal",
    Family.SHOWER_RAIL: "showerhead",
    Family.WORKSTATION: "cubicle",
    Family.TELEPHONE: "desk_phone credit_card_terminal stapler cellulose_tape_dispenser",
    Family.MICROSCOPE: "microscope food_slicer iron",
    Family.WHEELED_BOARD: "longboard skateboard_deck",
    Family.ROUND_FOOD: "balloon loofah light_bulb broken_light_bulb chicken_breast chicken_leg chicken_wing turkey_leg "
    "pea_pod wrapped_hamburger chicken_tender drumstick lemon_peel pearl diamond ruby auricularia "
    "chanterelle shiitake cotton_ball moth_ball",
}
HUNG: Final = frozenset(
    {Family.PENDANT, Family.SHOWER_RAIL, Family.RANGE_HOOD, Family.URINAL, Family.WINDOW, Family.GARAGE_DOOR}
)
"""Families that hang from a ceiling or on a wall, or are set into a wall: they need not stand by themselves."""
FLAT_ON_WALL: Final = frozenset(
    {
        "poster",
        "picture",
        "painting",
        "portrait",
        "mirror",
        "wall_mounted_tv",
        "window_blind",
        "curtain",
        "hanging",
        "hanging_banners",
        "canvas",
        "fixed_window",
        "electric_switch",
        "wall_socket",
        "periodic_table",
        "decorative_sign",
        "information_bulletin",
        "map",
    }
)
"""Sheets that hang on a wall."""
_FAMILY_OF: Final = {name: family for family, names in _NAMES.items() for name in names.split()}

_ALIKE_IN_HALF: Final = frozenset({Family.SLAB, Family.BREAD, Family.BAR})
"""Families whose halves belong to the same family: half a block is a shorter block."""
_PATTERNS: Final[tuple[tuple[re.Pattern[str], Family], ...]] = tuple(
    (re.compile(pattern), family)
    for pattern, family in (
        (r"half_.*", Family.HALF_FOOD),
        (r"sliced_.*", Family.DISC),
        (
            r"(bottle|carafe)_of_.*|.*_(bottle|atomizer|shaker)|spray_(can|bottle)|soap_dispenser",
            Family.BOTTLE,
        ),
        (r"(jar|can|tube|cup)_of_.*|.*_(jar|can|tin)", Family.CAN),
        (r"(box|pack|carton|case)_of_.*|boxed_.*|.*_(box|package|carton|case)", Family.SLAB),
        (r"bag_of_.*|.*_(bag|sack)", Family.SOFT),
        (r".*_candle", Family.CAN),
        (r".*_(knife|spoon|fork|brush)", Family.UTENSIL),
    )
)

_KINDS: Final[tuple[tuple[str, Family], ...]] = (
    ("fruit.n.01", Family.ROUND_FOOD),
    ("vegetable.n.01", Family.ROUND_FOOD),
    ("food.n.01", Family.ROUND_FOOD),
    ("food.n.02", Family.ROUND_FOOD),
    ("plant_part.n.01", Family.ROUND_FOOD),
    ("ball.n.01", Family.ROUND_FOOD),
    ("bottle.n.01", Family.BOTTLE),
    ("cutlery.n.02", Family.UTENSIL),
    ("tool.n.01", Family.UTENSIL),
    ("plant.n.02", Family.PLANT),
)
"""Family by ancestor in the taxonomy; the first match counts."""


_MOVABLE_FAMILY: Final[Mapping[Family, Family]] = {
    Family.CUBBY: Family.DRAWER_CUBBY,
    Family.DESK: Family.DRAWER_DESK,
    Family.TABLE: Family.DRAWER_TABLE,
}
"""Family of a model that the catalog lists with a joint, where the usual family has none: the variant with drawers."""
_CABINETS: Final = (
    Family.CUPBOARD, Family.DRAWER_CUPBOARD, Family.CUPBOARD, Family.CHEST_OF_DRAWERS,
)  # fmt: skip
"""Families shared out among low cabinets: the catalog does not say whether a model has doors or drawers."""
_CORNERS: Final[Mapping[str, Family]] = {
    "sofa": Family.CORNER_SOFA,
    "bench": Family.CORNER_BENCH,
    "bar": Family.CORNER_BAR,
    "countertop": Family.CORNER_WORKTOP,
}
"""Family of models that stand round a corner."""
_LOW_CABINETS: Final = frozenset({"bottom_cabinet", "bottom_cabinet_no_top", "metal_bottom_cabinet"})
_LOW_M: Final = 1.1


def family_of_model(catalog: Catalog, category: str, model_id: str) -> Family:
    """Return the family of one model: that of its category, the variant with drawers, or that round a corner.

    Raises CatalogError for an unknown category or model.
    """
    family = family_of(catalog, category)
    model = catalog.model(category, model_id)
    if is_corner(category, model.size_m):
        return _CORNERS[category]
    if "joint" not in model.meta_links:
        return family
    if category in _LOW_CABINETS and model.size_m[2] <= _LOW_M:
        return _CABINETS[zlib.crc32(model.listed_id.encode()) % len(_CABINETS)]
    return _MOVABLE_FAMILY.get(family, family)


def family_of(catalog: Catalog, category: str) -> Family:
    """Return the family of a category; a plain block if nothing else matches."""
    if category in _FAMILY_OF:
        return _FAMILY_OF[category]
    whole = category.removeprefix("half_")
    if _FAMILY_OF.get(whole) in _ALIKE_IN_HALF:
        return _FAMILY_OF[whole]
    for pattern, family in _PATTERNS:
        if pattern.fullmatch(category):
            return family
    synset = catalog.synset_of(category)
    for ancestor, family in _KINDS:
        if catalog.has_synset(ancestor) and catalog.is_a(synset, ancestor):
            return family
    return Family.BLOCK
