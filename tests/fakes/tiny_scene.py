"""Kitchen with a fridge and an apple, small enough to break in every place."""

import math

from embomatrix.world.asset import Asset, Interior, Joint, JointKind, Link, SupportSurface
from embomatrix.world.bundle import Bundle
from embomatrix.world.geometry import ConvexPart, Pose, Shape
from embomatrix.world.goal import Atom
from embomatrix.world.poses import PlacementKey, PoseCache, StandPose
from embomatrix.world.scene import Doorway, RobotStart, Room, Scene, SceneObject
from embomatrix.world.state import Relation, State
from embomatrix.world.task import Task, TaskCategory


def box(size: tuple[float, float, float], x: float = 0.0) -> ConvexPart:
    return ConvexPart(Shape.BOX, Pose((x, 0.0, 0.0)), size)


FRIDGE = Asset(
    asset_id="fridge-abc",
    category="fridge",
    synset="electric_refrigerator.n.01",
    size_m=(0.7, 0.8, 1.7),
    mass_kg=80.0,
    links=(
        Link("base", (box((0.6, 0.8, 0.02)), box((0.02, 0.8, 1.7), -0.3))),
        Link(
            "door",
            (box((0.03, 0.8, 1.7), 0.34),),
            Joint(JointKind.REVOLUTE, (0.34, 0.4, 0.0), (0.0, 0.0, 1.0), 1.7),
        ),
    ),
    supports=(SupportSurface("floor", (0.0, 0.0, -0.8), (0.5, 0.7), 1.5, "cavity"),),
    interiors=(Interior("cavity", (0.0, 0.0, 0.0), (0.5, 0.7, 1.5), ("door",)),),
    abilities={"coldSource": {"temperature": -18.0, "requires_inside": 1.0}, "openable": {}},
)
APPLE = Asset(
    "apple-red",
    "apple",
    "apple.n.01",
    (0.07, 0.07, 0.07),
    0.2,
    (Link("base", (ConvexPart(Shape.SPHERE, Pose((0.0, 0.0, 0.0)), (0.07, 0.07, 0.07)),)),),
    abilities={"freezable": {}},
)


def tiny_scene() -> Scene:
    """Return a kitchen with a fridge and an apple in it, and a corridor."""
    half = math.sqrt(0.5)
    return Scene(
        scene_id="tiny-1",
        base="tiny",
        seed=7,
        rooms=(
            Room("kitchen_0", "kitchen", (0.0, 0.0), (4.0, 3.0)),
            Room("corridor_0", "corridor", (4.1, 0.0), (6.0, 3.0)),
        ),
        walls=(ConvexPart(Shape.BOX, Pose((4.05, 0.5, 1.2)), (0.1, 1.0, 2.4)),),
        doorways=(Doorway(("kitchen_0", "corridor_0"), (4.05, 1.5), 1.0, 2.1, "y"),),
        objects=(
            SceneObject(
                "fridge_1",
                "fridge-abc",
                "kitchen_0",
                Pose((1.0, 2.5, 0.85), (0.0, 0.0, half, half)),
                True,
                joints=(0.25,),
                states=frozenset({State.TOGGLED_ON}),
            ),
            SceneObject(
                "apple_1",
                "apple-red",
                "kitchen_0",
                Pose((1.0, 2.5, 0.1)),
                False,
                host="fridge_1",
                relation=Relation.INSIDE,
            ),
        ),
        assets={"apple-red": APPLE, "fridge-abc": FRIDGE},
        robot=RobotStart(5.0, 1.0, 0.3, "corridor_0"),
        left_out=("no place for rug_1",),
    )


def tiny_task() -> Task:
    """Return the task to open the fridge."""
    return Task(
        task_id="tiny-1-open",
        scene_id="tiny-1",
        instruction="Open the fridge.",
        category=TaskCategory.APPLIANCE_USE,
        goal=Atom("open", ("fridge_1",)),
        goal_bddl="(open fridge_1)",
        table=("apple_1", "fridge_1"),
        types={"apple.n.01": ("apple_1",)},
    )


def tiny_bundle() -> Bundle:
    """Return the kitchen with its task, one verified pose and one standing pose."""
    task = tiny_task()
    poses = PoseCache(
        {PlacementKey("apple-red", "fridge-abc", Relation.INSIDE): (Pose((0.1, 0.0, -0.76)),)},
        {"fridge_1": (StandPose(1.0, 1.2, 1.57),)},
    )
    return Bundle(tiny_scene(), {task.task_id: task}, poses)
