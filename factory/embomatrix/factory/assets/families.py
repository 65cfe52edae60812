"""The families of geometry and their generators: fixed proportions, to which the model gives the size."""

from __future__ import annotations

import functools
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from embomatrix.factory.assets import cabinets, desks, fixtures, furniture, goods, structures, vessels

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from embomatrix.factory.assets.body import Body
    from embomatrix.world.geometry import Vec3

    Generator = Callable[[Vec3], Body]


class Family(StrEnum):
    """Kinds of geometry."""

    CUPBOARD = "cupboard"
    DRAWER_CUPBOARD = "drawer_cupboard"
    CHEST_OF_DRAWERS = "chest_of_drawers"
    WALL_CUPBOARD = "wall_cupboard"
    LOCKER = "locker"
    FRIDGE = "fridge"
    FREEZER = "freezer"
    MICROWAVE = "microwave"
    OVEN = "oven"
    DISHWASHER = "dishwasher"
    WASHER = "washer"
    SHELVING = "shelving"
    CUBBY = "cubby"
    DRAWER_CUBBY = "drawer_cubby"
    WARDROBE = "wardrobe"
    CHEST = "chest"
    OPEN_BOX = "open_box"
    TABLE = "table"
    DRAWER_TABLE = "drawer_table"
    DESK = "desk"
    DRAWER_DESK = "drawer_desk"
    SHELF_TABLE = "shelf_table"
    PEDESTAL_TABLE = "pedestal_table"
    COUNTER = "counter"
    CHAIR = "chair"
    SWIVEL_CHAIR = "swivel_chair"
    STOOL = "stool"
    SOFA = "sofa"
    BED = "bed"
    BUNK_BED = "bunk_bed"
    LAMP = "lamp"
    SLAB = "slab"
    BLOCK = "block"
    ROUND = "round"
    CUP = "cup"
    GOBLET = "goblet"
    PAN = "pan"
    POT = "pot"
    LIDDED_VESSEL = "lidded_vessel"
    BLENDER = "blender"
    PLATE = "plate"
    BOTTLE = "bottle"
    CAN = "can"
    ROUND_FOOD = "round_food"
    HALF_FOOD = "half_food"
    DISC = "disc"
    SOFT = "soft"
    UTENSIL = "utensil"
    SINK = "sink"
    MULTI_SINK = "multi_sink"
    PEDESTAL_SINK = "pedestal_sink"
    TUB = "tub"
    TOILET = "toilet"
    SHOWER_STALL = "shower_stall"
    COOKTOP = "cooktop"
    GRILL = "grill"
    COFFEE_MACHINE = "coffee_machine"
    DOOR = "door"
    SLIDING_DOOR = "sliding_door"
    GARAGE_DOOR = "garage_door"
    WINDOW = "window"
    LAPTOP = "laptop"
    SCREEN = "screen"
    PLANT = "plant"
    TREE = "tree"
    CAR = "car"
    CLOTH = "cloth"
    BREAD = "bread"
    CAKE_SLICE = "cake_slice"
    BAR = "bar"
    HEAP = "heap"
    TENT = "tent"
    HOOP = "hoop"
    FIGURE = "figure"
    DUMBBELL = "dumbbell"
    POST = "post"
    PENDANT = "pendant"
    FENCE = "fence"
    CANOPY = "canopy"
    BARS = "bars"
    RUNGS = "rungs"
    STALL = "stall"
    STAIRCASE = "staircase"
    LADDER = "ladder"
    TREADMILL = "treadmill"
    LORRY = "lorry"
    CYCLE = "cycle"
    RANGE_HOOD = "range_hood"
    URINAL = "urinal"
    SHOWER_RAIL = "shower_rail"
    WORKSTATION = "workstation"
    TELEPHONE = "telephone"
    MICROSCOPE = "microscope"
    WHEELED_BOARD = "wheeled_board"


def _cabinet(style: cabinets.CabinetStyle) -> Generator:
    return functools.partial(cabinets.cabinet, style=style)


def _vessel(style: vessels.VesselStyle) -> Generator:
    return functools.partial(vessels.vessel, style=style)


GENERATORS: Final[Mapping[Family, Generator]] = {
    Family.CUPBOARD: _cabinet(cabinets.CUPBOARD),
    Family.DRAWER_CUPBOARD: _cabinet(cabinets.DRAWER_CUPBOARD),
    Family.CHEST_OF_DRAWERS: _cabinet(cabinets.CHEST_OF_DRAWERS),
    Family.WALL_CUPBOARD: _cabinet(cabinets.WALL_CUPBOARD),
    Family.LOCKER: _cabinet(cabinets.LOCKER),
    Family.FRIDGE: _cabinet(cabinets.FRIDGE),
    Family.FREEZER: _cabinet(cabinets.FREEZER),
    Family.MICROWAVE: _cabinet(cabinets.MICROWAVE),
    Family.OVEN: _cabinet(cabinets.OVEN),
    Family.DISHWASHER: _cabinet(cabinets.DISHWASHER),
    Family.WASHER: _cabinet(cabinets.WASHER),
    Family.SHELVING: cabinets.shelving,
    Family.CUBBY: _cabinet(cabinets.CUBBY),
    Family.DRAWER_CUBBY: _cabinet(cabinets.DRAWER_CUBBY),
    Family.WARDROBE: _cabinet(cabinets.WARDROBE),
    Family.CHEST: cabinets.chest,
    Family.OPEN_BOX: cabinets.open_box,
    Family.TABLE: furniture.table,
    Family.DRAWER_TABLE: desks.drawer_table,
    Family.DESK: desks.desk,
    Family.DRAWER_DESK: desks.drawer_desk,
    Family.SHELF_TABLE: furniture.table_with_shelf,
    Family.PEDESTAL_TABLE: furniture.pedestal_table,
    Family.COUNTER: furniture.counter,
    Family.CHAIR: furniture.chair,
    Family.SWIVEL_CHAIR: furniture.swivel_chair,
    Family.STOOL: furniture.stool,
    Family.SOFA: furniture.sofa,
    Family.BED: furniture.bed,
    Family.BUNK_BED: furniture.bunk_bed,
    Family.LAMP: furniture.lamp,
    Family.SLAB: furniture.slab,
    Family.BLOCK: furniture.block,
    Family.ROUND: _vessel(vessels.OPEN_ROUND),
    Family.CUP: _vessel(vessels.CUP),
    Family.GOBLET: _vessel(vessels.GOBLET),
    Family.PAN: _vessel(vessels.PAN),
    Family.POT: _vessel(vessels.POT),
    Family.LIDDED_VESSEL: vessels.lidded_vessel,
    Family.BLENDER: vessels.blender,
    Family.PLATE: vessels.plate,
    Family.BOTTLE: vessels.bottle,
    Family.CAN: vessels.can,
    Family.ROUND_FOOD: goods.round_food,
    Family.HALF_FOOD: goods.half_food,
    Family.DISC: goods.disc,
    Family.SOFT: goods.soft,
    Family.UTENSIL: goods.utensil,
    Family.SINK: fixtures.furniture_sink,
    Family.MULTI_SINK: fixtures.multi_sink,
    Family.PEDESTAL_SINK: fixtures.pedestal_sink,
    Family.TUB: fixtures.tub,
    Family.TOILET: fixtures.toilet,
    Family.SHOWER_STALL: fixtures.shower_stall,
    Family.COOKTOP: fixtures.cooktop,
    Family.GRILL: fixtures.grill,
    Family.COFFEE_MACHINE: fixtures.coffee_machine,
    Family.DOOR: fixtures.door,
    Family.SLIDING_DOOR: fixtures.sliding_door,
    Family.GARAGE_DOOR: fixtures.garage_door,
    Family.WINDOW: fixtures.window,
    Family.LAPTOP: fixtures.laptop,
    Family.SCREEN: fixtures.screen,
    Family.PLANT: fixtures.plant,
    Family.TREE: fixtures.tree,
    Family.CAR: fixtures.car,
    Family.CLOTH: goods.cloth,
    Family.BREAD: goods.bread,
    Family.CAKE_SLICE: goods.slice_of_cake,
    Family.BAR: goods.bar,
    Family.HEAP: goods.heap,
    Family.TENT: goods.tent,
    Family.HOOP: goods.hoop,
    Family.FIGURE: goods.figure,
    Family.DUMBBELL: goods.dumbbell,
    Family.POST: structures.post,
    Family.PENDANT: structures.pendant,
    Family.FENCE: structures.fence,
    Family.CANOPY: structures.canopy,
    Family.BARS: structures.bars,
    Family.RUNGS: structures.rungs,
    Family.STALL: structures.stall,
    Family.STAIRCASE: structures.staircase,
    Family.LADDER: structures.ladder,
    Family.TREADMILL: structures.treadmill,
    Family.LORRY: structures.lorry,
    Family.CYCLE: structures.cycle,
    Family.RANGE_HOOD: structures.range_hood,
    Family.URINAL: structures.urinal,
    Family.SHOWER_RAIL: structures.shower_rail,
    Family.WORKSTATION: structures.workstation,
    Family.TELEPHONE: structures.telephone,
    Family.MICROSCOPE: structures.microscope,
    Family.WHEELED_BOARD: structures.wheeled_board,
}
