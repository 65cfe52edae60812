"""Motions in the dynamic world: the motors follow postures at bounded speeds and stop at resistance."""

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.bullet.dynamic import DynamicWorld
from embomatrix.sim.bullet.robot import Posture
from embomatrix.sim.physical import body
from embomatrix.sim.physical.body import ARM, LIFT, YAW
from embomatrix.world.geometry import FloatArray

IntArray = NDArray[np.int_]

SPEED: Final = np.array([1.0, 1.0, 2.5, 0.5, 2.1, 2.1, 2.1, 2.1, 2.6, 2.6, 2.6])
"""Largest speeds in metres, and radians, a second. The arm's are the Panda's limits."""
STEERED: Final = 4
"""Steps of 1/240 s between two commands to the motors."""
STEPS_A_SECOND: Final = 240
LAG: Final = np.array([0.08, 0.08, 0.15, 0.06, 0.3, 0.3, 0.3, 0.3, 0.4, 0.4, 0.4])
"""Lag of a joint behind its command that counts as resistance, in metres and radians."""
_LAGS: Final = tuple(LAG.tolist())
ARRIVAL_STEPS: Final = 12
APART_M: Final = 0.035
LOAD_APART_M: Final = 0.02
"""Largest motion of any point of the arm between two checked postures, with an empty hand and with a load.

Fingers are 28 mm thick and keep 5 mm from everything, so no obstacle is thin enough to be missed.
"""
LEAST_COMMANDS: Final = 3
SHARP_RAD: Final = 1.2
WINDOW: Final = 8
"""Commands over which motions are smoothed, 0.13 s."""
RAMP_S: Final = 0.3
"""Time in which full speed is reached."""


class Mover:
    """Controller that moves the robot of one dynamic world."""

    def __init__(self, world: DynamicWorld, watch: Callable[[], None]) -> None:
        """``watch`` is called after every few steps, for films."""
        self._world = world
        self._watch = watch

    @property
    def posture(self) -> FloatArray:
        """Present posture, shape (11,)."""
        return np.array(self._world.robot.posture.numbers)

    def follow(
        self, postures: FloatArray, pace: float = 1.0, until: Callable[[], bool] | None = None
    ) -> str | None:
        """Move through postures, (w, 11), from the present one. ``pace`` is a share of full speed.

        Return None if the end is reached or ``until`` holds, else the name of the obstacle, "" for an unknown one.
        """
        commands = _commands(np.concatenate([self.posture[None], postures]), pace)
        return self._pursue(commands, self._world.go, until)

    def sweep(self, postures: FloatArray) -> str | None:
        """Move through postures without touching anything, as ``follow`` does.

        The motion is made at once if nothing is near, else in coarser time steps.
        """
        commands = _commands(np.concatenate([self.posture[None], postures]), 1.0)
        return None if self._passes(commands) else self._pursue(commands, self._world.glide, None)

    def advance(self, postures: FloatArray, pace: float = 1.0) -> str | None:
        """Move through postures beside objects that may be touched, as ``follow`` does: at once if nothing is near."""
        commands = _commands(np.concatenate([self.posture[None], postures]), pace)
        return None if self._passes(commands) else self._pursue(commands, self._world.go, None)

    def _passes(self, commands: FloatArray) -> bool:
        """Try to make a motion, (n, 11), at once. True if nothing was near; the robot is then at its end."""
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
                blocker = self._world.hindrance()
                self._world.robot.steer(self._world.robot.posture)
                return blocker
        self._world.robot.steer(Posture.of(commands[-1].tolist()))
        self.wait(ARRIVAL_STEPS)
        return None

    def _lags(self, command: Sequence[float]) -> bool:
        """True if a joint is far behind a command. A loop over eleven numbers is faster than numpy here."""
        now = self._world.robot.posture.numbers
        return any(abs(is_at - wanted) > lag for is_at, wanted, lag in zip(now, command, _LAGS, strict=True))

    def wait(self, steps: int) -> None:
        """Let time pass with the motors at their targets."""
        for _ in range(0, steps, STEERED):
            self._world.step(STEERED)
            self._watch()


def _commands(postures: FloatArray, pace: float) -> FloatArray:
    """Return targets for every few steps along postures: full speed in the middle, ramps at both ends."""
    postures = postures.copy()
    postures[:, YAW] = np.unwrap(postures[:, YAW])
    seconds = (np.abs(np.diff(postures, axis=0)) / (SPEED * pace)).max(axis=1)  # (w - 1,)
    marks = np.concatenate([[0.0], np.cumsum(seconds * _caution(postures))])
    total = float(marks[-1])
    if total <= 0.0:
        return postures[-1:]
    # Speed grows linearly, stays, and shrinks linearly. Both ramps together cost the time of one ramp.
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
    """Return indices of commands, (n, 11), between which no point of the arm moves farther than ``apart_m``, with the last."""
    places = body.balls(np.concatenate([start[None], commands]))
    paths = np.linalg.norm(np.diff(places, axis=0), axis=2).max(axis=1)  # (n,)
    # The distance to the last chosen command is at most the sum of the motions in between.
    chosen, gone = [], 0.0
    for number, path in enumerate(paths.tolist()):
        if number and gone + path > apart_m:
            chosen.append(number - 1)
            gone = 0.0
        gone += path
    return np.array([*chosen, len(commands) - 1])


def _smoothed(commands: FloatArray, start: FloatArray) -> FloatArray:
    """Running means over a short window, so that no joint changes its speed at once. The end stays in place."""
    window = min(WINDOW, len(commands))
    padded = np.concatenate([np.tile(start, (window // 2, 1)), commands, np.tile(commands[-1], (window, 1))])
    sums = np.cumsum(np.concatenate([np.zeros((1, padded.shape[1])), padded]), axis=0)
    return np.asarray((sums[window:] - sums[:-window]) / window)[1:]


def _caution(postures: FloatArray) -> FloatArray:
    """Factor, (w - 1,), by which each piece takes longer than at full speed: the base slows down at corners."""
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
    """Return the posture with the lift higher by some metres."""
    higher = posture.copy()
    higher[..., LIFT] += by_m
    return higher


def standing(posture: FloatArray, base: FloatArray) -> FloatArray:
    """Return the posture with the base at x, y and heading, shape (3,)."""
    moved = posture.copy()
    moved[..., :3] = base
    return moved


def with_arm(posture: FloatArray, arm: FloatArray) -> FloatArray:
    """Return the posture with other arm angles."""
    changed = posture.copy()
    changed[..., ARM] = arm
    return changed
