"""Offline placement reachability: reachable poses are found and preferred by both modes."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from tests.fakes import furniture as make
from tests.fakes.plans import executed, with_objects
from tests.fakes.pose_caches import build_pose_cache
from tests.fakes.scenes import kitchen_scene, placed, upright

from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.live_world import LiveWorld
from embomatrix.sim.physical.placement_reachability import PlacementQuery
from embomatrix.sim.physical.survey import placement_reachability
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.failure import FailureReason
from embomatrix.world.bundle import Bundle, decode_bundle, encode_bundle
from embomatrix.world.codec_task import poses_of, poses_to_json
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import PoseCache
from embomatrix.world.records import PosesJson, SceneInvalidError, convert
from embomatrix.world.state import Relation
from embomatrix.world.tables import Tables, TableWriter

ON_COUNTER = PlacementQuery("apple_1", "countertop_1", Relation.ONTOP)
INTO_BOWL = PlacementQuery("apple_1", "bowl_1", Relation.INSIDE)


def looked_ahead(scene, placings):
    """Return a cache with the answers to placement queries. The world is unchanged afterwards."""
    with contextlib.closing(BulletEngine(scene)) as engine:
        held, targets = ([*{getattr(each, key): None for each in placings}] for key in ("held", "target"))
        poses = build_pose_cache(scene, held, targets, seed=0, engine=engine)
        world = LiveWorld(Bundle(scene, {}, poses), engine)
        before = world.state_bytes()
        found = placement_reachability(world, poses, placings)
        assert world.state_bytes() == before
        return found


@pytest.fixture(scope="module")
def known():
    return looked_ahead(kitchen_scene(), (ON_COUNTER, INTO_BOWL))


def chosen(poses, placing, moved=None):
    """Return the poses that seeds choose for an object from the first standing pose, with the target moved or not."""
    scene = kitchen_scene()
    with contextlib.closing(BulletEngine(scene)) as engine:
        world = LiveWorld(Bundle(scene, {}, poses), engine)
        if moved is not None:
            engine.set_pose(placing.target, moved @ engine.pose(placing.target))
        stand = world.navigator.stands(placing.target, world.robot)[0]
        engine.park(placing.held)
        rngs = map(np.random.default_rng, range(6))
        return [world.placer.find(placing.held, placing.target, placing.relation, stand, rng) for rng in rngs]


def without_reached(poses):
    return PoseCache(poses.placements, poses.stands)


def test_pose_on_an_open_counter_is_reachable(known):
    assert known.reached[Relation.ONTOP]["apple_1"]["countertop_1"] >= 0
    assert known.placing_blockers == {}


def test_reachable_pose_comes_first_for_every_seed(known):
    assert len(set(chosen(known, ON_COUNTER))) == 1
    assert len(set(chosen(without_reached(known), ON_COUNTER))) > 1


def test_reachability_is_ignored_for_a_moved_target(known):
    aside = Pose((0.05, 0.0, 0.0))
    assert chosen(known, INTO_BOWL, aside) == chosen(without_reached(known), INTO_BOWL, aside)


def test_equal_queries_give_equal_answers(known):
    again = looked_ahead(kitchen_scene(), (ON_COUNTER, INTO_BOWL))
    assert (again.reached, again.placing_blockers) == (known.reached, known.placing_blockers)


def boxed_in():
    """Return the flat with a low stand on its table, in a closed box high enough for a slice of bread."""
    x, y, top, high, wide = 1.9, 1.3, 0.75, 0.11, 0.2
    stand = make.block("stand", "board.n.01", (0.06, 0.06, 0.04), {})
    slice_of = replace(make.block("slice", "bread.n.01", (0.05, 0.05, 0.03), {}), mass_kg=0.1)
    side = make.block("side", "board.n.01", (0.02, wide + 0.02, high), {})
    lid = make.block("lid", "board.n.01", (wide + 0.04, wide + 0.04, 0.02), {})
    away, turn = wide / 2 + 0.01, 1.5707963267948966
    at = ((away, 0.0, 0.0), (-away, 0.0, 0.0), (0.0, away, turn), (0.0, -away, turn))
    sides = [
        (placed(f"side_{n}", side, "kitchen_0", upright(x + dx, y + dy, top, side, yaw), fixed=True), side)
        for n, (dx, dy, yaw) in enumerate(at, start=1)
    ]
    boxed = [
        (placed("stand_1", stand, "kitchen_0", upright(x, y, top, stand), fixed=True), stand),
        (placed("lid_1", lid, "kitchen_0", upright(x, y, top + high, lid), fixed=True), lid),
    ]
    free = placed("slice_1", slice_of, "kitchen_0", upright(x + 0.3, y, top, slice_of))
    return with_objects(kitchen_scene(), [*sides, *boxed, (free, slice_of)])


def test_no_object_is_placed_at_an_unreachable_pose():
    placing = PlacementQuery("slice_1", "stand_1", Relation.ONTOP)
    scene = boxed_in()
    poses = looked_ahead(scene, (placing,))
    other = poses.placing_blockers[Relation.ONTOP]["slice_1"]["stand_1"]
    assert other.startswith(("side", "lid", "stand"))
    trace = execute(scene, poses, "move slice_1; pick_up slice_1; move stand_1; place stand_1 ontop")
    assert trace.failure is FailureReason.ARM_BLOCKED
    assert (
        trace.steps[-1].message
        == f"the arm finds no free path to a place for slice_1: {other} blocks it; clear the way first"
    )


def test_place_is_reachable_after_its_blocker_is_removed():
    poses = PoseCache(placing_blockers={Relation.ONTOP: {"apple_1": {"coffee_table_1": "mug_1"}}})
    brings = "move apple_1; pick_up apple_1; move coffee_table_1; place coffee_table_1 ontop"
    clears = "move mug_1; pick_up mug_1; move countertop_1; place countertop_1 ontop"
    assert execute(kitchen_scene(), poses, brings).failure is FailureReason.ARM_BLOCKED
    assert execute(kitchen_scene(), poses, f"{clears}; {brings}").failure is None


def execute(scene, poses, text):
    with contextlib.closing(load_simulator(Bundle(scene, {}, poses))) as simulator:
        return executed(simulator, text)


def test_reachable_poses_are_stored_in_the_bundle(known):
    poses = PoseCache(
        reached=known.reached, placing_blockers={Relation.INSIDE: {"mug_1": {"sink_1": "wall"}}}
    )
    found = decode_bundle(encode_bundle(Bundle(kitchen_scene(), {}, poses))).poses
    assert (found.reached, found.placing_blockers) == (poses.reached, poses.placing_blockers)


@pytest.mark.parametrize("number", ["3", -1, 0.5, True, None])
def test_invalid_pose_number_is_refused_with_its_name(number):
    writer = TableWriter()
    value = poses_to_json(PoseCache(reached={Relation.ONTOP: {"mug_1": {"sink_1": 1}}}), writer)
    value["reached"]["ontop"]["mug_1"]["sink_1"] = number
    with pytest.raises(SceneInvalidError, match="sink_1"):
        poses_of(convert(value, PosesJson, "poses"), Tables(writer.arrays()))
