"""The root's rehearsal meets what real scenes are made of."""

import contextlib

from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.syntax import Skill
from embomatrix.worker.slots.rehearsal import PLANS, REHEARSAL, rehearsal_bundle
from embomatrix.world.bundle import decode_bundle, encode_bundle
from embomatrix.world.geometry import Shape


def test_every_step_of_the_rehearsal_succeeds():
    bundle = decode_bundle(encode_bundle(rehearsal_bundle()))
    with contextlib.closing(load_simulator(bundle)) as simulator:
        for plan in PLANS:
            steps = simulator.execute(bundle.tasks[REHEARSAL], plan, 0).steps
            assert [step.ok for step in steps] == [True] * len(plan)


def test_the_rehearsal_moves_takes_places_opens_and_closes():
    skills = {call.skill for plan in PLANS for call in plan}
    assert skills == {Skill.MOVE, Skill.PICK_UP, Skill.PLACE, Skill.OPEN, Skill.CLOSE}


def test_the_rehearsal_has_boxes_and_round_things_and_hulls_and_joints():
    assets = rehearsal_bundle().scene.assets.values()
    shapes = {part.shape for asset in assets for link in asset.links for part in link.parts}
    assert shapes == {Shape.BOX, Shape.SPHERE, Shape.HULL}
    assert any(asset.joints for asset in assets)
