"""Small objects stay in place in the engine."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from embomatrix.factory.assets.check import GLANCE_STEPS, AssetFinding, AssetRule, check_standing
from embomatrix.factory.assets.check import STEPS as STEPS_OF_TWO_SECONDS
from embomatrix.factory.assets.library import build_asset
from embomatrix.world.asset import Link
from embomatrix.world.catalog import Catalog
from embomatrix.world.geometry import Pose

bullet_bodies = pytest.importorskip("embomatrix.sim.bullet.bodies", reason="needs pybullet")
bullet_client = pytest.importorskip("embomatrix.sim.bullet.client", reason="needs pybullet")
pybullet = pytest.importorskip("pybullet", reason="PyBullet has wheels up to Python 3.11 on x86-64")

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

THINGS = (
    "apple banana bell_pepper bottle_of_wine bowl can_of_soda carrot chicken chopping_board cupcake egg frying_pan "
    "half_apple hardback laptop lemon mug pillow plate potato saucepot stockpot table_knife tablefork teapot tray vase "
    "water_glass watermelon wineglass wok"
)
STEPS = 360
CATALOG = Catalog.load()
LEANING = Pose((0.0, 0.0, 0.0), (math.sin(0.3), 0.0, 0.0, math.cos(0.3)))


@pytest.fixture(scope="module")
def client() -> Iterator[Any]:
    connected = bullet_client.connect()
    yield connected
    connected.disconnect()


@pytest.mark.parametrize("category", THINGS.split())
def test_dropped_object_stays_upright_in_place(client: Any, category: str) -> None:
    catalog = Catalog.load()
    asset = build_asset(catalog, category, catalog.models_of(category)[0].model_id)
    half = asset.size_m[2] / 2
    client.resetSimulation()
    client.setGravity(0.0, 0.0, -9.81)
    bodies = bullet_bodies.BodyFactory(client)
    bodies.floor(0.0, 0.0, 5.0)
    body = bodies.rigid(asset, Pose((0.0, 0.0, half + 5e-4)), [0.0] * len(asset.joints), asset.mass_kg)
    for _ in range(STEPS):
        client.stepSimulation()
    (x, y, z), (qx, qy, _, _) = client.getBasePositionAndOrientation(body)
    assert math.hypot(x, y) < 0.005
    assert z == pytest.approx(half, abs=0.002)
    assert math.degrees(math.acos(1 - 2 * (qx * qx + qy * qy))) < 1.5


def test_nearly_every_category_in_use_stands_in_a_short_run() -> None:
    assert not fallen(CATALOG.used_categories[::6], GLANCE_STEPS)


def test_sliced_food_comes_to_rest() -> None:
    pieces = [name for name in CATALOG.category_names if name.startswith(("half_", "sliced_"))]
    assert len(pieces) > 200
    assert not fallen(pieces, GLANCE_STEPS)


@pytest.mark.slow
def test_every_category_stands_for_two_seconds() -> None:
    assert not fallen(CATALOG.category_names, STEPS_OF_TWO_SECONDS)


def test_object_on_its_edge_is_reported() -> None:
    book = build_asset(CATALOG, "hardback", CATALOG.models_of("hardback")[0].model_id)
    lean = Link("base", tuple(replace(part, pose=LEANING @ part.pose) for part in book.links[0].parts))
    (finding,) = check_standing(CATALOG, [replace(book, links=(lean,), size_m=(0.2, 0.2, 0.2))])
    assert finding.rule is AssetRule.STANDS
    assert not finding.excused


def fallen(categories: Sequence[str], least_steps: int) -> list[AssetFinding]:
    """Return the unexcused findings for the first model of each category."""
    assets = [build_asset(CATALOG, name, CATALOG.models_of(name)[0].model_id) for name in categories]
    return [f for f in check_standing(CATALOG, assets, least_steps) if not f.excused]
