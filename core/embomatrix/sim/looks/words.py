"""Materials by the words of a category's name: ``half_apple`` is red fruit, ``wooden_spoon`` is oak."""

import functools
from typing import Final

from embomatrix.sim.looks.materials import MaterialKind as Kind

WORDS: Final[dict[Kind, str]] = {
    Kind.OAK: """
        arbor background bar_stool baseball_bat baseboard bed bench bird_feeder birdcage board bookcase bookcase_back
        bookcase_baseboard bookcase_shelf bookcase_side bookcase_top bookend booth breakfast_table bulletin_board
        bunk_bed cabinet_door candy_dispenser_shelf chair checkout_counter chess_set chicken_coop chopping_block
        chopping_board chopstick classroom_mock_up coatrack coffee_table commercial_kitchen_table console_table crib
        cutting_board dartboard desk desk_bracket desk_leg desk_top dessert_stand display_case door dowel
        dry_food_dispenser_shelf easel farm_stand firewood floors frame furniture garden_chair garden_coffee_table
        gate golf_club guitar hall_tree highchair hockey_stick hutch knife_block lab_table ladder log loin
        magazine_rack magazine_stand mallet match music_stool nativity_figurine nightstand paddle pallet parallel_bars
        pedestal pegboard pergola pestle picture_frame plywood pool_stick rail_fence reception_desk rocking_chair
        rolling_pin sauna_bench shelf shoe_rack signpost skateboard_deck stairs stake stand stool straight_chair
        structural_element table taboret toothpick toy_box toy_figure toy_train tray umbrella_rack violin walker
        wooden_spoon""",
    Kind.WALNUT: """
        antlers bar bust cedar_chest cigar conference_table gaming_table grandfather_clock jukebox pedestal_table
        piano pipe pool_table room_divider tobacco_pipe violin_case wardrobe""",
    Kind.PINE: "clothesline_pole colored_pencil cork hamper paper_bag pencil ruler set_triangle",
    Kind.BAMBOO: "bed_screen mat place_mat rolled_yoga_mat shutter steamer_basket straw window_blind",
    Kind.LACQUER: """
        bottom_cabinet bottom_cabinet_no_top cabinet_base ceilings cubicle fixed_window garage_door locker
        openable_window sliding_door top_cabinet walls window""",
    Kind.STEEL: """
        allen_wrench ashtray axe baking_sheet beer_keg beer_tap bell bicycle bicycle_chain bicycle_rack bobby_pin
        bracelet bucket_of_paint bulldog_clip buret_clamp burner caliper camera_tripod canister canteen carving_knife
        ceiling_rack chicken_wire chisel clamp cleaver clipper cloche clout_nail colander commercial_kitchen_shelf
        commercial_kitchen_sink cookie_cutter cookie_stick corkscrew cream_pitcher crock_pot curtain_rod cymbal
        deep_fryer dish_rack dish_rack_cart dishwasher display_fridge drill drink_dispenser drip_pot drop_in_sink
        drying_rack dustpan electric_kettle elevator_door espresso_machine flag_pole flagpole flask_clamp
        flat_top_grill food_slicer fork free_weight_rack freezer fridge funnel furniture_sink grater gravy_boat
        grocery_fridge grocery_shelf hammer hand_dryer handle hanger hinge hitch hoe honing_steel hook hook_rack
        ice_bucket ice_tray instant_pot jigger juicer kayak_rack kettle key keys knife l_shaped_handle lid lock
        measuring_cup metal_bottom_cabinet microwave mixing_bowl motorcycle mousetrap multi_station_furniture_sink
        multi_station_tabletop_sink multi_station_wall_mounted_sink nail necklace nickel oden_cooker open_end_wrench
        oven paper_clip paper_liners paper_towel_dispenser paper_towel_holder parer pasta_server pastry_cutter
        pewter_teapot plier pocketknife pole popcorn_machine portafilter pot pressure_cooker putty_knife quarter
        radiator railing rake range_hood razor retainer rice_cooker ring ripsaw roasting_pan saucepan saucepot
        sauna_heater saxophone scoop scraper screw screwdriver serving_cart shaker shears shopping_basket
        shopping_cart shovel shower showerhead sieve silver_coin skeletal_frame skimmer soup_ladle soupspoon spatula
        spoon staple steel_wool stockpot stove straight_pin table_knife tablefork tablespoon tabletop_sink tackle_box
        tank teaspoon test_tube_clamp tinsel tissue_dispenser toaster toaster_oven toilet_paper_dispenser
        toilet_paper_holder tongs towel_rack trampoline_leg trombone trowel trumpet turnstile tweezers utility_knife
        vegetable_peeler vending_machine watch water_dispenser water_filter weight_bar whisk whistle wine_fridge
        wire_cutter zipper""",
    Kind.IRON: """
        bench_press_machine car_wheel cauldron charcoal_grill dutch_oven electric_cauldron elliptical_machine
        exercise_bike firewood_grate flat_bench folding_chair free_weight frying_pan gas_fireplace griddle_pan
        hamster_wheel infant_car_seat iron lawn_mower photocopier poker printer projector pruner smoker stroller
        toasting_fork treadmill waffle_maker wind_chime wok wood_fireplace""",
    Kind.BRASS: "address candle_holder chalice chandelier gold_coin lens thumbtack trophy",
    Kind.COPPER: "copper_pot copper_wire cruet penny",
    Kind.ALUMINIUM: """
        aluminum_foil can can_of_soda digital_scale laptop license_plate shower_stall spray_can tablet track_light""",
    Kind.PORCELAIN: """
        bathtub cake_stand casserole ceramic_tile china denture drinking_fountain hot_tub mortar pedestal_sink plate
        platter saucer sink soap_dish teacup teapot tile toilet urinal wall_mounted_sink""",
    Kind.STONEWARE: "bowl carafe coaster coffee_cup dipper jug mug outline_tray outline_vase pitcher vase",
    Kind.TERRACOTTA: "paver plant_pot plant_pot_stand roof",
    Kind.GLASS: """
        beaker beer_glass blender broken_glass buret cocktail_glass coffee_maker crystal decanter diamond
        erlenmeyer_flask eyeglasses french_press glass glass_lantern goblet goggles graduated_cylinder hinged_jar
        hingeless_jar hourglass magnifying_glass petri_dish quartz reagent_bottle round_bottom_flask snow_globe
        specimen_bottle spirit_lamp sunglasses terrarium test_tube test_tube_rack water_glass windshield wineglass""",
    Kind.MIRROR: "cd dvd makeup_mirror mirror standing_mirror",
    Kind.GRANITE: "countertop headstone whetstone whiskey_stone",
    Kind.STONE: """
        boulder cast conch driveway fountain garden_statue geode heap_of_gravel moth_ball paving_stone pebble pillar
        seashell statue stone_wall swimming_pool""",
    Kind.WHITE_PLASTIC: """
        air_conditioner air_filter air_freshener_atomizer ceiling_air_conditioner ceiling_fan clothes_dryer
        coffee_grinder conditioner_dispenser cooler credit_card_terminal cup_holder dehumidifier dental_floss
        desk_phone digital_thermometer electric_fan electric_hand_mixer electric_mixer electric_switch facsimile
        fire_alarm fire_sprinkler first_aid_kit food_processor hair_dryer handset hospital_bed inhaler
        isopropanol_dispenser keyboard kitchen_analog_scale lab_exhaust_hood lint_roller litter_box meat_thermometer
        modem motion_sensor mouse outlet paper_cup pool_ball projection_screen room_ventilator router scanner
        security_camera shampoo_dispenser soap_dispenser space_heater syringe thermostat toothbrush tupperware
        volleyball wall_clock wall_mounted_soap_dispenser wall_socket washer water_cooler whiteboard""",
    Kind.BLACK_PLASTIC: """
        alarm_clock battery bowling_ball boxed_cpu_board briefcase calculator carpet_sweeper cash_register
        ceiling_mounted_projector cell_phone chainsaw charger comb credit_card desktop_computer digital_camera
        duct_tape eames_chair flashlight game_console gaming_controller gooseneck_microphone hairbrush hard_drive
        headset heatgun hockey_puck leaf_blower loudspeaker magnetic_stirrer marker masking_tape microphone microscope
        pay_phone pen phonograph_record plug portable_game_console power_drill power_strip power_washer
        public_trash_can radio scoreboard shredder sound_system standing_loudspeaker stapler suitcase swivel_chair
        toolbox trash_can umbrella vacuum video_game wall_mounted_loudspeaker webcam""",
    Kind.PLASTIC: """
        alphabet_abacus baby_bottle bait ball balloon bar_soap beach_toy board_game broom bucket car clipboard
        compost_bin crayon cup dart desk_organizer dice dog_collar dreidel easter_egg eraser fishing_rod folder
        fuel_can garden_umbrella globe glue_stick gym_mat hose hose_cart jelly_bean jigsaw_puzzle jigsaw_puzzle_piece
        kayak key_chain life_jacket lighter lip_balm lipstick longboard lorry lunch_box mailbox mop mop_bucket
        name_tag paint_roller paintbrush pencil_case pencil_holder pennant pickup_truck plastic_bag plastic_wrap
        playground price_tag pump recreational_vehicle recycling_bin rubber_eraser scrub_brush skateboard_wheel
        skateboard_wheel_assembly skates ski skiff soap soap_bottle sponge spray_bottle squeegee squeeze_bottle
        sticker storage_box storage_organizer swing swing_set tag tarp tennis_racket tent toilet_soap tote toy toy_car
        toy_dice trailer_truck trampoline wading_pool water_bottle watering_can wheelbarrow work_helmet yoga_mat""",
    Kind.RUBBER: "boxing_gloves mousepad punching_bag rubber_boot rubber_glove whitewall_tire",
    Kind.SCREEN: "blackboard monitor standing_tv tv wall_mounted_tv",
    Kind.PICTURE: """
        calendar canvas decorative_sign grocery_sign hanging hanging_banners information_bulletin map national_flag
        painting periodic_table picture portrait postcard poster poster_roll""",
    Kind.LAMPSHADE: "floor_lamp lamp lampshade paper_lantern room_light table_lamp wall_mounted_light",
    Kind.LIGHT: """
        downlight fairy_light garden_light icicle_lights light_bulb rectangular_light sparkler spotlight square_light""",
    Kind.WAX: "beeswax_candle dip_candle paraffin_wax pillar_candle reed_diffuser wax wax_paper",
    Kind.UPHOLSTERY: """
        armchair chaise_longue cushion footstool massage_bed ottoman pet_bed pommel_horse sofa stadium_stand""",
    Kind.LINEN: """
        bandage bed_sheet clothesline cotton_ball cotton_thread curtain diaper dinner_napkin doily ironing_board lace
        mannequin mattress paper_coffee_filter pillow pillowcase rope sanitary_napkin sauna_suit tablecloth tassel
        tea_bag twine""",
    Kind.TEXTILE: """
        apron baby_shoe backpack bag bandana baseball_cap batting_gloves belt bikini blanket blouse bow boxers bra cap
        cardigan ceremonial_robe christmas_stocking doll dress dress_shirt gloves gym_shoe hammock hat hoodie jeans
        jersey legging leotard maillot necktie onesie pajamas pants quilt raincoat ribbon satchel scarf shirt shoe
        shorts shoulder_bag skirt sleeping_bag sock sweatshirt t_shirt table_runner tights vest wool_coat""",
    Kind.TOWEL: "bath_towel dishtowel hand_towel loofah microfiber_cloth rag towel",
    Kind.RUG: "carpet rug",
    Kind.LEATHER: """
        baseball baseball_glove basketball high_heel hiking_boot sandal slingback soccer_ball softball wallet""",
    Kind.WICKER: "basket burlap_bag frail hanging_basket wicker_basket",
    Kind.FUR: "feather fur_coat teddy_bear",
    Kind.PAPER: """
        architectural_plan cardstock cellulose_tape cellulose_tape_dispenser cigarette emery_paper envelope folderal
        legal_document letter lint_screen mail menu money newspaper notebook notepad paper paper_sheet paper_towel
        post_it postage_stamp receipt sticky_note ticket tissue toilet_paper wrapping_paper""",
    Kind.CARDBOARD: """
        box carton case french_fry_holder gift_box match_box package packing_box pizza_box pop_case shoe_box takeout""",
    Kind.BOOK: "book catalog comic_book hardback magazine paperback_book textbook",
    Kind.PACKAGE: """
        bag_of_chips boxed_cake boxed_ink_cartridge boxed_router butter_package candy cereal cream_carton
        cream_cheese_box feta_box gelatin_box granola_box ground_beef_package hummus_box milk_carton oat_box pasta_box
        popcorn_bag raisin_box snack_rack""",
    Kind.BOTTLE: "bottle detergent fire_extinguisher lotion perfume shampoo skyrocket",
    Kind.JAR: "pepper_grinder pepper_shaker salt_shaker",
    Kind.TIN: "canned_food ink_bottle spray_paint_can",
    Kind.SACK: "bird_feed_bag flour_sack mulch_bag pellet_food_bag petfood_bag soil_bag sugar_sack",
    Kind.FOLIAGE: """
        agave branch bush cactus centerpiece christmas_tree christmas_tree_decorated echeveria_elegans garden_plant
        greenery half_leaf hanging_plant holly_decoration jade leaf lily_pad low_resolution_tree plant plant_stem
        pot_plant pottable_cactus tree valentine_wreath vine weed wreath""",
    Kind.LAWN: "lawn sod",
    Kind.BARK: "acorn cinnamon_stick mulch pine_cone star_anise wood",
    Kind.SOIL: "fertilizer soil",
    Kind.SAND: "pellet sandbox",
    Kind.WATER: "pool water",
    Kind.FLOWER: """
        bouquet daffodil_bulb dahlia_flower flower flower_petal lavender lily marigold poinsettia pottable_daffodil
        pottable_dahlia pottable_marigold rose sunflower tulip vanilla_flower""",
    Kind.LEAFY: """
        artichoke arugula asparagus basil bay_leaf bok_choy broccoli broccoli_rabe broccolini brussels_sprouts celery
        chard chives chopped_lettuce cilantro dill fennel green_bean green_onion green_onion_stalk head_cabbage herb
        kale leek lettuce mint mustard_leaf okra parsley pea_pod rosemary salad spinach tea_leaves whole_fennel""",
    Kind.GREEN: """
        avocado cucumber durian gooseberry grape kiwi lime melon olive pattypan_squash pear pesto pickle
        sliced_cucumber watermelon zucchini""",
    Kind.RED: """
        apple beefsteak_tomato beet bell_pepper candy_cane catsup cherry cherry_tomato chili cranberry paprika
        pomegranate pottable_beefsteak_tomato pottable_chili radish raspberry rhubarb rosehip ruby salsa sliced_tomato
        sriracha strawberry tomato""",
    Kind.ORANGE: """
        apricot butternut_squash candied_yam cantaloup carrot dried_apricot gourd half_pumpkin mango nectarine orange
        papaya peach pumpkin sliced_papaya""",
    Kind.YELLOW: """
        banana bunch_of_bananas butter corn french_fries grapefruit honey lemon lemon_peel mac_and_cheese mustard
        omelet pasta pineapple pomelo quiche sliced_lemon sweet_corn""",
    Kind.PURPLE: "blackberry date eggplant heap_of_raisins plum raisin sliced_eggplant",
    Kind.BROWN: """
        almond bean brown_sugar chestnut clove coconut coconut_fruit coffee granola hazelnut nut nutmeg potato walnut
        walnut_meat""",
    Kind.PINK: """
        bacon cold_cuts hard_candy ice_lolly lollipop macaron macaroon marshmallow pearl peppermint peppermint_candy
        prosciutto salmon virginia_ham""",
    Kind.MUSHROOM: """
        auricularia chanterelle garlic garlic_clove mushroom onion shiitake sliced_mushroom sliced_onion vidalia_onion""",
    Kind.ROOT: "cauliflower ginger ginger_root parsnip popcorn rice rutabaga white_turnip",
    Kind.BREAD: """
        apple_pie arepa bagel baguette banana_bread bap biscuit bread bread_slice burrito butter_cookie
        buttermilk_pancake cake cheese_danish cheese_tart chip chocolate_chip_cookie cinnamon_roll club_sandwich
        cookie croissant cupcake donut doughnut dumpling enchilada french_toast fruitcake garlic_bread gingerbread
        granola_bar hamburger hamburger_bun hotdog hotdog_bun ice_cream_cone lasagna muffin pastry pita pizza pretzel
        sandwich scone soft_roll sourdough spice_cookie sugar_cookie taco tartlet toast tortilla tortilla_chip
        tortilla_chips wafer waffle wrapped_hamburger""",
    Kind.DOUGH: """
        bagel_dough biscuit_dough cookie_dough edible_cookie_dough flour noodle pizza_dough ramen roll_dough
        spice_cookie_dough starch sugar_cookie_dough sushi yeast""",
    Kind.CHOCOLATE: """
        brownie chocolate_bar chocolate_biscuit chocolate_cake chocolate_cookie_dough cocoa sliced_chocolate_cake
        tiramisu""",
    Kind.CHEESE: "cheddar cheese cheesecake parmesan swiss_cheese",
    Kind.CREAM: """
        bean_curd bleu coconut_milk cream feta frosting gelatin ice_cream mayonnaise milk mozzarella salt
        scoop_of_ice_cream sugar sugar_cube tofu whipped_cream white_chocolate white_sauce yogurt""",
    Kind.EGG: "carton_of_eggs egg hard_boiled_egg raw_egg",
    Kind.MEAT: """
        brisket chorizo ground_beef ham_hock lamb meat patty pepperoni pork pork_chop pork_rib quail_breast_raw rib
        sliced_brisket sliced_roast_beef steak tenderloin veal venison""",
    Kind.ROAST: """
        bratwurst chicken chicken_breast chicken_leg chicken_tender chicken_wing drumstick duck fried_chicken
        hotdog_frank jerky kabob kebab kielbasa meat_loaf meatball quail_breast quail_leg sausage schnitzel turkey
        turkey_leg""",
    Kind.FISH: "fillet fish octopus snapper squid trout tuna",
    Kind.SHELLFISH: "clam crab crawfish lobster mussel oyster scallop shrimp",
    Kind.ICE: "ice ice_cube",
    Kind.SAUCE: "broth jam jelly marinara puree sauce soup soy_sauce syrup",
    Kind.SPICE: """
        bouillon_cube cinnamon coriander cumin curry_powder oatmeal pepper powder saffron seasoning spice""",
}
"""Names and last words of categories by material. A longer match wins, a later word of the name over an earlier one."""

_CUT: Final = ("half_", "sliced_", "pottable_", "broken_", "baby_", "toy_")
"""First words that say nothing about the material."""
CONTAINERS: Final = {
    "bottle": Kind.BOTTLE,
    "atomizer": Kind.BOTTLE,
    "tube": Kind.BOTTLE,
    "dispenser": Kind.WHITE_PLASTIC,
    "jar": Kind.JAR,
    "shaker": Kind.JAR,
    "cup": Kind.JAR,
    "can": Kind.TIN,
    "tin": Kind.TIN,
    "box": Kind.PACKAGE,
    "pack": Kind.PACKAGE,
    "package": Kind.PACKAGE,
    "carton": Kind.PACKAGE,
    "bag": Kind.SACK,
    "sack": Kind.SACK,
    "jug": Kind.BOTTLE,
    "stick": Kind.WHITE_PLASTIC,
}
"""Packages by the word before ``_of_`` or the last word of a name."""


@functools.cache
def kind_by_words(category: str) -> Kind | None:
    """Return the material kind of a category, or None if no word of its name is listed."""
    listed = _listed()
    for cut in ("", *_CUT):
        name = category.removeprefix(cut)
        if (cut == "" or name != category) and name in listed:
            return listed[name]
    head, of, _ = category.partition("_of_")
    if of and head in CONTAINERS:
        return CONTAINERS[head]
    words = category.split("_")
    if len(words) > 1 and words[-1] in CONTAINERS:
        return CONTAINERS[words[-1]]
    for end in range(len(words), 0, -1):
        for start in range(end):
            phrase = "_".join(words[start:end])
            if phrase in listed:
                return listed[phrase]
    return None


def content_by_words(category: str) -> Kind | None:
    """Return the material kind of a package's content: red fruit for ``tomato_paste_can``. None if nothing is packed."""
    head, of, content = category.partition("_of_")
    if of and head in CONTAINERS:
        return kind_by_words(content)
    words = category.split("_")
    if len(words) > 1 and words[-1] in CONTAINERS:
        return kind_by_words("_".join(words[:-1]))
    return None


@functools.cache
def _listed() -> dict[str, Kind]:
    return {word: kind for kind, words in WORDS.items() for word in words.split()}
