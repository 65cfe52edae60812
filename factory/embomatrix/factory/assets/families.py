"""Families of geometry: fixed proportions that are scaled to the size of a catalog model."""

import functools
from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import Self

from embomatrix.factory.assets import (
    cabinets,
    corners,
    fixtures,
    furniture,
    goods,
    shapes,
    structures,
    vessels,
)
from embomatrix.factory.assets.body import Body, Proportions, proportioned
from embomatrix.world.geometry import Aabb, ConvexPart, Vec3

Generator = Callable[[Vec3], Body]


def _boxes(rows: Sequence[Proportions]) -> Generator:
    return lambda size_m: Body(parts=proportioned(size_m, rows))


def _cabinet(style: cabinets.CabinetStyle) -> Generator:
    return functools.partial(cabinets.cabinet, style=style)


def _vessel(style: vessels.VesselStyle) -> Generator:
    return functools.partial(vessels.vessel, style=style)


def _filled(shape: Callable[[Aabb], ConvexPart]) -> Generator:
    return functools.partial(goods.filled, shape=shape)


class Family(StrEnum):
    """Kind of geometry. ``build`` makes the body of a model from its size in metres."""

    build: Generator

    def __new__(cls, value: str, build: Generator) -> Self:
        member = str.__new__(cls, value)
        member._value_ = value
        member.build = build
        return member

    CUPBOARD = "cupboard", _cabinet(cabinets.CUPBOARD)
    DRAWER_CUPBOARD = "drawer_cupboard", _cabinet(cabinets.DRAWER_CUPBOARD)
    CHEST_OF_DRAWERS = "chest_of_drawers", _cabinet(cabinets.CHEST_OF_DRAWERS)
    WALL_CUPBOARD = "wall_cupboard", _cabinet(cabinets.WALL_CUPBOARD)
    LOCKER = "locker", _cabinet(cabinets.LOCKER)
    FRIDGE = "fridge", _cabinet(cabinets.FRIDGE)
    FREEZER = "freezer", _cabinet(cabinets.FREEZER)
    MICROWAVE = "microwave", _cabinet(cabinets.MICROWAVE)
    OVEN = "oven", _cabinet(cabinets.OVEN)
    DISHWASHER = "dishwasher", _cabinet(cabinets.DISHWASHER)
    WASHER = "washer", _cabinet(cabinets.WASHER)
    SHELVING = "shelving", cabinets.shelving
    CUBBY = "cubby", _cabinet(cabinets.CUBBY)
    DRAWER_CUBBY = "drawer_cubby", _cabinet(cabinets.DRAWER_CUBBY)
    WARDROBE = "wardrobe", _cabinet(cabinets.WARDROBE)
    CHEST = "chest", cabinets.chest
    OPEN_BOX = "open_box", cabinets.open_box
    TRAY = "tray", cabinets.tray
    TABLE = "table", furniture.table
    DRAWER_TABLE = "drawer_table", furniture.drawer_table
    DESK = "desk", furniture.desk
    DRAWER_DESK = "drawer_desk", furniture.drawer_desk
    SHELF_TABLE = "shelf_table", furniture.table_with_shelf
    PEDESTAL_TABLE = "pedestal_table", furniture.pedestal_table
    COUNTER = "counter", furniture.counter
    CHAIR = "chair", furniture.chair
    SWIVEL_CHAIR = "swivel_chair", furniture.swivel_chair
    STOOL = "stool", furniture.stool
    SOFA = "sofa", furniture.sofa
    CORNER_SOFA = "corner_sofa", corners.corner_sofa
    CORNER_BENCH = "corner_bench", corners.corner_bench
    CORNER_BAR = "corner_bar", corners.corner_bar
    CORNER_WORKTOP = "corner_worktop", corners.corner_worktop
    BED = "bed", furniture.bed
    BUNK_BED = "bunk_bed", furniture.bunk_bed
    LAMP = "lamp", furniture.lamp
    SLAB = "slab", furniture.slab
    BLOCK = "block", furniture.block
    ROUND = "round", _vessel(vessels.OPEN_ROUND)
    CUP = "cup", _vessel(vessels.CUP)
    GOBLET = "goblet", _vessel(vessels.GOBLET)
    PAN = "pan", _vessel(vessels.PAN)
    POT = "pot", _vessel(vessels.POT)
    LIDDED_VESSEL = "lidded_vessel", vessels.lidded_vessel
    BLENDER = "blender", vessels.blender
    PLATE = "plate", vessels.plate
    BOTTLE = "bottle", vessels.bottle
    CAN = "can", vessels.can
    ROUND_FOOD = "round_food", goods.round_food
    HALF_FOOD = "half_food", goods.half_food
    DISC = "disc", goods.disc
    SOFT = "soft", goods.soft
    UTENSIL = "utensil", goods.utensil
    SINK = "sink", fixtures.furniture_sink
    MULTI_SINK = "multi_sink", fixtures.multi_sink
    PEDESTAL_SINK = "pedestal_sink", fixtures.pedestal_sink
    TUB = "tub", fixtures.tub
    TOILET = "toilet", fixtures.toilet
    SHOWER_STALL = "shower_stall", fixtures.shower_stall
    COOKTOP = "cooktop", fixtures.cooktop
    GRILL = "grill", fixtures.grill
    COFFEE_MACHINE = "coffee_machine", fixtures.coffee_machine
    DOOR = "door", fixtures.door
    SLIDING_DOOR = "sliding_door", fixtures.sliding_door
    GARAGE_DOOR = "garage_door", fixtures.garage_door
    WINDOW = "window", fixtures.window
    LAPTOP = "laptop", fixtures.laptop
    SCREEN = "screen", fixtures.screen
    MIRROR = "mirror", fixtures.mirror
    PLANT = "plant", fixtures.plant
    TREE = "tree", fixtures.tree
    CAR = "car", fixtures.car
    CLOTH = "cloth", goods.cloth
    BREAD = "bread", _filled(shapes.loaf)
    CAKE_SLICE = "cake_slice", _filled(shapes.wedge)
    BAR = "bar", _filled(shapes.log)
    HEAP = "heap", _filled(shapes.dome)
    TENT = "tent", _filled(shapes.ridge)
    HOOP = "hoop", goods.hoop
    FIGURE = "figure", _boxes(goods.FIGURE)
    DUMBBELL = "dumbbell", _boxes(goods.DUMBBELL)
    POST = "post", structures.post
    PENDANT = "pendant", structures.pendant
    FENCE = "fence", structures.fence
    CANOPY = "canopy", structures.canopy
    BARS = "bars", structures.bars
    RUNGS = "rungs", structures.rungs
    STALL = "stall", structures.stall
    STAIRCASE = "staircase", structures.staircase
    TIERS = "tiers", structures.tiers
    LADDER = "ladder", structures.ladder
    TREADMILL = "treadmill", structures.treadmill
    LORRY = "lorry", structures.lorry
    CYCLE = "cycle", _boxes(structures.CYCLE)
    RANGE_HOOD = "range_hood", _boxes(structures.RANGE_HOOD)
    URINAL = "urinal", structures.urinal
    SHOWER_RAIL = "shower_rail", _boxes(structures.SHOWER_RAIL)
    WORKSTATION = "workstation", structures.workstation
    TELEPHONE = "telephone", _boxes(structures.TELEPHONE)
    MICROSCOPE = "microscope", structures.microscope
    WHEELED_BOARD = "wheeled_board", structures.wheeled_board
