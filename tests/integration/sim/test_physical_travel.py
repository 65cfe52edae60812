"""Driving with a stretched arm, which sweeps over more than its stops."""

import contextlib
import math

import numpy as np
import pytest
from tests.fakes import furniture as make
from tests.fakes.scenes import placed, scene_of, upright

from embomatrix.sim.bullet.dynamic import DynamicWorld
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.live_world import LiveWorld
from embomatrix.sim.physical import body
from embomatrix.sim.physical.stage import PhysicalStage
from embomatrix.sim.physical.travel import HEADINGS, drive
from embomatrix.world.bundle import Bundle
from embomatrix.world.poses import PoseCache

STRETCHED = (0.5, 0.0, 1.5, 0.0, -0.2, 0.0, 1.8, 0.785)
"""Lift and arm of a robot that holds its hand far ahead."""
STEP = math.tau / HEADINGS


@contextlib.contextmanager
def stretched_beside_a_post(turn):
    """Return a stage with a stretched arm, and a thin post at the hand position after a turn."""
    start = np.array([3.5, 1.5, turn, *STRETCHED])
    x, y, _ = body.tools(start[None])[1][0].tolist()
    post = make.block("post", "post.n.01", (0.01, 0.01, 1.6), {})
    stands = placed("post_1", post, "kitchen_0", upright(x, y, 0.0, post), fixed=True)
    scene = scene_of("post", [(stands, post)])
    dynamic = DynamicWorld(scene)
    with contextlib.closing(BulletEngine(scene)) as engine, contextlib.closing(dynamic):
        stage = PhysicalStage(LiveWorld(Bundle(scene, {}, PoseCache()), engine), dynamic, lambda: None)
        stage.begin()
        stretched = stage.mover.posture
        stretched[body.LIFT :] = STRETCHED
        assert stage.mover.sweep(stretched[None]) is None
        yield stage


@pytest.mark.parametrize("side", [1, -1])
def test_stretched_arm_turns_away_from_a_post_between_two_headings(side):
    aim = side * 10 * STEP
    with stretched_beside_a_post(side * 2.5 * STEP) as stage:
        here = stage.mover.posture[None, :2]
        assert drive(stage, here, aim) is None
        assert abs(math.remainder(stage.mover.posture[body.YAW] - aim, math.tau)) < 0.05
