"""Warm-up scene that the simulator's root loads and executes in before it forks.

Patterns are compiled, libraries initialise, and the interpreter specialises its bytecode. Forks share the result: without the
warm-up, loading a kitchen takes 18 ms instead of 11. Doors, hulls and states in this scene would not shorten it further.
"""

from typing import Final

from embomatrix.skills.parse import parse_plan
from embomatrix.skills.syntax import Plan
from embomatrix.world.asset import Asset, Link, SupportSurface
from embomatrix.world.bundle import Bundle
from embomatrix.world.evaluate import render
from embomatrix.world.geometry import IDENTITY, ConvexPart, Pose, Shape
from embomatrix.world.goal import Atom
from embomatrix.world.poses import PoseCache, StandPose
from embomatrix.world.scene import Doorway, RobotStart, Room, Scene, SceneObject
from embomatrix.world.state import Relation
from embomatrix.world.task import Task, TaskCategory

WARM_UP: Final = "warm-up"
"""Name of the scene and of its task."""
TIMES: Final = 10
"""Executions of the plan: the interpreter specialises bytecode after eight."""
PLAN: Final[Plan] = parse_plan("move 1\npick_up 1\nmove 0\nplace 0 ontop")


def warm_up_bundle() -> Bundle:
    """Build a room with a ball on a table, and a task about both."""
    table, ball = _table(), _ball()
    scene = Scene(
        scene_id=WARM_UP,
        base=WARM_UP,
        seed=0,
        rooms=(Room("room_0", "room", (0.0, 0.0), (4.0, 4.0)),),
        walls=(),
        doorways=(Doorway(("room_0", ""), (2.0, 4.05), 0.9, 2.0, "x"),),
        objects=(
            SceneObject("table_1", "table-a", "room_0", Pose((2.0, 2.0, 0.35)), True),
            SceneObject(
                "ball_1", "ball-a", "room_0", Pose((1.8, 2.0, 0.74)), False, (), "table_1", Relation.ONTOP
            ),
        ),
        assets={asset.asset_id: asset for asset in (table, ball)},
        robot=RobotStart(1.0, 3.0, 0.0, "room_0"),
    )
    # Without a verified pose, `place` searches and settles: a slot that never did has 0.2 MB more private memory.
    poses = PoseCache({}, {"table_1": (StandPose(1.0, 2.0, 0.0),)})
    return Bundle(scene, {WARM_UP: _task(scene)}, poses)


def _task(scene: Scene) -> Task:
    names = tuple(item.name for item in scene.objects)
    goal = Atom("ontop", ("ball_1", "table_1"))
    types = {"ball.n.01": ("ball_1",), "table.n.02": ("table_1",)}
    category = TaskCategory.PICK_AND_PLACE
    return Task(WARM_UP, scene.scene_id, "Tidy up.", category, goal, render(goal), names, types, "embomatrix")


def _table() -> Asset:
    size = (0.8, 1.0, 0.7)
    top = SupportSurface("top", (0.0, 0.0, 0.35), (0.8, 1.0), 1.0)
    board = ConvexPart(Shape.BOX, Pose((0.0, 0.0, 0.325)), (0.8, 1.0, 0.05))
    leg = ConvexPart(Shape.BOX, Pose((0.0, 0.0, -0.025)), (0.1, 0.1, 0.65))
    return Asset("table-a", "table", "table.n.02", size, 20.0, (Link("base", (board, leg)),), (top,))


def _ball() -> Asset:
    part = ConvexPart(Shape.SPHERE, IDENTITY, (0.08, 0.08, 0.08))
    return Asset("ball-a", "ball", "ball.n.01", (0.08, 0.08, 0.08), 0.1, (Link("base", (part,)),))
