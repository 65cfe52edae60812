"""Warm-up of the simulator's root covers the parts of real scenes."""

import contextlib

from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.syntax import Skill
from embomatrix.worker.slots.warm_up import PLANS, WARM_UP, warm_up_bundle
from embomatrix.world.bundle import decode_bundle, encode_bundle
from embomatrix.world.geometry import Shape


def test_every_step_of_the_warm_up_succeeds():
    bundle = decode_bundle(encode_bundle(warm_up_bundle()))
    with contextlib.closing(load_simulator(bundle)) as simulator:
        for plan in PLANS:
            steps = simulator.execute(bundle.tasks[WARM_UP], plan, 0).steps
            assert [step.ok for step in steps] == [True] * len(plan)


def test_warm_up_uses_five_skills():
    skills = {call.skill for plan in PLANS for call in plan}
    assert skills == {Skill.MOVE, Skill.PICK_UP, Skill.PLACE, Skill.OPEN, Skill.CLOSE}


def test_warm_up_scene_has_boxes_spheres_hulls_and_joints():
    assets = warm_up_bundle().scene.assets.values()
    shapes = {part.shape for asset in assets for link in asset.links for part in link.parts}
    assert shapes == {Shape.BOX, Shape.SPHERE, Shape.HULL}
    assert any(asset.joints for asset in assets)
