"""What the rest of the simulator asks of a physics engine: one loaded scene, queried and changed by name.

All poses are those of the object's asset frame in the world, in metres. An engine never lets the world run: objects move
only when they are told to, and ``settle`` simulates a copy of the neighbourhood. So a state is what was set, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.world.geometry import Aabb, Pose
    from embomatrix.world.scene import Scene

WALL: Final = "wall"
FLOOR: Final = "floor"
"""Names under which ``penetrates`` reports the walls and the floor: no scene object bears them."""
TOLERANCE_M: Final = 0.001
"""Bodies that share less depth than this touch; more than this is penetration."""
SETTLE_STEPS: Final = 48
"""Steps of 1/240 s after which an object that is not at rest counts as unstable."""
MAX_MOVED_M: Final = 0.01
MAX_TILT_RAD: Final = 0.1745
"""A placement is stable when the object settles within 1 cm and 10 degrees of where it was put."""
NOTHING: Final[frozenset[str]] = frozenset()


class EngineError(Exception):
    """A scene that can't be loaded, an unknown name or a value that physics can't take. The sentence names the remedy."""


class EngineMissingError(EngineError):
    """No physics engine is installed."""


@dataclass(frozen=True, slots=True)
class Settled:
    """Where an object ends up when it is let go.

    ``moved_m`` and ``tilt_rad`` compare ``pose`` with the pose it was put at; ``at_rest`` tells whether it stopped in time.
    """

    pose: Pose
    moved_m: float
    tilt_rad: float
    at_rest: bool

    @property
    def stable(self) -> bool:
        return self.at_rest and self.moved_m < MAX_MOVED_M and self.tilt_rad < MAX_TILT_RAD


class Journal:
    """What changed in an engine since it was loaded or reset: for those who keep answers that depend on its state."""

    def __init__(self) -> None:
        self.rounds = 0
        """How often the engine was reset: with every round the entries begin anew."""
        self.entries: list[tuple[str, Aabb | None]] = []
        """Objects that were moved, parked or brought back, and the box that each had before; None: it was parked."""

    def begin_round(self) -> None:
        self.rounds += 1
        self.entries.clear()


class PhysicsEngine(Protocol):
    """One loaded scene. Unknown names and non-finite numbers raise EngineError before physics sees them."""

    @property
    def scene(self) -> Scene: ...

    @property
    def journal(self) -> Journal:
        """Every change since the last reset, in order. For reading only."""

    def reset(self) -> None:
        """Undo every change since loading: poses, joints and parking are bit-equal to the scene's.

        What the scene calls absent is parked.
        """

    def pose(self, name: str) -> Pose:
        """Pose of the object's asset frame in the world; of a parked object the last one that it had."""

    def set_pose(self, name: str, pose: Pose) -> None:
        """Teleport the object. One that was parked is back in the world."""

    def aabb(self, name: str) -> Aabb:
        """Bounding box in the world, with the joints as they are now."""

    def joints(self, name: str) -> tuple[float, ...]:
        """Joint positions as shares of their travel: 0 closed, 1 open, in the order of the asset's joints."""

    def set_joints(self, name: str, fractions: Sequence[float]) -> None:
        """Set every joint of the object. Raises EngineError for a wrong number of them or one outside 0..1."""

    def park(self, name: str) -> None:
        """Take the object out of the world: it collides with nothing and stands in no relation, as in the robot's hand."""

    def is_parked(self, name: str) -> bool: ...

    def penetrates(self, name: str, margin_m: float = 0.0, ignore: frozenset[str] = NOTHING) -> str:
        """Name of one body that the object, grown by ``margin_m``, penetrates by more than 1 mm; "" when there is none.

        The floor and the walls answer by ``FLOOR`` and ``WALL``; then objects in scene order.
        """

    def near(self, box: Aabb, ignore: frozenset[str] = NOTHING) -> tuple[str, ...]:
        """Objects whose bounding boxes overlap the box, in scene order, without the parked ones."""

    def is_at_wall(self, box: Aabb) -> bool:
        """Whether the bounding box of a wall overlaps the box."""

    def gap(self, a: str, b: str, limit_m: float) -> float | None:
        """Smallest signed distance between two objects (negative: depth), None when it is more than ``limit_m``.

        Raises EngineError when either is parked.
        """

    def settle(self, name: str, steps: int = SETTLE_STEPS, ignore: frozenset[str] = NOTHING) -> Settled:
        """Let go of the object where it is, in a copy of its neighbourhood in which all else stands still.

        Changes nothing here. Depends on the present state only, not on what was simulated before.
        """

    def state_bytes(self) -> bytes:
        """Poses, joints and parking of all objects in which they differ from the scene's, for the digest of a trace."""

    def close(self) -> None:
        """Free the physics client. The engine can't be used afterwards."""
