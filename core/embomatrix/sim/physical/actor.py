"""Physical execution mode: a robot carries out every skill in a world where time passes.

Preconditions, relations and effects are those of cached mode, read in the same planning scene. The robot drives, reaches,
touches, lifts and lets go, and physics decides the outcome. A failed skill leaves the changes that it made.
"""

import math
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from embomatrix.sim.actions import ACTIONS, heading_after
from embomatrix.sim.blockers import path_refusal, room_refusal
from embomatrix.sim.bullet.dynamic import DynamicWorld
from embomatrix.sim.executor import Simulator
from embomatrix.sim.live_world import LiveWorld
from embomatrix.sim.physical.doors import move_panels
from embomatrix.sim.physical.pick import pick_up
from embomatrix.sim.physical.place import place
from embomatrix.sim.physical.press import press
from embomatrix.sim.physical.stage import PhysicalStage
from embomatrix.sim.physical.travel import drive, travel
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import Skill, SkillCall
from embomatrix.skills.view import SkillRefusal, metres, refuse, source_of, target_of
from embomatrix.world.bundle import Bundle
from embomatrix.world.poses import StandPose

Motion = Callable[[PhysicalStage, SkillCall, np.random.Generator], SkillRefusal | None]


def physical_simulator(bundle: Bundle) -> Simulator:
    """Return a simulator that executes plans physically. Raises EngineError when the scene can't be loaded."""
    return load_simulator(bundle, actor=PhysicalActor(bundle))


class PhysicalActor:
    """Actor that carries out calls with the robot in a dedicated dynamic world."""

    drawing = frozenset(Skill)
    keeps_state = True

    def __init__(self, bundle: Bundle) -> None:
        """Create a dynamic world. It is built at the first reset and closed with the actor."""
        self._dynamic = DynamicWorld(bundle.scene)
        self._stage: PhysicalStage | None = None
        self._watch: Callable[[], None] | None = None

    @property
    def dynamic(self) -> DynamicWorld:
        """The dynamic world, for reading."""
        return self._dynamic

    def watch(self, watch: Callable[[], None] | None) -> None:
        """Register a function to call after every few steps of simulated time; None removes it."""
        self._watch = watch

    def reset(self, world: LiveWorld) -> None:
        """Build the dynamic world in the initial state of the scene."""
        self._stage = PhysicalStage(world, self._dynamic, self._tick)
        self._stage.begin()

    def act(self, world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
        """Carry out a call whose preconditions hold, let the world settle, and copy moved objects to the planning scene."""
        assert self._stage is not None
        refusal = MOTIONS[call.skill](self._stage, call, rng)
        if refusal is not None and refusal.reason is FailureReason.SLIPPED:
            self._stage.drop()
        self._stage.settle()
        return refusal

    def close(self) -> None:
        """Free the physics client."""
        self._dynamic.close()

    def _tick(self) -> None:
        if self._watch is not None:
            self._watch()


def _move(stage: PhysicalStage, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    world = stage.world
    target = target_of(world, call)
    stands = world.navigator.stands(target, world.robot)
    if stands:
        return travel(stage, stands[0], target)
    return path_refusal(world, target)


def _turn(stage: PhysicalStage, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    here = stage.commanded
    heading = heading_after(here.yaw, call)
    refusal = drive(stage, stage.mover.posture[None, :2], heading)
    stage.commanded = StandPose(here.x_m, here.y_m, heading)
    return refusal


def _move_forward(stage: PhysicalStage, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    start = stage.commanded
    heading, distance_m = heading_after(start.yaw, call), call.distance or 0.0
    course = heading if distance_m >= 0 else heading + math.pi
    free_m = stage.world.navigator.forward(start, course, abs(distance_m))
    if free_m < abs(distance_m):
        return refuse(FailureReason.BLOCKED, distance=metres(free_m))
    here = stage.mover.posture[:2]
    x, y = start.x_m + abs(distance_m) * math.cos(course), start.y_m + abs(distance_m) * math.sin(course)
    return drive(stage, here[None], heading) or drive(stage, np.array([here, (x, y)]), heading)


def _go_to_room(stage: PhysicalStage, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    room = call.room_name or ""
    entry = stage.world.navigator.room_entry(room, stage.world.robot)
    if entry is None:
        return room_refusal(stage.world, room)
    return travel(stage, entry)


def _toggle(stage: PhysicalStage, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    """Press the switch. The effect is that of cached mode."""
    return press(stage, target_of(stage.world, call)) or ACTIONS[call.skill](stage.world, call, rng)


def _work(stage: PhysicalStage, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    """Touch the object that is cut, wiped or wetted. The effect is that of cached mode."""
    world = stage.world
    target = target_of(world, call)
    touched = source_of(world, call) if target in world.carried else target
    free = touched not in world.carried and not world.carried
    refusal = press(stage, touched) if free else None
    refusal = refusal or ACTIONS[call.skill](world, call, rng)
    if refusal is None:
        stage.bring_in_step()
    return refusal


def _wait(stage: PhysicalStage, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    """Let the world settle. The source acts by itself."""
    stage.mover.wait(60)
    return None


MOTIONS: Final[Mapping[Skill, Motion]] = {
    Skill.MOVE: _move,
    Skill.TURN: _turn,
    Skill.PICK_UP: lambda stage, call, rng: pick_up(stage, target_of(stage.world, call)),
    Skill.PLACE: place,
    Skill.MOVE_FORWARD: _move_forward,
    Skill.OPEN: lambda stage, call, rng: move_panels(stage, target_of(stage.world, call), 1.0),
    Skill.CLOSE: lambda stage, call, rng: move_panels(stage, target_of(stage.world, call), 0.0),
    Skill.TOGGLE_ON: _toggle,
    Skill.TOGGLE_OFF: _toggle,
    Skill.HEAT: _wait,
    Skill.COOK: _wait,
    Skill.FREEZE: _wait,
    Skill.GO_TO_ROOM: _go_to_room,
    Skill.SLICE: _work,
    Skill.CLEAN: _work,
    Skill.SOAK: _work,
}
"""Motion of each skill."""
