"""Whether things stay where they were put: proved by geometry where it can be, else let go in physics."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.factory.layout.values import LayoutReason
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.pose_cache import standing_poses
from embomatrix.sim.statics import base_of, is_level, rest_pose

if TYPE_CHECKING:
    from collections.abc import Container, Mapping, Sequence

    from embomatrix.factory.editor import SceneEditor
    from embomatrix.world.geometry import Pose


HIGH_M: Final = 2.0
"""Nobody asks the robot to get at what hangs higher."""


@dataclass(frozen=True, slots=True)
class Settling:
    """How many things had to be let go, and what is wrong with those that can't be where they are: a reason, and words."""

    dropped: int
    wrong: Mapping[str, tuple[LayoutReason, str]]


def settle(editor: SceneEditor, names: Sequence[str], resigned: Container[str] = ()) -> Settling:
    """Find where objects come to rest, and move them there; tell which don't stay, and which no standing robot gets at.

    What moves less than 1 cm and tilts less than 10 degrees stays. Whether the robot gets at the ``resigned`` is not asked.
    Hosts stand before what rests on them. Raises EngineError where the engine is missing.
    """
    if not names:
        return Settling(0, {})
    loose = [name for name in names if not editor.known(name).fixed and not is_proved(editor, name)]
    rested: dict[str, Pose] = {}
    wrong: dict[str, tuple[LayoutReason, str]] = {}
    with contextlib.closing(BulletEngine(editor.freeze(editor.base.scene_id))) as engine:
        stands = standing_poses(engine, [name for name in names if editor.box_of(name).low_m[2] < HIGH_M])
        for name, poses in stands.items():
            if not poses and name not in resigned:
                wrong[name] = (
                    LayoutReason.NOT_AT_HAND,
                    "the robot can stand nowhere with a clear way for its arm",
                )
        for name in loose:
            settled = engine.settle(name)
            if settled.stable:
                engine.set_pose(name, settled.pose)
                rested[name] = settled.pose
            else:
                moved = f"let go, it moves by {settled.moved_m:.3f} m: try a flatter place"
                wrong[name] = (LayoutReason.UNSTABLE, moved)
    editor.move({name: pose for name, pose in rested.items() if name not in wrong})
    return Settling(len(loose), wrong)


def is_proved(editor: SceneEditor, name: str) -> bool:
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
