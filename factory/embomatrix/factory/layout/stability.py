"""Whether objects stay where they were put, and whether the robot gets at them there: asked of the runtime that executes plans.

Rest is proved by geometry where it can be, else the thing is let go in physics.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.factory.scenes.rehearsal import SimulatedRobot
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.floor.navigation import Navigator
from embomatrix.sim.geometry.statics import base_of, is_level, rest_pose
from embomatrix.sim.state.relations import Relations
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from embomatrix.factory.scenes.editor import SceneEditor
    from embomatrix.world.geometry import Pose

    AlternativePoses = Callable[[str], Iterable[Pose]]
    """Other free poses for an object at what it is on, in or under."""


HIGH_M: Final = 2.0
"""Nobody asks the robot to get at what hangs higher."""
NO_STAND: Final = "the robot can stand nowhere with a clear way for its arm"
CANNOT_TAKE_OUT: Final = "the robot opens what it lies in, and can't take it out"


@dataclass(frozen=True, slots=True)
class StabilityReport:
    """What came of objects that were put down.

    ``dropped`` counts those that had to be let go; ``unstable`` tells in words what is wrong with those that don't stay,
    ``unreached`` what with those that the robot can't get at.
    """

    dropped: int
    unstable: Mapping[str, str]
    unreached: Mapping[str, str]


def settle(
    editor: SceneEditor, names: Sequence[str], elsewhere: AlternativePoses = lambda _: ()
) -> StabilityReport:
    """Find where objects come to rest, and move them there; tell which don't stay, and which the robot doesn't get at.

    What moves less than 1 cm and tilts less than 10 degrees stays. A thing that no standing robot gets at is first tried
    ``elsewhere``. Hosts stand before what rests on them. Raises EngineError where the engine is missing.
    """
    if not names:
        return StabilityReport(0, {}, {})
    loose = {name for name in names if not editor.known(name).fixed and not is_provably_stable(editor, name)}
    rested: dict[str, Pose] = {}
    unstable: dict[str, str] = {}
    with contextlib.closing(BulletEngine(editor.freeze(editor.base.scene_id))) as engine:
        hands = _ReachProbe(engine)
        unreached: dict[str, str] = {}
        for name in [name for name in names if editor.box_of(name).low_m[2] < HIGH_M]:
            if not hands.reach(name):
                if hands.place(name, elsewhere(name)):
                    loose.add(name)
                else:
                    unreached[name] = NO_STAND
        for name in [name for name in names if name in loose]:
            settled = engine.settle(name)
            if settled.stable:
                engine.set_pose(name, settled.pose)
                rested[name] = settled.pose
            else:
                unstable[name] = f"let go, it moves by {settled.moved_m:.3f} m: try a flatter place"
        unstable |= _resting_on_others(
            editor, Relations(engine), [name for name in names if name not in unstable]
        )
    editor.move(rested)
    shut_in = [name for name in names if name not in unstable.keys() | unreached.keys()]
    unreached |= dict.fromkeys(_untakeable(editor, shut_in), CANNOT_TAKE_OUT)
    return StabilityReport(len(loose), unstable, unreached)


def _resting_on_others(editor: SceneEditor, relations: Relations, names: Sequence[str]) -> dict[str, str]:
    """Those of some objects that lie on another loose thing than they are to be on, with the sentence against it.

    What is packed into a basket comes to lie on what is in there already, which nobody could then take out.
    """
    found = {}
    for name in names:
        host = relations.host_of(name)
        if host is None or host.name == editor.known(name).host or editor.known(host.name).fixed:
            continue
        found[name] = f"it comes to lie on {host.name}: try a place beside it"
    return found


class _ReachProbe:
    """Where the robot could stand to work on objects, in an engine whose objects are being moved."""

    def __init__(self, engine: BulletEngine) -> None:
        self._engine = engine
        self._navigator = Navigator(engine, Relations(engine))

    def reach(self, name: str) -> bool:
        return bool(self._navigator.stands_past_shut(name, self._navigator.start))

    def place(self, name: str, poses: Iterable[Pose]) -> bool:
        """Leave a thing at the first of some poses at which it is reached; False, and where it was, without one."""
        before = self._engine.pose(name)
        for pose in poses:
            self._move(name, pose)
            if self.reach(name):
                return True
        self._move(name, before)
        return False

    def _move(self, name: str, pose: Pose) -> None:
        self._engine.set_pose(name, pose)
        self._navigator.refresh()


def _untakeable(editor: SceneEditor, names: Sequence[str]) -> tuple[str, ...]:
    """Those of some objects behind doors that the robot fails to fetch in the simulator: an open leaf takes floor."""
    bearing = {item.host for item in editor.objects.values()}
    behind = [
        name
        for name in names
        if name not in bearing and not editor.known(name).fixed and _is_shut_in(editor, name)
    ]
    if not behind:
        return ()
    with SimulatedRobot(editor.freeze(editor.base.scene_id)) as rehearsal:
        return tuple(name for name in behind if not rehearsal.fetches(name))


def _is_shut_in(editor: SceneEditor, name: str) -> bool:
    """Whether an object, or what it rests on or in, lies in something with doors."""
    item = editor.known(name)
    while item.host:
        if item.relation is Relation.INSIDE and any(
            i.closed_by for i in editor.asset_of(item.host).interiors
        ):
            return True
        item = editor.known(item.host)
    return False


def is_provably_stable(editor: SceneEditor, name: str) -> bool:
    """Whether geometry alone tells that an object rests where it is."""
    item, asset = editor.known(name), editor.asset_of(name)
    base = base_of(asset)
    if base is None:
        return False
    if not item.host:
        return is_level(item.pose_world_asset)
    host = editor.known(item.host)
    local = host.pose_world_asset.inverse() @ item.pose_world_asset
    return rest_pose(asset, base, local, editor.asset_of(item.host), host.joints) is not None
