"""The shipped dataset and its workload: complete, unchanged, and every scene still executes its plans."""

import contextlib

import pytest

from embomatrix.bench.engine.workload import PINNED, load_workload, nearest_size
from embomatrix.reward.hierarchy import score
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import plan_from_json
from embomatrix.world.bundle import decode_bundle
from embomatrix.world.dataset import Dataset
from embomatrix.world.inflation import bundle_digest

WORKLOAD = load_workload(PINNED)
REMEDY = "write the pinned dataset anew as docs/benchmarks.md says"


def test_bundles_have_the_digests_that_the_workload_names():
    assert {bundle_digest(data) for data in WORKLOAD.bundles.values()} == set(WORKLOAD.bundles)
    assert {scene.bundle_digest for scene in WORKLOAD.scenes} == set(WORKLOAD.bundles)


def test_package_stays_small():
    assert sum(path.stat().st_size for path in PINNED.rglob("*") if path.is_file()) < 5e6


def test_sizes_60_300_and_600_have_scenes_and_the_main_size_has_four():
    assert {nearest_size(scene.bodies) for scene in WORKLOAD.scenes} == {60, 300, 600}
    assert len(WORKLOAD.main.scenes) == 4
    assert all(len(set(scene.executions)) == 50 for scene in WORKLOAD.scenes)


@pytest.mark.parametrize("scene", WORKLOAD.scenes, ids=lambda scene: scene.scene_id)
def test_scene_executes_its_first_plan_and_an_oracle_plan_reaches_its_goal(scene):
    bundle = decode_bundle(WORKLOAD.bundles[scene.bundle_digest], digest=scene.bundle_digest)
    assert len(bundle.scene.objects) == scene.bodies, REMEDY
    record = next(item for item in Dataset.load(PINNED).records if item.bundle_digest == scene.bundle_digest)
    with contextlib.closing(load_simulator(bundle)) as simulator:
        first = scene.executions[0]
        assert simulator.execute(bundle.tasks[first.task_id], first.plan, first.seed).failure is None, REMEDY
        plan = plan_from_json([*record.oracle], record.task.profile)
        trace = simulator.execute(record.task, plan, 0)
        assert score(record.task, trace.touched, simulator.facts).success, REMEDY
