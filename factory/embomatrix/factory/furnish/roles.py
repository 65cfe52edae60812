"""Role of each category in a room: placement, importance, and height on a wall.

The tables list categories of the 51 inventories that need a decision. Any other model gets its role from its size and mass.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import Final

from embomatrix.skills.limits import ROBOT
from embomatrix.world.asset import Asset


class FurnitureRole(StrEnum):
    """Kind of place that a model gets."""

    RUN = "run"  # shoulder to shoulder along a wall: cabinets, appliances, sinks
    COUNTERTOP = "countertop"  # a slab over base cabinets
    BACKED = "backed"  # back to a wall, front to the room
    TABLE = "table"  # free-standing with chairs around, or a desk at a wall
    SEAT = "seat"  # goes with a table; along a wall otherwise
    LOW_TABLE = "low_table"  # before a sofa
    CORNER = "corner"  # in a corner or beside other furniture
    HUNG_CABINET = "hung_cabinet"  # on the wall above a counter
    WALL = "wall"  # on the wall at its height
    CEILING = "ceiling"
    RUG = "rug"
    SURFACE = "surface"  # on or in furniture
    FITTED = "fitted"  # on a counter, for good: basins and cooktops
    OPEN = "open"  # in the open, away from walls: cars, machines, a pool table
    PLANTING = "planting"  # along the edges of a garden
    STRUCTURE = "structure"  # part of the building or its surroundings, not placed


_BY_ROLE: Final[Mapping[FurnitureRole, str]] = {
    FurnitureRole.RUN: "bottom_cabinet bottom_cabinet_no_top metal_bottom_cabinet fridge freezer oven stove dishwasher washer "
    "clothes_dryer furniture_sink commercial_kitchen_sink multi_station_furniture_sink flat_top_grill deep_fryer "
    "electric_cauldron wine_fridge display_fridge grocery_fridge lab_exhaust_hood",
    FurnitureRole.COUNTERTOP: "countertop",
    FurnitureRole.BACKED: "bed sofa bookcase armchair wardrobe cedar_chest console_table nightstand standing_mirror piano "
    "toilet pedestal_sink bathtub shower_stall grandfather_clock jukebox bar commercial_kitchen_table locker vending_machine "
    "photocopier reception_desk checkout_counter display_case grocery_shelf hall_tree wood_fireplace gas_fireplace "
    "crib hospital_bed magazine_stand snack_rack urinal eames_chair serving_cart "
    "charcoal_grill stadium_stand sauna_bench hammam_bench car recreational_vehicle motorcycle stand dish_rack_cart",
    FurnitureRole.TABLE: "breakfast_table dining_table pedestal_table conference_table desk booth lab_table cubicle",
    FurnitureRole.SEAT: "straight_chair swivel_chair taboret bench garden_chair music_stool rocking_chair",
    FurnitureRole.LOW_TABLE: "coffee_table garden_coffee_table",
    FurnitureRole.CORNER: "floor_lamp public_trash_can trash_can coatrack ottoman hamper standing_loudspeaker umbrella_rack "
    "water_cooler radiator electric_fan desktop_computer shredder suitcase shopping_cart",
    FurnitureRole.HUNG_CABINET: "top_cabinet range_hood commercial_kitchen_shelf",
    FurnitureRole.WALL: "picture painting portrait mirror electric_switch towel_rack wall_mounted_tv wall_clock whiteboard "
    "blackboard paper_towel_dispenser toilet_paper_dispenser toilet_paper_holder hand_dryer wall_socket wall_nail hook "
    "wall_mounted_light wall_mounted_sink wall_mounted_soap_dispenser shelf pay_phone wall_mounted_loudspeaker "
    "information_bulletin periodic_table map decorative_sign signpost makeup_mirror showerhead scoreboard "
    "security_camera fire_extinguisher projection_screen hanging_banners multi_station_wall_mounted_sink hanging "
    "architectural_plan",
    FurnitureRole.CEILING: "downlight square_light room_light rectangular_light ceiling_fan ceiling_rack room_ventilator "
    "fire_alarm fire_sprinkler track_light spotlight chandelier paper_lantern ceiling_air_conditioner hanging_plant "
    "ceiling_mounted_projector motion_sensor",
    FurnitureRole.RUG: "carpet gym_mat",
    FurnitureRole.SURFACE: "cash_register microwave laptop coffee_maker table_lamp loudspeaker monitor keyboard printer "
    "espresso_machine standing_tv popcorn_machine electric_mixer food_slicer crock_pot beer_tap jug stockpot saucepot "
    "frying_pan tray pillow vase desk_phone buret box_of_fruit lid chess_set mousepad place_mat table_runner oden_cooker "
    "dessert_stand terrarium chopping_board carton toy_box blanket quilt guitar",
    FurnitureRole.FITTED: "burner drop_in_sink tabletop_sink multi_station_tabletop_sink",
    FurnitureRole.OPEN: "pool_table playground swing_set sandbox wading_pool garden_statue hot_tub massage_bed "
    "bench_press_machine elliptical_machine exercise_bike flat_bench parallel_bars pommel_horse "
    "treadmill turnstile",
    FurnitureRole.PLANTING: "tree low_resolution_tree bush garden_plant boulder garden_light",
    FurnitureRole.STRUCTURE: "structural_element baseboard background greenery paver skeletal_frame stone_wall rail_fence "
    "stairs railing pergola arbor swimming_pool room_divider pedestal wall_panel l_shaped_handle handle classroom_mock_up "
    "vine shower fairy_light window_blind pillar roof volleyball_net ceiling_mounted_basketball_hoop",
}
_ROLE_OF: Final[Mapping[str, FurnitureRole]] = {
    c: role for role, names in _BY_ROLE.items() for c in names.split()
}

_IMPORTANCE: Final[Mapping[str, float]] = {
    "fridge": 20, "oven": 14, "stove": 14, "furniture_sink": 20, "pedestal_sink": 20,
    "commercial_kitchen_sink": 20, "bed": 25, "toilet": 25, "sofa": 9, "dishwasher": 6, "bar": 9,
    "breakfast_table": 8, "dining_table": 8, "desk": 8, "booth": 8, "cubicle": 8, "conference_table": 8,
    "car": 7, "drop_in_sink": 10, "tabletop_sink": 10, "burner": 8, "multi_station_furniture_sink": 20,
    "urinal": 9, "grocery_shelf": 9, "checkout_counter": 10, "reception_desk": 10, "lab_table": 8,
    "hospital_bed": 12, "commercial_kitchen_table": 9, "bathtub": 8, "shower_stall": 8, "washer": 8,
    "microwave": 8, "countertop": 6, "bottom_cabinet": 6, "bookcase": 6, "top_cabinet": 5, "wardrobe": 6,
    "wall_mounted_sink": 12, "multi_station_wall_mounted_sink": 12,
}  # fmt: skip

_WALL_HEIGHT: Final[Mapping[str, float]] = {
    "picture": 1.55, "painting": 1.55, "portrait": 1.55, "mirror": 1.55, "electric_switch": 1.15, "towel_rack": 1.15,
    "wall_mounted_tv": 1.6, "wall_clock": 1.9, "paper_towel_dispenser": 1.35, "toilet_paper_dispenser": 0.75,
    "toilet_paper_holder": 0.75, "wall_socket": 0.3, "wall_nail": 1.6, "pay_phone": 1.35, "shelf": 1.45,
    "wall_mounted_sink": 0.75, "fire_extinguisher": 1.0, "security_camera": 2.15, "hand_dryer": 1.2,
}  # fmt: skip
"""Height of the centre of objects on a wall, in metres."""

HUNG_BOTTOM_M: Final = 1.4
"""Height of the underside of wall cabinets: above the counters and out of the robot's way."""

_WALL_DEFAULT_M: Final = 1.5
_SMALL_EXTENT_M: Final = 0.65
_SMALL_VOLUME_M3: Final = 0.06


def role_of(category: str, size_m: tuple[float, float, float], mass_kg: float) -> FurnitureRole:
    """Return the role of a model of this size (depth, width, height) and mass."""
    if category == "pot_plant":
        return FurnitureRole.CORNER if size_m[2] > 0.6 else FurnitureRole.SURFACE
    if category in _ROLE_OF:
        return _ROLE_OF[category]
    volume = size_m[0] * size_m[1] * size_m[2]
    if max(size_m) <= _SMALL_EXTENT_M and volume <= _SMALL_VOLUME_M3 and mass_kg <= 2 * ROBOT.mass_kg:
        return FurnitureRole.SURFACE
    if max(size_m) > 4.0 or size_m[2] > 3.0:
        return FurnitureRole.STRUCTURE
    return FurnitureRole.CORNER if max(size_m[:2]) < 0.6 else FurnitureRole.BACKED


def importance_of(category: str, role: FurnitureRole) -> float:
    """Return the cost of leaving one out: large for pieces that define the room."""
    if category in _IMPORTANCE:
        return _IMPORTANCE[category]
    return {
        FurnitureRole.RUN: 6.0,
        FurnitureRole.BACKED: 5.0,
        FurnitureRole.TABLE: 6.0,
        FurnitureRole.LOW_TABLE: 4.0,
        FurnitureRole.SEAT: 2.0,
        FurnitureRole.CORNER: 2.0,
        FurnitureRole.OPEN: 4.0,
        FurnitureRole.PLANTING: 0.1,
    }.get(role, 1.0)


def wall_height_m(category: str) -> float:
    """Return the height of the centre of an object on a wall above the floor."""
    return _WALL_HEIGHT.get(category, _WALL_DEFAULT_M)


def is_portable(asset: Asset) -> bool:
    """True if the robot can pick the model up. Appliances that heat are fixed."""
    return (
        asset.mass_kg <= ROBOT.mass_kg
        and min(asset.size_m) <= ROBOT.grip_m
        and max(asset.size_m) <= ROBOT.extent_m
        and not (asset.interiors and asset.can("heatSource"))
    )
