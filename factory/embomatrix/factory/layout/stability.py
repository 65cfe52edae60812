"""Stability and reachability of placed objects, tested with the runtime that executes plans.

Geometry proves stability if it can. Otherwise the object is dropped in physics.
"""

import contextlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from embomatrix.factory.scenes.editor import SceneEditor
from embomatrix.factory.scenes.feasibility import SimulatedRobot
from embomatrix.sim.bullet.client import shared_pool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.floor.navigation import Navigator
from embomatrix.sim.geometry.statics import base_of, is_level, rest_pose
from embomatrix.sim.state.relations import Relations
from embomatrix.world.geometry import Pose
from embomatrix.world.state import Relation

AlternativePoses = Callable[[str], Iterable[Pose]]
"""Other collision-free poses for an object at its host."""


HIGH_M: Final = 2.0
"""Objects above this height need not be reachable."""
NO_STAND: Final = "the robot finds no position from which its arm reaches it"
CANNOT_TAKE_OUT: Final = "the robot opens its container but can't take it out"


@dataclass(frozen=True, slots=True)
class StabilityReport:
    """Result of a stability check.

    ``unstable`` and ``unreached`` map object names to a sentence that states the problem.
    """

    unstable: Mapping[str, str]
    unreached: Mapping[str, str]


def settle(
    editor: SceneEditor, names: Sequence[str], alternatives: AlternativePoses = lambda _: ()
) -> StabilityReport:
    """Move objects to their resting poses. Report unstable objects and objects that the robot can't reach.

    An object is stable if it moves less than 1 cm and tilts less than 10 degrees. For an unreachable object, the
    poses of ``alternatives`` are tried first. ``names`` lists hosts before the objects on them. Raise EngineError if the
    engine is missing.
    """
    if not names:
        return StabilityReport({}, {})
    loose = {name for name in names if not editor.known(name).fixed and not is_provably_stable(editor, name)}
    rested: dict[str, Pose] = {}
    unstable: dict[str, str] = {}
    with contextlib.closing(
        BulletEngine(editor.freeze(editor.base.scene_id), shared_pool(), keeps_bounds=True)
    ) as engine:
        probe = _ReachProbe(engine)
        unreached: dict[str, str] = {}
        for name in [name for name in names if editor.box_of(name).low_m[2] < HIGH_M]:
            if not probe.reach(name):
                if probe.place(name, alternatives(name)):
                    loose.add(name)
                else:
                    unreached[name] = NO_STAND
        for name in [name for name in names if name in loose]:
            settled = engine.settle(name)
            if settled.stable:
                engine.set_pose(name, settled.pose)
                rested[name] = settled.pose
            else:
                unstable[name] = f"it moves by {settled.moved_m:.3f} m when dropped: try a flatter place"
        unstable |= _resting_on_others(
            editor, Relations(engine), [name for name in names if name not in unstable]
        )
    editor.move(rested)
    shut_in = [name for name in names if name not in unstable.keys() | unreached.keys()]
    unreached |= dict.fromkeys(_untakeable(editor, shut_in), CANNOT_TAKE_OUT)
    return StabilityReport(unstable, unreached)


def _resting_on_others(editor: SceneEditor, relations: Relations, names: Sequence[str]) -> dict[str, str]:
    """Return objects that came to rest on a loose object other than their host, with a sentence each.

    Objects packed into a basket can end up on one another. Nobody could then take out the lower one.
    """
    found = {}
    for name in names:
        host = relations.host_of(name)
        if host is None or host.name == editor.known(name).host or editor.known(host.name).fixed:
            continue
        found[name] = f"it comes to rest on {host.name}: try a place beside it"
    return found


class _ReachProbe:
    """Reachability test in an engine while objects are moved."""

    def __init__(self, engine: BulletEngine) -> None:
        self._engine = engine
        self._navigator = Navigator(engine, Relations(engine))

    def reach(self, name: str) -> bool:
        return bool(self._navigator.stands_past_shut(name, self._navigator.start))

    def place(self, name: str, poses: Iterable[Pose]) -> bool:
        """Leave an object at the first reachable pose. Otherwise restore its pose and return False."""
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
    """Return objects behind doors that the robot fails to take out in the simulator. An open door panel covers floor."""
    bearing = {item.host for item in editor.objects.values()}
    behind = [
        name
        for name in names
        if name not in bearing and not editor.known(name).fixed and _is_behind_door(editor, name)
    ]
    if not behind:
        return ()
    with SimulatedRobot(editor.freeze(editor.base.scene_id)) as robot:
        return tuple(name for name in behind if not robot.can_pick_up(name))


def _is_behind_door(editor: SceneEditor, name: str) -> bool:
    """True if an object, or any of its supports, is inside furniture with doors."""
    item = editor.known(name)
    while item.host:
        if item.relation is Relation.INSIDE and any(
            i.closed_by for i in editor.asset_of(item.host).interiors
        ):
            return True
        item = editor.known(item.host)
    return False


def is_provably_stable(editor: SceneEditor, name: str) -> bool:
    """True if geometry alone proves that an object is at rest."""
    item, asset = editor.known(name), editor.asset_of(name)
    base = base_of(asset)
    if base is None:
        return False
    if not item.host:
        return is_level(item.pose_world_asset)
    host = editor.known(item.host)
    local = host.pose_world_asset.inverse() @ item.pose_world_asset
    return rest_pose(asset, base, local, editor.asset_of(item.host), host.joints) is not None
