"""Flat of two rooms with one object for every skill.

Kitchen (0..5 x 0..4 m) and living room (5.1..9.1 x 0..4 m) are joined by a doorway at y = 2. The row of kitchen units
is along the wall y = 4 and faces -y. The shelf is at x = 9.1 and faces -x; the cabinet is at y = 0 and faces +y.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from tests.fakes import furniture as make
from tests.fakes.furniture import box

from embomatrix.world.evaluate import render
from embomatrix.world.geometry import Pose
from embomatrix.world.goal import And, Atom, Formula, Not
from embomatrix.world.scene import Doorway, RobotStart, Room, Scene, SceneObject
from embomatrix.world.state import Relation
from embomatrix.world.task import Task, TaskCategory

if TYPE_CHECKING:
    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import ConvexPart

WALL_HEIGHT_M = 2.4
WALL_M = 0.1
DOOR_M = 0.9
SOUTH, WEST, NORTH = -math.pi / 2, math.pi, math.pi / 2
"""Yaws of furniture whose front looks there."""


def walls() -> tuple[ConvexPart, ...]:
    """Return four outer walls, and one between the rooms with a doorway 0.9 m wide."""
    z, h, t = WALL_HEIGHT_M / 2, WALL_HEIGHT_M, WALL_M
    side = (4.0 - DOOR_M) / 2
    return (
        box((4.55, -t / 2, z), (9.3, t, h)),
        box((4.55, 4 + t / 2, z), (9.3, t, h)),
        box((-t / 2, 2, z), (t, 4, h)),
        box((9.1 + t / 2, 2, z), (t, 4, h)),
        box((5.05, side / 2, z), (t, side, h)),
        box((5.05, 4 - side / 2, z), (t, side, h)),
        box((5.05, 2, 2.2), (t, DOOR_M, 0.4)),
    )


def placed(
    name: str,
    asset: Asset,
    room: str,
    pose: Pose,
    *,
    fixed: bool = False,
    host: str = "",
    relation: Relation | None = None,
) -> SceneObject:
    """Return an object with all joints closed."""
    joints = (0.0,) * len(asset.joints)
    return SceneObject(name, asset.asset_id, room, pose, fixed, joints, host, relation)


def upright(x: float, y: float, bottom: float, asset: Asset, yaw: float = 0.0) -> Pose:
    """Return the pose at which the asset's underside is at height ``bottom``."""
    return Pose.from_xyz_yaw(x, y, bottom + asset.size_m[2] / 2, yaw)


def scene_of(scene_id: str, objects: list[tuple[SceneObject, Asset]]) -> Scene:
    """Return the flat with these objects."""
    return Scene(
        scene_id=scene_id,
        base="flat",
        seed=0,
        rooms=(
            Room("kitchen_0", "kitchen", (0.0, 0.0), (5.0, 4.0)),
            Room("living_room_0", "living_room", (5.1, 0.0), (9.1, 4.0)),
        ),
        walls=walls(),
        doorways=(Doorway(("kitchen_0", "living_room_0"), (5.05, 2.0), DOOR_M, 2.0, "y"),),
        objects=tuple(item for item, _ in objects),
        assets={asset.asset_id: asset for _, asset in objects},
        robot=RobotStart(3.5, 1.5, 0.0, "kitchen_0"),
    )


def kitchen_scene() -> Scene:
    """Return the whole flat: nine pieces of furniture, the microwave on the counter, and six small objects."""
    kitchen, living = "kitchen_0", "living_room_0"
    counter, board, low = make.counter(), make.kitchen_table(), make.coffee_table()
    fridge, stove, sink, microwave = make.fridge(), make.stove(), make.sink(), make.microwave()
    shelf, cabinet = make.shelf(), make.cabinet()
    bowl, apple, chicken, mug, lamp = (
        make.bowl(),
        make.apple(),
        make.chicken_leg(),
        make.mug(),
        make.table_lamp(),
    )
    fridge_floor = 0.85 + fridge.supports[3].center_m[2]
    shelf_board = 0.8 + shelf.supports[2].center_m[2]
    objects = [
        (placed("countertop_1", counter, kitchen, upright(2.2, 3.7, 0, counter, SOUTH), fixed=True), counter),
        (placed("fridge_1", fridge, kitchen, upright(0.6, 3.65, 0, fridge, SOUTH), fixed=True), fridge),
        (placed("stove_1", stove, kitchen, upright(3.4, 3.7, 0, stove, SOUTH), fixed=True), stove),
        (placed("sink_1", sink, kitchen, upright(4.3, 3.7, 0, sink, SOUTH), fixed=True), sink),
        (placed("breakfast_table_1", board, kitchen, upright(2.0, 1.3, 0, board), fixed=True), board),
        (placed("shelf_1", shelf, living, upright(8.95, 2.0, 0, shelf, WEST), fixed=True), shelf),
        (placed("cabinet_1", cabinet, living, upright(6.5, 0.225, 0, cabinet, NORTH), fixed=True), cabinet),
        (placed("coffee_table_1", low, living, upright(7.2, 2.5, 0, low), fixed=True), low),
        (
            placed(
                "microwave_1",
                microwave,
                kitchen,
                upright(2.6, 3.75, 0.9, microwave, SOUTH),
                fixed=True,
                host="countertop_1",
                relation=Relation.ONTOP,
            ),
            microwave,
        ),
        (_small("bowl_1", bowl, kitchen, (2.1, 1.0, 0.75), "breakfast_table_1"), bowl),
        (_small("apple_1", apple, kitchen, (1.9, 1.6, 0.75), "breakfast_table_1"), apple),
        (
            placed(
                "chicken_leg_1",
                chicken,
                kitchen,
                upright(0.6, 3.6, fridge_floor, chicken),
                host="fridge_1",
                relation=Relation.INSIDE,
            ),
            chicken,
        ),
        (_small("mug_1", mug, living, (8.95, 2.1, shelf_board), "shelf_1"), mug),
        (_small("table_lamp_1", lamp, living, (6.5, 0.225, 0.9), "cabinet_1"), lamp),
        (_small("apple_2", apple, living, (7.2, 2.3, 0.45), "coffee_table_1"), apple),
    ]
    return scene_of("flat_kitchen", objects)


def _small(name: str, asset: Asset, room: str, at: tuple[float, float, float], host: str) -> SceneObject:
    x, y, bottom = at
    return placed(name, asset, room, upright(x, y, bottom, asset), host=host, relation=Relation.ONTOP)


def kitchen_tasks(scene: Scene) -> tuple[Task, ...]:
    """Return four tasks in the kitchen scene, one per category, each solvable by at most ten calls."""
    table = tuple(item.name for item in scene.objects)
    goals: tuple[tuple[str, str, TaskCategory, Formula], ...] = (
        (
            "apple_to_counter",
            "Put the apple from the kitchen table on the counter, please.",
            TaskCategory.PICK_AND_PLACE,
            And((Atom("ontop", ("apple_1", "countertop_1")),)),
        ),
        (
            "light_and_air",
            "Turn on the lamp in the living room and leave the fridge open: I want to defrost it.",
            TaskCategory.APPLIANCE_USE,
            And((Atom("toggled_on", ("table_lamp_1",)), Atom("open", ("fridge_1",)))),
        ),
        (
            "cook_chicken",
            "Cook the chicken leg in the microwave and leave it in there.",
            TaskCategory.KITCHEN_OPERATION,
            And((Atom("cooked", ("chicken_leg_1",)), Atom("inside", ("chicken_leg_1", "microwave_1")))),
        ),
        (
            "tidy_up",
            "Put the mug on the coffee table and the apple into the fridge, and close the fridge.",
            TaskCategory.COMPOUND,
            And(
                (
                    Atom("ontop", ("mug_1", "coffee_table_1")),
                    Atom("inside", ("apple_1", "fridge_1")),
                    Not(Atom("open", ("fridge_1",))),
                )
            ),
        ),
    )
    types = {
        synset: tuple(item.name for item in scene.objects if scene.assets[item.asset_id].synset == synset)
        for synset in sorted({asset.synset for asset in scene.assets.values()})
    }
    return tuple(
        Task(task_id, scene.scene_id, words, category, goal, render(goal), table, types, "embomatrix")
        for task_id, words, category, goal in goals
    )
