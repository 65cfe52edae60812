"""The operator guide lists exactly the exported metrics."""

import re
from pathlib import Path

import pytest

from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.observe.metrics import ManagerLoad
from embomatrix.manager.observe.run_archive import RunArchive
from embomatrix.manager.runtime.bundles import BundleStore
from embomatrix.manager.runtime.event_loop import ManagerRuntime
from embomatrix.manager.runtime.registry import LivenessLimits, Registry
from embomatrix.manager.store.opening import open_store, timed_store
from embomatrix.manager.store.protocol import Namespace
from embomatrix.manager.web.prometheus import metrics_page

GUIDE = Path(__file__).parents[3] / "docs" / "operations.md"
OWN = re.compile(r"# (?:HELP|TYPE) (embo_\w+)")


@pytest.fixture
async def page(tmp_path):
    bundles = BundleStore(tmp_path / "bundles", total_bytes=1)
    cluster, registry = ClusterState(lease_key=b"key"), Registry(LivenessLimits())
    runtime = ManagerRuntime(cluster, registry, open_store("memory:"), bundles, RunArchive(tmp_path / "runs"))
    await runtime.start()
    return metrics_page(runtime)


async def test_documented_metrics_equal_the_exported_ones(page):
    found = re.findall(
        r"^\| `(embo_\w+)` \|([^|]*)\| [^|]+\| [^|]+ \|$", GUIDE.read_text(), flags=re.MULTILINE
    )
    assert [name for name, _ in found] == list(dict.fromkeys(OWN.findall(page)))
    for name, labels in found:
        samples = re.findall(rf"^{name}(?:_bucket|_count|_sum)?\{{([^}}]*)\}}", page, flags=re.MULTILINE)
        names = {label for sample in samples for label in re.findall(r'(\w+)="', sample)} - {"le"}
        assert names == set(re.findall(r"`(\w+)`", labels)), name


async def test_every_state_and_outcome_has_an_initial_sample(page):
    assert 'embo_slots{state="quarantined"} 0.0' in page
    assert 'embo_rollouts_total{outcome="slot_crashed"} 0.0' in page
    assert "embo_hedges_total 0.0" in page
    assert "embo_hedges_won_total 0.0" in page


def test_overhead_covers_the_last_minute():
    load = ManagerLoad()
    load.sample(0.0, 0.0, 0.0)
    assert load.overhead() == 0.0
    load.sample(10.0, 9.0, 1.0)
    assert load.overhead() == 0.0, "the slots hardly worked: the share would say nothing"
    load.sample(20.0, 9.0, 9.0)
    assert load.overhead() == 0.5
    for second in range(30, 200, 10):
        load.sample(second, 9.0 + second / 10, 9.0 + second * 1.8)
    assert load.overhead() == pytest.approx(0.1 / 1.9)
    assert load.core_share() == pytest.approx(0.1)
    assert load.slots_at_work() == pytest.approx(1.8)


async def test_store_operations_are_timed():
    took = []
    store = timed_store(open_store("memory:"), lambda name, seconds: took.append((name, seconds >= 0.0)))
    assert await store.runs() == []
    assert await store.rows(Namespace.CREDENTIALS) == []
    assert took == [("runs", True), ("rows", True)]
