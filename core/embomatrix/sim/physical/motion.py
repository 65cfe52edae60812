"""Motions in the dynamic world: the motors follow postures at bounded speeds, and stop when something holds them up."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.bullet.robot import Posture
from embomatrix.sim.physical import body
from embomatrix.sim.physical.body import ARM, LIFT, YAW

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from embomatrix.sim.bullet.dynamic import DynamicWorld
    from embomatrix.world.geometry import FloatArray

    IntArray = NDArray[np.int_]

SPEED: Final = np.array([1.0, 1.0, 2.5, 0.5, 2.1, 2.1, 2.1, 2.1, 2.6, 2.6, 2.6])
"""Metres, and radians, a second: the arm's are the Panda's own limits."""
STEERED: Final = 4
"""Steps of 1/240 s between two commands to the motors."""
STEPS_A_SECOND: Final = 240
LAG: Final = np.array([0.08, 0.08, 0.15, 0.06, 0.3, 0.3, 0.3, 0.3, 0.4, 0.4, 0.4])
"""A joint that falls this far behind is held up by something."""
_LAGS: Final = tuple(LAG.tolist())
ARRIVAL_STEPS: Final = 12
APART_M: Final = 0.035
LOAD_APART_M: Final = 0.02
"""So far no point of the arm goes between two postures at which a passage is looked at, with an empty hand and with a load.

Fingers are 28 mm thick and may come no nearer than 5 mm to anything: nothing is so thin that it is passed unseen.
"""
LEAST_COMMANDS: Final = 3
SHARP_RAD: Final = 1.2
WINDOW: Final = 8
"""Commands over which motions are smoothed, 0.13 s."""
RAMP_S: Final = 0.3
"""Time in which full speed is reached."""


class Mover:
    """Moves the robot of one dynamic world."""

    def __init__(self, world: DynamicWorld, watch: Callable[[], None]) -> None:
        """``watch`` is called after every few steps: for whoever makes a film."""
        self._world = world
        self._watch = watch

    @property
    def posture(self) -> FloatArray:
        """The present posture, shape (11,)."""
        return np.array(self._world.robot.posture.numbers)

    def follow(
        self, postures: FloatArray, pace: float = 1.0, until: Callable[[], bool] | None = None
    ) -> str | None:
        """Move through postures, (w, 11), from the present one. ``pace`` is a share of full speed.

        None when the end is reached or ``until`` says so, else the name of what holds the robot up, "" when unknown.
        """
        commands = _commands(np.concatenate([self.posture[None], postures]), pace)
        return self._pursue(commands, self._world.go, until)

    def sweep(self, postures: FloatArray) -> str | None:
        """Move through postures, as ``follow`` does, where nothing is to be touched.

        Where nothing is near the motion is made at once; else time passes in coarser steps.
        """
        commands = _commands(np.concatenate([self.posture[None], postures]), 1.0)
        return None if self._passes(commands) else self._pursue(commands, self._world.glide, None)

    def advance(self, postures: FloatArray, pace: float = 1.0) -> str | None:
        """Move through postures, as ``follow`` does, beside things that may be touched: at once where nothing is near."""
        commands = _commands(np.concatenate([self.posture[None], postures]), pace)
        return None if self._passes(commands) else self._pursue(commands, self._world.go, None)

    def _passes(self, commands: FloatArray) -> bool:
        """Whether the robot went through commands, (n, 11), without coming near anything: then it is where they end."""
        passage = self._world.passage()
        if passage is None:
            return False
        chosen = _spaced(self.posture, commands, LOAD_APART_M if passage.is_loaded else APART_M)
        samples = [Posture.of(command) for command in commands[chosen].tolist()]
        if not passage.is_clear(samples):
            return False
        for sample, commanded in zip(samples, np.diff(chosen, prepend=-1).tolist(), strict=True):
            passage.stand(sample)
            self._world.steps += commanded * STEERED
            self._watch()
        self._world.robot.steer(samples[-1])
        return True

    def _pursue(
        self,
        commands: FloatArray,
        pursue: Callable[[Posture, int], None],
        until: Callable[[], bool] | None,
    ) -> str | None:
        for command in commands.tolist():
            pursue(Posture.of(command), STEERED)
            self._watch()
            if until is not None and until():
                self._world.robot.steer(self._world.robot.posture)
                return None
            if self._lags(command):
                hindrance = self._world.hindrance()
                self._world.robot.steer(self._world.robot.posture)
                return hindrance
        self._world.robot.steer(Posture.of(commands[-1].tolist()))
        self.wait(ARRIVAL_STEPS)
        return None

    def _lags(self, command: Sequence[float]) -> bool:
        """Whether a joint is far behind a command: asked so often that eleven numbers are compared one by one."""
        now = self._world.robot.posture.numbers
        return any(abs(is_at - wanted) > lag for is_at, wanted, lag in zip(now, command, _LAGS, strict=True))

    def wait(self, steps: int) -> None:
        """Let time pass with the motors at their targets."""
        for _ in range(0, steps, STEERED):
            self._world.step(STEERED)
            self._watch()


def _commands(postures: FloatArray, pace: float) -> FloatArray:
    """Targets for every few steps along postures: full speed in the middle, gentle at both ends."""
    postures = postures.copy()
    postures[:, YAW] = np.unwrap(postures[:, YAW])
    seconds = (np.abs(np.diff(postures, axis=0)) / (SPEED * pace)).max(axis=1)  # (w - 1,)
    marks = np.concatenate([[0.0], np.cumsum(seconds * _caution(postures))])
    total = float(marks[-1])
    if total <= 0.0:
        return postures[-1:]
    # Speed grows evenly, stays, and shrinks evenly: the ramps cost as much time as one of them lasts.
    ramp = min(RAMP_S, total)
    count = max(LEAST_COMMANDS, int(np.ceil((total + ramp) * STEPS_A_SECOND / STEERED)))
    clock = np.linspace(0.0, total + ramp, count + 1)[1:]
    left = total + ramp - clock
    times = np.where(
        clock < ramp,
        clock**2 / (2 * ramp),
        np.where(left < ramp, total - left**2 / (2 * ramp), clock - ramp / 2),
    )
    columns = [np.interp(times, marks, postures[:, column]) for column in range(postures.shape[1])]
    return _smoothed(np.stack(columns, axis=1), postures[0])


def _spaced(start: FloatArray, commands: FloatArray, apart_m: float) -> IntArray:
    """Numbers of so many commands, (n, 11), that no point of the arm goes farther from one to the next, the last among them."""
    places = body.balls(np.concatenate([start[None], commands]))
    ways = np.linalg.norm(np.diff(places, axis=0), axis=2).max(axis=1)  # (n,)
    # Each command is at most as far from the one chosen before it as the ways in between sum up to.
    chosen, gone = [], 0.0
    for number, way in enumerate(ways.tolist()):
        if number and gone + way > apart_m:
            chosen.append(number - 1)
            gone = 0.0
        gone += way
    return np.array([*chosen, len(commands) - 1])


def _smoothed(commands: FloatArray, start: FloatArray) -> FloatArray:
    """Running means over a short window: no joint changes its speed at once. The end stays where it is."""
    window = min(WINDOW, len(commands))
    padded = np.concatenate([np.tile(start, (window // 2, 1)), commands, np.tile(commands[-1], (window, 1))])
    sums = np.cumsum(np.concatenate([np.zeros((1, padded.shape[1])), padded]), axis=0)
    return np.asarray((sums[window:] - sums[:-window]) / window)[1:]


def _caution(postures: FloatArray) -> FloatArray:
    """How many times longer than at full speed each piece takes, (w - 1,): the base slows down before and after corners."""
    steps = np.diff(postures[:, :2], axis=0)
    length = np.linalg.norm(steps, axis=1)
    course = np.arctan2(steps[:, 1], steps[:, 0])
    turn = np.abs(np.remainder(np.diff(course) + np.pi, 2 * np.pi) - np.pi)
    turn[(length[:-1] < 1e-3) | (length[1:] < 1e-3)] = 0.0
    sharp = np.minimum(turn / SHARP_RAD, 1.0)
    slower = np.ones(len(length))
    slower[:-1] = np.maximum(slower[:-1], 1 + 2 * sharp)
    slower[1:] = np.maximum(slower[1:], 1 + 2 * sharp)
    return slower


def raised(posture: FloatArray, by_m: float) -> FloatArray:
    """The posture with the lift higher by some metres."""
    higher = posture.copy()
    higher[..., LIFT] += by_m
    return higher


def standing(posture: FloatArray, base: FloatArray) -> FloatArray:
    """The posture with the base elsewhere: x, y and heading, shape (3,)."""
    moved = posture.copy()
    moved[..., :3] = base
    return moved


def with_arm(posture: FloatArray, arm: FloatArray) -> FloatArray:
    """The posture with the arm's joints elsewhere."""
    changed = posture.copy()
    changed[..., ARM] = arm
    return changed
