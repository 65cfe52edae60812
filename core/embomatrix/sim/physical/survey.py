"""Reachability survey, offline: standing poses from which the arm reaches the objects of a scene, and the blockers elsewhere.

Cached mode does not model the arm. The survey keeps it from promising actions that the physical robot can't do: it searches
for arm paths once, in the initial scene, with the search of physical mode. Nothing is stepped, except for doors in doubt.
"""

import contextlib
import hashlib
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from embomatrix.sim.bullet.dynamic import DynamicWorld
from embomatrix.sim.joints.panels import DoorPanels, swing_panels
from embomatrix.sim.joints.swings import SWING
from embomatrix.sim.live_world import LiveWorld
from embomatrix.sim.physical.doors import STRETCHES, DoorPanel, move_panels, panel_paths, panels_in_order
from embomatrix.sim.physical.fold import PATHS_TRIED, approach
from embomatrix.sim.physical.pick import pick_paths
from embomatrix.sim.physical.placement_reachability import PlacementQuery, PlacementReachability
from embomatrix.sim.physical.press import press_paths
from embomatrix.sim.physical.reach import ArmPath, ArmReach
from embomatrix.sim.physical.stage import AROUND_M, PhysicalStage
from embomatrix.sim.physical.travel import SOMETHING
from embomatrix.sim.placing.pose_cache import Contents
from embomatrix.skills.limits import ROBOT
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import IDENTITY, FloatArray
from embomatrix.world.poses import Handling, PoseCache, StandPose

Look = tuple[int | None, str]
"""Number of the first suitable standing pose, and the blocker if there is none."""

STANDS: Final = 2
"""Standing poses to examine. More add little, because the robot steps aside to work."""
DOOR_GOALS: Final[Mapping[Handling, float]] = {Handling.OPEN: 1.0, Handling.CLOSE: 0.0}
"""Share of the travel that each door handling aims at. The survey tries these in simulated time if no path is found."""
SEEN_M: Final = ROBOT.reach_m + AROUND_M
"""Objects farther than this from a door have no influence on its reachability."""


class ReachabilitySurvey:
    """Survey of scenes. Results for doors are shared between scenes with equal surroundings."""

    def __init__(self) -> None:
        self._known: dict[bytes, Look] = {}
        self._contents = Contents()

    def survey(self, world: LiveWorld, poses: PoseCache, names: Iterable[str]) -> PoseCache:
        """Return the cache with suitable standing poses first, and with the blockers of unreachable objects.

        ``world`` is at the start of its scene, and is left there. The result depends on the arguments only.
        """
        with _staged(world) as stage:
            surveyor = _Surveyor(stage, self._known, self._contents)
            return surveyor.surveyed(poses, tuple(dict.fromkeys(names)))


def placement_reachability(
    world: LiveWorld, poses: PoseCache, queries: Iterable[PlacementQuery]
) -> PoseCache:
    """Return the cache with the answers to placement queries, the first ones as far as the budget lasts.

    ``poses`` hold placements and standing poses. ``world`` is at the start of its scene, and is left there.
    """
    with _staged(world) as stage:
        return PlacementReachability(stage, poses).seen(queries)


@contextlib.contextmanager
def _staged(world: LiveWorld) -> Iterator[PhysicalStage]:
    """Yield a stage with the robot at the start of the scene, and restore the world at the end."""
    dynamic = DynamicWorld(world.scene)
    try:
        stage = PhysicalStage(world, dynamic, watch=lambda: None)
        stage.begin()
        yield stage
    finally:
        dynamic.close()
        world.hand.forget()
        world.engine.reset()
        world.navigator.refresh()
        world.robot = world.navigator.start


def handlings_of(asset: Asset, *, fixed: bool) -> tuple[Handling, ...]:
    """Return the actions of the hand that an object offers."""
    taken = () if fixed else (Handling.TAKE,)
    led = (Handling.OPEN, Handling.CLOSE) if asset.joints else ()
    pressed = (Handling.PRESS,) if asset.can("toggleable") else ()
    return (*taken, *led, *pressed)


def _preferring(first: StandPose, stands: Sequence[StandPose]) -> tuple[StandPose, ...]:
    """Return standing poses with one of them first."""
    return tuple(sorted(stands, key=lambda stand: stand != first))


class _Surveyor:
    """Search for arm paths from standing poses in one scene."""

    def __init__(self, stage: PhysicalStage, known: dict[bytes, Look], contents: Contents) -> None:
        self._stage = stage
        self._world = stage.world
        self._known = known
        self._contents = contents

    def surveyed(self, poses: PoseCache, names: tuple[str, ...]) -> PoseCache:
        """Return the cache with the results for these objects."""
        stands = dict(poses.stands)
        blockers: dict[Handling, dict[str, str]] = {}
        for name in names:
            handlings = handlings_of(self._world.asset(name), fixed=self._world.is_fixed(name))
            for handling in handlings:
                reached, other = self._answer(name, handling)
                if reached is None and other:
                    blockers.setdefault(handling, {})[name] = other
                elif reached is not None and handling is handlings[0]:
                    stands[name] = _preferring(reached, stands.get(name, ()))
        return replace(poses, stands=stands, arm_blockers=blockers)

    def _answer(self, name: str, handling: Handling) -> tuple[StandPose | None, str]:
        """Return the first suitable standing pose; else None and the blocker."""
        self._make_ready(name, handling)
        # Motions of doors try other standing poses themselves.
        looks = 1 if handling in DOOR_GOALS else STANDS
        stands = self._world.navigator.stands(name, self._world.navigator.start)[:looks]
        if handling not in DOOR_GOALS:
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
            other = self._blocker(name, handling)
            if not other:
                return number, ""
        # Panels make room for each other as they move, so doors that seem blocked are tried in simulated time.
        if stands and handling in DOOR_GOALS and self._does(stands[0], name, handling):
            return 0, ""
        return None, other

    def _does(self, stand: StandPose, name: str, handling: Handling) -> bool:
        """True if the robot succeeds when it tries in simulated time."""
        self._make_ready(name, handling)
        self._world.robot = stand
        self._stage.begin()
        refusal = move_panels(self._stage, name, DOOR_GOALS[handling])
        self._world.hand.forget()
        self._stage.grip = None
        return refusal is None

    def _make_ready(self, name: str, handling: Handling) -> None:
        """Restore the initial scene, with doors as the handling needs them. Small objects are removed for doors."""
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
        """Return a digest of everything that the result for a door depends on."""
        engine, scene = self._world.engine, self._world.scene
        window = engine.aabb(name).grown(SEEN_M)
        rows = [
            (other, self._contents.of(scene.asset_of(other)), engine.pose(other), engine.joints(other))
            for other in (name, *engine.near(window, frozenset((name,))))
        ]
        statics = [
            (part.pose, part.size_m)
            for part in (*scene.walls, *scene.background_parts)
            if part.aabb(IDENTITY).overlaps(window)
        ]
        return hashlib.sha256(repr((handling, rows, statics, stands)).encode()).digest()

    def _blocker(self, name: str, handling: Handling) -> str:
        """Return the blocker of a handling from the present standing pose; "" for none."""
        match handling:
            case Handling.TAKE:
                tool_paths, _, bases = pick_paths(self._stage, name)
                reach = self._stage.reach(self._stage.boxes(), name)
                return self._paths_blocker(reach, reach.paths(tool_paths, bases))
            case Handling.PRESS:
                return self._paths_blocker(*press_paths(self._stage, name))
            case Handling.OPEN | Handling.CLOSE:
                return self._panels_blocker(name, DOOR_GOALS[handling])

    def _paths_blocker(self, reach: ArmReach, paths: Iterator[ArmPath]) -> str:
        """Return the blocker of all paths; "" if the arm reaches the start of one of them."""
        for path in itertools.islice(paths, PATHS_TRIED):
            if approach(self._stage, path, reach, loaded=False) is not None:
                return ""
        return reach.blocker or SOMETHING

    def _panels_blocker(self, name: str, goal: float) -> str:
        """Return the blocker of moving every panel of an object in turn; "" for none."""
        if not self._stage.dynamic.bodies.has_panels(name):
            return name
        for panel in panels_in_order(self._stage, name, goal):
            start = self._world.engine.joints(name)[panel.number]
            other = SOMETHING
            for pulls in STRETCHES:
                other = self._panel_blocker(panel, np.linspace(start, goal, pulls + 1))
                if not other:
                    break
            if other:
                return other
        return ""

    def _panel_blocker(self, panel: DoorPanel, course: FloatArray) -> str:
        """Return the blocker of moving a panel along shares of its travel, (n,). Without one the panel stays at the last."""
        for start, goal in itertools.pairwise(course.tolist()):
            other = self._paths_blocker(*panel_paths(self._stage, panel, start, goal))
            if other:
                self._move_panel(panel, float(course[0]))
                return other
            self._move_panel(panel, goal)
        return ""

    def _move_panel(self, panel: DoorPanel, share: float) -> None:
        fractions = list(self._world.engine.joints(panel.name))
        fractions[panel.number] = share
        DoorPanels(self._world.engine, self._world.relations, panel.name).swing([fractions])
        self._world.navigator.refresh()
