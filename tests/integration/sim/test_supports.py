"""Cached support states equal fresh ones after any change."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fakes.scenes import kitchen_scene

from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.state.relations import Relations
from embomatrix.sim.state.supports import UNSUPPORTED, SupportTracker
from embomatrix.world.geometry import Pose
from embomatrix.world.state import Relation

MOVABLE = ("bowl_1", "apple_1", "chicken_leg_1", "mug_1", "apple_2", "microwave_1")
SPOTS = (
    (2.0, 1.3, 0.75),
    (2.1, 1.0, 0.76),
    (0.6, 3.65, 0.85),
    (2.2, 3.7, 0.9),
    (1.0, 1.0, 0.0),
    (2.1, 1.0, 0.82),
)
"""Points on the table, in the bowl, in the fridge, on the counter, on the floor and on the bowl."""

CHANGE = st.one_of(
    st.tuples(st.just("move"), st.sampled_from(MOVABLE), st.integers(0, 2**31)),
    st.tuples(st.just("park"), st.sampled_from(MOVABLE), st.just(0)),
    st.tuples(st.just("swing"), st.sampled_from(("fridge_1", "microwave_1")), st.integers(0, 2**31)),
    st.tuples(st.just("reset"), st.just(""), st.just(0)),
    st.tuples(st.just("ask"), st.sampled_from(MOVABLE), st.just(0)),
)


@pytest.fixture(scope="module")
def engine():
    pool = ClientPool()
    engine = BulletEngine(kitchen_scene(), pool)
    yield engine
    engine.close()
    pool.close()


def change(engine, kind, name, seed) -> None:
    rng = np.random.default_rng(seed)
    match kind:
        case "move":
            x, y, z = SPOTS[int(rng.integers(len(SPOTS)))]
            half = engine.scene.asset_of(name).size_m[2] / 2
            dx, dy = rng.uniform(-0.05, 0.05, 2).tolist()
            engine.set_pose(name, Pose.from_xyz_yaw(x + dx, y + dy, z + half, float(rng.uniform(-3, 3))))
        case "park":
            engine.park(name)
        case "swing":
            engine.set_joints(name, [float(rng.random())])
        case "reset":
            engine.reset()


@settings(max_examples=150, deadline=None)
@given(st.lists(CHANGE, max_size=12))
def test_cached_support_states_equal_fresh_ones(engine, changes) -> None:
    engine.reset()
    kept = SupportTracker(engine)
    for kind, name, seed in changes:
        change(engine, kind, name, seed)
        if kind == "ask":
            kept.of(name)
    fresh, pairs = SupportTracker(engine), SupportTracker(engine)
    for name in engine.scene.by_name:
        for other in ("bowl_1", "fridge_1", "breakfast_table_1", "countertop_1"):
            if name != other and not engine.is_parked(name) and not engine.is_parked(other):
                assert pairs.is_on(name, other) == (other in fresh.of(name).on), (name, other)
                around = {item.name for item in fresh.of(name).enclosures}
                assert pairs.is_in(name, other) == (other in around), (name, other)
        assert kept.of(name) == fresh.of(name), name


@settings(max_examples=25, deadline=None)
@given(st.lists(CHANGE, max_size=8), st.sampled_from(MOVABLE), st.integers(0, 2**31))
def test_moving_an_object_away_ends_ontop_and_inside(engine, changes, name, seed) -> None:
    engine.reset()
    relations = Relations(engine)
    for kind, other, number in changes:
        change(engine, kind, other, number)
    others = [other for other in engine.scene.by_name if other != name]
    before = [other for other in others if relations.ontop(name, other) or relations.inside(name, other)]
    rng = np.random.default_rng(seed)
    engine.set_pose(name, Pose((*rng.uniform(20.0, 30.0, 2).tolist(), float(rng.uniform(0.5, 2.0)))))
    for other in before:
        assert not relations.ontop(name, other)
        assert not relations.inside(name, other)
        assert not relations.holds(Relation.TOUCHING, name, other)


@settings(max_examples=25, deadline=None)
@given(st.lists(CHANGE, max_size=10))
def test_nothing_is_inside_and_on_top_of_one_closable_cavity(engine, changes) -> None:
    engine.reset()
    relations = Relations(engine)
    for kind, other, number in changes:
        change(engine, kind, other, number)
    for container in ("fridge_1", "microwave_1", "cabinet_1"):
        for name in engine.scene.by_name:
            assert not (relations.inside(name, container) and relations.ontop(name, container))
            assert not (relations.inside(name, container) and relations.inside(container, name))


def test_parked_object_has_no_support(engine) -> None:
    engine.reset()
    engine.park("bowl_1")
    assert SupportTracker(engine).of("bowl_1") == UNSUPPORTED
