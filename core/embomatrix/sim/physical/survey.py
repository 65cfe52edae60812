"""Looking ahead, offline: from which standing poses the arm gets at what is in a scene, and at what from none.

Cached mode does not look at the arm. So that it promises nothing which the physical robot can't do, ways of the arm are
looked for once, in the scene as it was loaded, by the same search by which physical mode finds them. Nothing is stepped.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.bullet.dynamic import DynamicWorld
from embomatrix.sim.geometry.bounds import IDENTITY
from embomatrix.sim.joints.panels import DoorPanels, swing_panels
from embomatrix.sim.joints.swings import SWING
from embomatrix.sim.physical.doors import STRETCHES, close_all, in_turn, leading, open_all
from embomatrix.sim.physical.fold import WAYS, approach
from embomatrix.sim.physical.hands import ways_to
from embomatrix.sim.physical.press import pressing
from embomatrix.sim.physical.prospects import Prospects
from embomatrix.sim.physical.stage import AROUND_M, PhysicalStage
from embomatrix.sim.physical.travel import SOMETHING
from embomatrix.sim.placing.pose_cache import Contents
from embomatrix.skills.limits import ROBOT
from embomatrix.world.poses import Handling, PoseCache

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from embomatrix.sim.live_world import LiveWorld
    from embomatrix.sim.physical.doors import Leaf
    from embomatrix.sim.physical.prospects import Placing
    from embomatrix.sim.physical.reach import ArmReach, Way
    from embomatrix.skills.view import SkillRefusal
    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import FloatArray
    from embomatrix.world.poses import StandPose

    Look = tuple[int | None, str]
    """Number of the first standing pose that will do, and what bars the way where none does."""

STANDS: Final = 2
"""Standing poses that are looked at: the robot steps aside to work, so that the others add little."""
TRIALS: Final[Mapping[Handling, Callable[[PhysicalStage, str], SkillRefusal | None]]] = {
    Handling.OPEN: open_all,
    Handling.CLOSE: close_all,
}
"""Handlings of doors."""
SEEN_M: Final = ROBOT.reach_m + AROUND_M
"""What is farther from a door has no part in whether the robot, within reach of it, can lead it."""


class Foresight:
    """Looks ahead in scenes. Doors among furniture that was seen before are not looked at again."""

    def __init__(self) -> None:
        self._known: dict[bytes, Look] = {}
        self._contents = Contents()

    def survey(self, world: LiveWorld, poses: PoseCache, names: Iterable[str]) -> PoseCache:
        """The cache with what the arm can do to these objects: stands from where it can first, and what bars all the others.

        ``world`` is at the start of its scene, and is left there. The answer follows from the arguments alone.
        """
        with _staged(world) as stage:
            surveyor = _Surveyor(stage, self._known, self._contents)
            return surveyor.surveyed(poses, tuple(dict.fromkeys(names)))


def prospects(world: LiveWorld, poses: PoseCache, placings: Iterable[Placing]) -> PoseCache:
    """The cache with at which poses the arm gets with what is placed, the first of these placings as far as looks last.

    ``poses`` hold placements and standing poses. ``world`` is at the start of its scene, and is left there.
    """
    with _staged(world) as stage:
        return Prospects(stage, poses).seen(placings)


@contextlib.contextmanager
def _staged(world: LiveWorld) -> Iterator[PhysicalStage]:
    """A robot in a world at the start of its scene, which is there again in the end."""
    dynamic = DynamicWorld(world.scene)
    try:
        stage = PhysicalStage(world, dynamic, _idle)
        stage.begin()
        yield stage
    finally:
        dynamic.close()
        world.hand.forget()
        world.engine.reset()
        world.navigator.refresh()
        world.robot = world.navigator.start


def _idle() -> None:
    """Nobody watches."""


def handlings_of(asset: Asset, *, fixed: bool) -> tuple[Handling, ...]:
    """What the hand may be asked to do to an object."""
    taken = () if fixed else (Handling.TAKE,)
    led = (Handling.OPEN, Handling.CLOSE) if asset.joints else ()
    pressed = (Handling.PRESS,) if asset.can("toggleable") else ()
    return (*taken, *led, *pressed)


def _preferring(first: StandPose, stands: Sequence[StandPose]) -> tuple[StandPose, ...]:
    """Standing poses with one of them before the others."""
    return tuple(sorted(stands, key=lambda stand: stand != first))


class _Surveyor:
    """Puts the robot where it may stand, and looks for ways of the arm."""

    def __init__(self, stage: PhysicalStage, known: dict[bytes, Look], contents: Contents) -> None:
        self._stage = stage
        self._world = stage.world
        self._known = known
        self._contents = contents

    def surveyed(self, poses: PoseCache, names: tuple[str, ...]) -> PoseCache:
        """The cache with what was found out about these objects."""
        stands = dict(poses.stands)
        barred: dict[Handling, dict[str, str]] = {}
        for name in names:
            handlings = handlings_of(self._world.asset(name), fixed=self._world.is_fixed(name))
            for handling in handlings:
                reached, other = self._look(name, handling)
                if reached is None and other:
                    barred.setdefault(handling, {})[name] = other
                elif reached is not None and handling is handlings[0]:
                    stands[name] = _preferring(reached, stands.get(name, ()))
        return replace(poses, stands=stands, barred=barred)

    def _look(self, name: str, handling: Handling) -> tuple[StandPose | None, str]:
        """The first standing pose from which it can be done; None, and what bars the way, when there is none such."""
        self._make_ready(name, handling)
        # From where else a door goes the robot finds out itself, when it tries.
        looks = 1 if handling in TRIALS else STANDS
        stands = self._world.navigator.stands(name, self._world.navigator.start)[:looks]
        if handling not in TRIALS:
            number, other = self._look_from(stands, name, handling)
        else:
            key = self._surroundings(name, handling, stands)
            if key not in self._known:
                self._known[key] = self._look_from(stands, name, handling)
            number, other = self._known[key]
        return (None if number is None else stands[number]), other

    def _look_from(self, stands: Sequence[StandPose], name: str, handling: Handling) -> Look:
        other = ""
        for number, stand in enumerate(stands):
            if number:
                self._make_ready(name, handling)
            self._stage.stand_at(stand)
            other = self._bars(name, handling)
            if not other:
                return number, ""
        # Leaves give way to one another as they are led: of doors it is tried what seems not to go.
        if stands and handling in TRIALS and self._does(stands[0], name, handling):
            return 0, ""
        return None, other

    def _does(self, stand: StandPose, name: str, handling: Handling) -> bool:
        """Whether the robot can do it all the same: it tries, in a world where time passes."""
        self._make_ready(name, handling)
        self._world.robot = stand
        self._stage.begin()
        refusal = TRIALS[handling](self._stage, name)
        self._world.hand.forget()
        self._stage.grip = None
        return refusal is None

    def _make_ready(self, name: str, handling: Handling) -> None:
        """The scene as it was loaded, but for what must be open or shut. Doors are looked at without the small things about."""
        world = self._world
        world.engine.reset()
        match handling:
            case Handling.OPEN | Handling.CLOSE:
                for item in world.scene.objects:
                    if not item.fixed and item.name != name and world.relations.host_of(item.name):
                        world.engine.park(item.name)
                shares = SWING if handling is Handling.CLOSE else (0.0,)
                swing_panels(world.engine, world.relations, name, shares)
            case Handling.TAKE | Handling.PRESS:
                self._stage.open_around(name)
        world.navigator.refresh()

    def _surroundings(self, name: str, handling: Handling, stands: Sequence[StandPose]) -> bytes:
        """Digest of all that a look at a door depends on."""
        engine, scene = self._world.engine, self._world.scene
        window = engine.aabb(name).grown(SEEN_M)
        rows = [
            (other, self._contents.of(scene.asset_of(other)), engine.pose(other), engine.joints(other))
            for other in (name, *engine.near(window, frozenset((name,))))
        ]
        walls = [(wall.pose, wall.size_m) for wall in scene.walls if wall.aabb(IDENTITY).overlaps(window)]
        return hashlib.sha256(repr((handling, rows, walls, stands)).encode()).digest()

    def _bars(self, name: str, handling: Handling) -> str:
        """What bars the way of the arm from where the robot stands; "" when nothing does."""
        match handling:
            case Handling.TAKE:
                tracks, _, bases = ways_to(self._stage, name)
                reach = self._stage.reach(self._stage.boxes(), name)
                return self._bars_all(reach, reach.ways(tracks, bases))
            case Handling.PRESS:
                return self._bars_all(*pressing(self._stage, name))
            case Handling.OPEN:
                return self._bars_leaves(name, 1.0)
            case Handling.CLOSE:
                return self._bars_leaves(name, 0.0)

    def _bars_all(self, reach: ArmReach, ways: Iterator[Way]) -> str:
        """What bars all of some ways; "" when the arm gets to the start of one of them, which it then may go."""
        for way in itertools.islice(ways, WAYS):
            if approach(self._stage, way, reach, loaded=False) is not None:
                return ""
        return reach.hindrance or SOMETHING

    def _bars_leaves(self, name: str, goal: float) -> str:
        """What bars the way to lead every leaf of an object to a share of its travel, one after the other."""
        if not self._stage.dynamic.bodies.has_leaves(name):
            return name
        for leaf in in_turn(self._stage, name, goal):
            start = self._world.engine.joints(name)[leaf.number]
            other = SOMETHING
            for pulls in STRETCHES:
                other = self._bars_leaf(leaf, np.linspace(start, goal, pulls + 1))
                if not other:
                    break
            if other:
                return other
        return ""

    def _bars_leaf(self, leaf: Leaf, course: FloatArray) -> str:
        """What bars the way to lead a leaf from share to share of its travel, (n,); if nothing does it is left at the last."""
        for start, goal in itertools.pairwise(course.tolist()):
            other = self._bars_all(*leading(self._stage, leaf, start, goal))
            if other:
                self._lead(leaf, float(course[0]))
                return other
            self._lead(leaf, goal)
        return ""

    def _lead(self, leaf: Leaf, share: float) -> None:
        fractions = list(self._world.engine.joints(leaf.name))
        fractions[leaf.number] = share
        DoorPanels(self._world.engine, self._world.relations, leaf.name).swing([fractions])
        self._world.navigator.refresh()
