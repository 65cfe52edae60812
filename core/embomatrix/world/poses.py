"""The pre-cached language-physics interface as data: verified terminal poses, found offline, carried in the bundle."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.world.geometry import Pose
    from embomatrix.world.state import Relation


@dataclass(frozen=True, slots=True)
class StandPose:
    """Where the robot's base may stand to work on an object: world x, y, heading."""

    x_m: float
    y_m: float
    yaw: float


@dataclass(frozen=True, slots=True)
class PlacementKey:
    """A set of poses serves every object of the asset, on every support of that asset, by that relation."""

    asset_id: str
    support_asset_id: str
    relation: Relation


class Handling(StrEnum):
    """What the hand does to an object where it stands."""

    TAKE = "take"
    OPEN = "open"
    CLOSE = "close"
    PRESS = "press"


@dataclass(frozen=True)
class PoseCache:
    """``placements``: poses of the placed asset in the *support's* asset frame, each verified by settling in physics.
    ``stands``: standing poses per object name, in the world, best first.
    ``barred``: by object name what bars the arm's way where there is none, in the scene as it was loaded.
    ``reached``: by relation, by what is held and by its target, the number of a pose that the arm was seen to get at, of the
    set of ``placements`` that is looked at first. ``barred_places``: in the same way what bars the arm's way to all of them.
    """

    placements: Mapping[PlacementKey, tuple[Pose, ...]] = field(default_factory=dict)
    stands: Mapping[str, tuple[StandPose, ...]] = field(default_factory=dict)
    barred: Mapping[Handling, Mapping[str, str]] = field(default_factory=dict)
    reached: Mapping[Relation, Mapping[str, Mapping[str, int]]] = field(default_factory=dict)
    barred_places: Mapping[Relation, Mapping[str, Mapping[str, str]]] = field(default_factory=dict)
