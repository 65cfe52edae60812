"""Whether things stay where they were put: proved by geometry where it can be, else let go in physics."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.statics import base_of, is_level, rest_pose

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from embomatrix.factory.editor import SceneEditor
    from embomatrix.world.geometry import Pose


@dataclass(frozen=True, slots=True)
class Settling:
    """How many things had to be let go, and those that did not stay, each with how far it moved, in words."""

    dropped: int
    unstable: Mapping[str, str]


def settle(editor: SceneEditor, names: Sequence[str]) -> Settling:
    """Find where objects come to rest, and move them there; what does not stay within 1 cm and 10 degrees is told.

    Hosts stand before what rests on them. Raises EngineError where the engine is missing.
    """
    loose = [name for name in names if not editor.known(name).fixed and not is_proved(editor, name)]
    if not loose:
        return Settling(0, {})
    rested: dict[str, Pose] = {}
    unstable: dict[str, str] = {}
    with contextlib.closing(BulletEngine(editor.freeze(editor.base.scene_id))) as engine:
        for name in loose:
            settled = engine.settle(name)
            if settled.stable:
                engine.set_pose(name, settled.pose)
                rested[name] = settled.pose
            else:
                unstable[name] = f"let go, it moves by {settled.moved_m:.3f} m: try a flatter place"
    editor.move(rested)
    return Settling(len(loose), unstable)


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
