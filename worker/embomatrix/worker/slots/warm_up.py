"""Warm-up scene that the simulator's root loads and executes in before it forks.

Patterns are compiled, libraries initialise, and the interpreter specialises its bytecode. Forks share the result: without the
warm-up, loading a scene takes a third longer.
"""

from typing import Final

from embomatrix.skills.parse import parse_plan
from embomatrix.skills.syntax import Plan
from embomatrix.world.asset import Asset, Interior, Joint, JointKind, Link, SupportSurface
from embomatrix.world.bundle import Bundle
from embomatrix.world.evaluate import render
from embomatrix.world.geometry import ConvexPart, Pose, Shape, Vec3
from embomatrix.world.goal import And, Atom, Not
from embomatrix.world.poses import PlacementKey, PoseCache, StandPose
from embomatrix.world.scene import Doorway, RobotStart, Room, Scene, SceneObject, Window
from embomatrix.world.state import Relation, State, SubstanceFact, SubstanceRelation
from embomatrix.world.task import Task, TaskCategory

WARM_UP: Final = "warm-up"
"""Name of the scene and of its task."""
TIMES: Final = 10
"""Executions of each plan: the interpreter specialises bytecode after eight."""
PLANS: Final[tuple[Plan, ...]] = tuple(
    map(
        parse_plan,
        (
            "move 2\npick_up 2\nmove 0\nplace 0 ontop",
            "move 1\nopen 1\nclose 1\nmove 3\npick_up 3\nmove 0\nplace 0 ontop",
        ),
    )
)


def warm_up_bundle() -> Bundle:
    """Build a room with a table, a cupboard with a door, a ball and a wedge, and a task over all of them."""
    table, cupboard, ball, wedge = _table(), _cupboard(), _ball(), _wedge()
    dust = SubstanceFact(SubstanceRelation.COVERED, "dust")
    objects = (
        SceneObject("table_1", "table-a", "room_0", Pose((2.0, 2.0, 0.35)), True),
        SceneObject("cupboard_1", "cupboard-a", "room_0", Pose((0.3, 1.0, 0.4)), True, (0.0,)),
        SceneObject(
            "ball_1", "ball-a", "room_0", Pose((1.8, 2.0, 0.74)), False, (), "table_1", Relation.ONTOP
        ),
        SceneObject(
            "wedge_1",
            "wedge-a",
            "room_0",
            Pose((2.2, 2.0, 0.75)),
            False,
            host="table_1",
            relation=Relation.ONTOP,
            states=frozenset({State.COOKED}),
            substances=frozenset({dust}),
        ),
    )
    scene = Scene(
        scene_id=WARM_UP,
        base=WARM_UP,
        seed=0,
        rooms=(Room("room_0", "room", (0.0, 0.0), (4.0, 4.0)),),
        walls=(_box((2.0, -0.05, 1.2), (4.0, 0.1, 2.4)), _box((-0.05, 2.0, 1.2), (0.1, 4.0, 2.4))),
        doorways=(Doorway(("room_0", ""), (2.0, 4.05), 0.9, 2.0, "x"),),
        objects=objects,
        assets={asset.asset_id: asset for asset in (table, cupboard, ball, wedge)},
        robot=RobotStart(1.0, 3.0, 0.0, "room_0"),
        windows=(Window(("room_0", ""), (4.05, 2.0), 1.0, 0.9, 2.0, "y"),),
    )
    on_table = PlacementKey("ball-a", "table-a", Relation.ONTOP)
    poses = PoseCache({on_table: (Pose((0.1, 0.2, 0.39)),)}, {"table_1": (StandPose(1.0, 2.0, 0.0),)})
    return Bundle(scene, {WARM_UP: _task(scene)}, poses)


def _task(scene: Scene) -> Task:
    names = tuple(item.name for item in scene.objects)
    goal = And((Atom("ontop", ("ball_1", "table_1")), Not(Atom("open", ("cupboard_1",)))))
    types = {"ball.n.01": ("ball_1",), "table.n.02": ("table_1",)}
    category = TaskCategory.PICK_AND_PLACE
    return Task(WARM_UP, scene.scene_id, "Tidy up.", category, goal, render(goal), names, types, "embomatrix")


def _table() -> Asset:
    size = (0.8, 1.0, 0.7)
    top = SupportSurface("top", (0.0, 0.0, 0.35), (0.8, 1.0), 1.0)
    parts = (_box((0.0, 0.0, 0.325), (0.8, 1.0, 0.05)), _box((0.0, 0.0, -0.025), (0.1, 0.1, 0.65)))
    return Asset("table-a", "table", "table.n.02", size, 20.0, (Link("base", parts),), (top,))


def _cupboard() -> Asset:
    """Build a cupboard whose front is a door that turns about its left edge."""
    back = _box((-0.23, 0.0, 0.0), (0.04, 0.6, 0.8))
    floor, top = _box((0.0, 0.0, -0.38), (0.42, 0.6, 0.04)), _box((0.0, 0.0, 0.38), (0.42, 0.6, 0.04))
    door = Link(
        "door",
        (_box((0.23, 0.0, 0.0), (0.04, 0.6, 0.72)),),
        Joint(JointKind.REVOLUTE, (0.25, 0.3, 0.0), (0.0, 0.0, 1.0), 1.5),
    )
    inside = Interior("inside", (0.0, 0.0, 0.0), (0.4, 0.56, 0.7), ("door",))
    board = SupportSurface("floor", (0.0, 0.0, -0.36), (0.4, 0.56), 0.7, "inside")
    return Asset(
        "cupboard-a",
        "cupboard",
        "cabinet.n.01",
        (0.5, 0.6, 0.8),
        30.0,
        (Link("base", (back, floor, top)), door),
        (board,),
        (inside,),
        {"openable": {}},
    )


def _ball() -> Asset:
    part = ConvexPart(Shape.SPHERE, Pose((0.0, 0.0, 0.0)), (0.08, 0.08, 0.08))
    return Asset("ball-a", "ball", "ball.n.01", (0.08, 0.08, 0.08), 0.1, (Link("base", (part,)),))


def _wedge() -> Asset:
    corners = ((-0.1, -0.1, -0.05), (0.1, -0.1, -0.05), (0.1, 0.1, -0.05), (-0.1, 0.1, -0.05))
    ridge = ((-0.1, 0.0, 0.05), (0.1, 0.0, 0.05))
    part = ConvexPart(Shape.HULL, Pose((0.0, 0.0, 0.0)), (0.2, 0.2, 0.1), (*corners, *ridge))
    return Asset("wedge-a", "wedge", "cake.n.03", (0.2, 0.2, 0.1), 0.3, (Link("base", (part,)),))


def _box(center: Vec3, size: Vec3) -> ConvexPart:
    return ConvexPart(Shape.BOX, Pose(center), size)
