"""The robot's hand: what it holds is out of the world, and what lies in that comes along."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.world.geometry import Pose


class Hand:
    """Holds one object, with its contents at rest in it. Empty at first."""

    def __init__(self, engine: PhysicsEngine) -> None:
        self._engine = engine
        self._pose_held_item: Mapping[str, Pose] = {}
        self.carried: tuple[str, ...] = ()
        """What the hand holds, then what lies in it; empty for an empty hand."""

    @property
    def offsets(self) -> Mapping[str, Pose]:
        """Poses of what the hand holds, and of what lies in it, in the frame of what it holds."""
        return self._pose_held_item

    def forget(self) -> None:
        """Be empty again, without putting anything anywhere: for a world that was reset."""
        self._hold({})

    def take(self, group: Sequence[str]) -> None:
        """Take the first object of the group, with the others in it."""
        back = self._engine.pose(group[0]).inverse()
        self._hold({item: back @ self._engine.pose(item) for item in group})
        for item in group:
            self._engine.park(item)

    def let_go(self, pose: Pose) -> bool:
        """Stand what is held at a pose, with what lies in it. False, and nothing changed, when the contents do not fit."""
        held, *contents = self.carried
        for item in contents:
            self._engine.set_pose(item, pose @ self._pose_held_item[item])
        # Set as it was found, not multiplied by its own identity: the placer's pose holds to the last bit.
        self._engine.set_pose(held, pose)
        group = frozenset(self.carried)
        if any(self._engine.penetrates(item, ignore=group) for item in contents):
            for item in group:
                self._engine.park(item)
            return False
        self._hold({})
        return True

    def _hold(self, offsets: Mapping[str, Pose]) -> None:
        self._pose_held_item, self.carried = offsets, tuple(offsets)
