"""Placing after a look at the scene as loaded is bit-equal to placing without it."""

import contextlib

import pytest

from embomatrix.bench.engine.workload import PINNED, load_workload
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.executor import Simulator
from embomatrix.sim.floor.prepared import PreparedScene
from embomatrix.sim.placing.search import PlacementSearch
from embomatrix.skills.syntax import PlaceRelation, Skill, SkillCall
from embomatrix.world.bundle import decode_bundle

PLANS = 12
CROWD = 8
"""Objects that are carried to one support, so that moved objects get in the way."""


@pytest.fixture(scope="module")
def pair():
    """Two simulators of one pinned scene, of which the first has looked around, and plans for them."""
    workload = load_workload(PINNED)
    scene = workload.main.scenes[0]
    bundle = decode_bundle(workload.bundles[scene.bundle_digest])
    with contextlib.ExitStack() as opened:
        ahead, plain = (
            opened.enter_context(
                contextlib.closing(
                    Simulator(bundle, BulletEngine(bundle.scene, None, PreparedScene.of(bundle)))
                )
            )
            for _ in range(2)
        )
        for _ in ahead.warm_up():
            pass
        yield ahead, plain, bundle, scene.executions[:PLANS]


def test_pinned_plans_have_equal_traces(pair) -> None:
    ahead, plain, bundle, executions = pair
    for execution in executions:
        task = bundle.tasks[execution.task_id]
        known, found = (
            simulator.execute(task, execution.plan, execution.seed) for simulator in (ahead, plain)
        )
        assert known == found


@pytest.mark.parametrize("seed", [0, 1])
def test_support_that_fills_up_takes_objects_in_the_same_places(pair, seed) -> None:
    ahead, plain, bundle, executions = pair
    task = bundle.tasks[executions[seed].task_id]
    support = next(call.object_index for call in executions[seed].plan if call.skill is Skill.PLACE)
    movable = [index for index, name in enumerate(task.table) if not bundle.scene.by_name[name].fixed]
    calls = [
        call
        for index in movable[:CROWD]
        for call in (
            SkillCall(Skill.MOVE, object_index=index),
            SkillCall(Skill.PICK_UP, object_index=index),
            SkillCall(Skill.MOVE, object_index=support),
            SkillCall(Skill.PLACE, object_index=support, relation=PlaceRelation.ONTOP),
        )
    ]
    seen = []
    for simulator in (ahead, plain):
        simulator.reset(task, seed)
        steps = [simulator.run_step(call) for call in calls]
        seen.append((steps, simulator.world.state_bytes(), simulator.survey(task)))
    assert seen[0] == seen[1]
    assert sum(step.ok for step in seen[0][0] if step.call.skill is Skill.PLACE) > 1


def test_only_the_simulator_that_looked_around_places_without_trying(pair, monkeypatch) -> None:
    ahead, plain, bundle, executions = pair
    tried = []
    verified = PlacementSearch._verified
    monkeypatch.setattr(
        PlacementSearch,
        "_verified",
        lambda search, *args: tried.append(search.engine) or verified(search, *args),
    )
    for simulator in (ahead, plain):
        for execution in executions:
            simulator.execute(bundle.tasks[execution.task_id], execution.plan, execution.seed)
    counts = [tried.count(simulator.world.engine) for simulator in (ahead, plain)]
    assert counts[0] < counts[1] / 2
