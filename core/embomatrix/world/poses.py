"""Pose cache: verified terminal poses of skills, found offline and carried in the bundle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from embomatrix.world.geometry import Pose


@dataclass(frozen=True, slots=True)
class StandPose:
    """Pose of the robot's base to work on an object: world x, y, heading."""

    x_m: float
    y_m: float
    yaw: float


@dataclass(frozen=True, slots=True)
class PlacementKey:
    """Key of a set of poses, which serves every object of the asset on every support of that asset, by that relation."""

    asset_id: str
    support_asset_id: str
    relation: Relation


class Handling(StrEnum):
    """Action of the hand on an object that stays in its place."""

    TAKE = "take"
    OPEN = "open"
    CLOSE = "close"
    PRESS = "press"


@dataclass(frozen=True)
class PoseCache:
    """Result of the offline analysis of a scene.

    ``placements``: poses of the placed asset in the *support's* asset frame, each verified by settling in physics. ``stands``:
    standing poses by object name, in the world, best first. ``arm_blockers``: the object that blocks the arm, by handling and
    target, for targets that the arm can't reach in the scene as loaded. ``reached``: by relation, held object and target, the
    index of a pose that the arm reached, in the first set of ``placements``. ``placing_blockers``: by the same keys, the object
    that blocks the arm from all poses.
    """

    placements: Mapping[PlacementKey, tuple[Pose, ...]] = field(default_factory=dict)
    stands: Mapping[str, tuple[StandPose, ...]] = field(default_factory=dict)
    arm_blockers: Mapping[Handling, Mapping[str, str]] = field(default_factory=dict)
    reached: Mapping[Relation, Mapping[str, Mapping[str, int]]] = field(default_factory=dict)
    placing_blockers: Mapping[Relation, Mapping[str, Mapping[str, str]]] = field(default_factory=dict)
