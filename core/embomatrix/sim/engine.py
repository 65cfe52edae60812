"""Interface of a physics engine: one loaded scene, queried and changed by object name.

Poses are those of the object's asset frame in the world, in metres. An engine never steps its scene: objects move only by
explicit calls, and ``settle`` simulates a copy of the object's surroundings. The state is exactly what was set.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

if TYPE_CHECKING:
    from embomatrix.world.geometry import Aabb, Pose, Vec3
    from embomatrix.world.scene import Scene

WALL: Final = "wall"
FLOOR: Final = "floor"
BACKGROUND: Final = "background"
"""Names that ``penetrates`` returns for walls, floor and background objects; no scene object has them."""
TOLERANCE_M: Final = 0.001
"""Bodies that overlap by less than this touch; beyond it they penetrate."""
SETTLE_STEPS: Final = 48
"""Steps of 1/240 s after which an object that is not at rest counts as unstable."""
MAX_MOVED_M: Final = 0.01
MAX_TILT_RAD: Final = 0.1745
"""A placement is stable if the object settles within 1 cm and 10 degrees of its start."""
NOTHING: Final[frozenset[str]] = frozenset()


class EngineError(Exception):
    """Invalid scene, unknown name or value that physics can't take. The message names the remedy."""


class EngineMissingError(EngineError):
    """No physics engine is installed."""


@dataclass(frozen=True, slots=True)
class BodyPlace:
    """Place of one object: its pose, its joints, its box, and whether it is in the world."""

    pose: Pose
    fractions: tuple[float, ...]
    present: bool
    box: Aabb


EngineMark = Mapping[str, BodyPlace]
"""Objects that differ from the scene as loaded, or once did since the last reset, in an engine's state."""


@dataclass(frozen=True, slots=True)
class Settled:
    """Final pose of an object after it was let go.

    ``moved_m`` and ``tilt_rad`` compare ``pose`` with the start; ``at_rest`` is False if the object still moved at the end.
    """

    pose: Pose
    moved_m: float
    tilt_rad: float
    at_rest: bool

    @property
    def stable(self) -> bool:
        return self.at_rest and self.moved_m < MAX_MOVED_M and self.tilt_rad < MAX_TILT_RAD


class Journal:
    """Changes in an engine since it was loaded or reset, for caches that depend on its state."""

    def __init__(self) -> None:
        self.rounds = 0
        """Number of resets; each one clears the entries."""
        self.entries: list[tuple[str, Aabb | None]] = []
        """Objects that were moved, parked or brought back, each with its box before the change; None if it was parked."""

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

        Objects that the scene marks absent are parked.
        """

    def mark(self) -> EngineMark:
        """Return the state for ``return_to``, in time proportional to the number of changed objects."""

    def return_to(self, mark: EngineMark) -> None:
        """Take on a state of this engine, bit-equal. The journal lists the objects that this changes."""

    def pose(self, name: str) -> Pose:
        """Pose of the object's asset frame in the world; the last one for a parked object."""

    def set_pose(self, name: str, pose: Pose) -> None:
        """Teleport the object; a parked object returns to the world."""

    def aabb(self, name: str) -> Aabb:
        """Bounding box in the world at the current joint positions."""

    def joints(self, name: str) -> tuple[float, ...]:
        """Joint positions as shares of their travel: 0 closed, 1 open, in the order of the asset's joints."""

    def set_joints(self, name: str, fractions: Sequence[float]) -> None:
        """Set every joint of the object. Raises EngineError for a wrong count or a value outside 0..1."""

    def park(self, name: str) -> None:
        """Take the object out of the world, as in the robot's hand: it collides with nothing and has no relations."""

    def is_parked(self, name: str) -> bool: ...

    def penetrates(self, name: str, margin_m: float = 0.0, ignore: frozenset[str] = NOTHING) -> str:
        """Name of one body that the object, grown by ``margin_m``, penetrates by more than 1 mm; "" for none.

        ``FLOOR``, ``WALL`` and ``BACKGROUND`` come first, then objects in scene order.
        """

    def near(self, box: Aabb, ignore: frozenset[str] = NOTHING) -> tuple[str, ...]:
        """Objects whose bounding boxes overlap the box, in scene order; parked ones are left out."""

    def first_met(self, start_m: Vec3, ends_m: Sequence[Vec3]) -> tuple[str, ...]:
        """Name of the first body on the straight way from a point to each other point; "" for none.

        ``WALL`` and ``BACKGROUND`` are names too. The floor and parked objects are never met.
        """

    def is_at_static(self, box: Aabb) -> bool:
        """Return True if the bounding box of a wall or of a background object overlaps the box."""

    def gap(self, a: str, b: str, limit_m: float) -> float | None:
        """Smallest signed distance between two objects (negative: depth); None beyond ``limit_m``.

        Raises EngineError for a parked object.
        """

    def settle(self, name: str, steps: int = SETTLE_STEPS, ignore: frozenset[str] = NOTHING) -> Settled:
        """Simulate the fall of an object in a copy of its surroundings, in which all else is static.

        The engine's state does not change. The result depends on the present state only.
        """

    def state_bytes(self) -> bytes:
        """Poses, joints and parking of all objects that differ from the scene, for the digest of a trace."""

    def close(self) -> None:
        """Free the physics client and end the engine's use."""
