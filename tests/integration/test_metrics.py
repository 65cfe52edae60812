"""Prometheus metrics of a busy manager."""

import asyncio
import itertools

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import KITCHEN, batch, manager, open_run, outcomes, until

from embomatrix.rpc.wire.run_log import RolloutPhase
from embomatrix.rpc.wire.values import Batch, LookaheadEntry, Warmth

pytestmark = pytest.mark.timeout(60)


async def scraped(http):
    text = (await http.get("/metrics")).raise_for_status().text
    return {
        (sample.name, *sorted(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


async def warmed(client, entries):
    """Announce these scenes until the manager reports all of them warm, so that later requests are hits."""
    async with asyncio.timeout(10):
        for version in itertools.count(1):
            if set((await client.announce_lookahead("r1", version, entries)).values()) == {Warmth.WARM}:
                return
            await asyncio.sleep(0.02)


async def test_metrics_under_load_are_consistent(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, slots=4, execute_s=0.01, poison={"poison"}) as worker,
        httpx.AsyncClient(base_url=at.status_url, trust_env=False) as http,
    ):
        await warmed(client, [LookaheadEntry(1, KITCHEN, 200)])
        good, bad = batch(200), batch(1, batch_id="b2", task="poison")
        running = asyncio.create_task(outcomes(client, Batch("r1", "mixed", 1, good.rollouts + bad.rollouts)))
        await until(lambda: len(worker.executed) > 20)
        during = await scraped(http)
        await running
        after = await scraped(http)
        await client.close_run("r1")
        closed = await scraped(http)
    assert during["embo_leases",] >= 4
    assert during["embo_slots", ("state", "running")] == 4
    assert during["embo_leases",] + during["embo_queue_depth",] <= 201
    assert after["embo_slots", ("state", "warm")] == 4
    assert after["embo_rollouts_total", ("outcome", "completed")] == 200
    assert after["embo_rollouts_total", ("outcome", "slot_crashed")] == 1
    for phase in RolloutPhase:
        assert after["embo_rollout_seconds_count", ("phase", phase.value)] == 200
    assert after["embo_rollout_seconds_sum", ("phase", "execute")] == pytest.approx(0.2)
    assert after["embo_attempts_bucket", ("le", "1")] == 200
    assert after["embo_attempts_bucket", ("le", "3")] == 201
    assert after["embo_attempts_sum",] == 203
    assert after["embo_prewarm_hits_total",] == 1
    assert after["embo_scene_load_seconds_count",] == 1
    assert after["embo_store_op_seconds_count", ("op", "append_results")] > 0
    assert after["process_cpu_seconds_total",] > 0
    assert closed["embo_runs",] == 0
    counters = [key for key in after if key[0].endswith(("_total", "_count", "_bucket"))]
    assert counters
    assert all(closed[key] >= after[key] >= during.get(key, 0.0) for key in counters)


async def test_runs_and_events_can_be_read_without_grpc(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, slots=2, poison={"poison"}),
        httpx.AsyncClient(base_url=at.status_url, trust_env=False) as http,
    ):
        good, bad = batch(8), batch(1, batch_id="b2", task="poison")
        await outcomes(client, Batch("r1", "mixed", 1, good.rollouts + bad.rollouts))
        await client.close_run("r1")
        run = (await http.get("/api/v1/runs/r1")).json()
        events = (await http.get("/api/v1/events", params={"run": "r1", "after": 2})).json()["events"]
        fleet = (await http.get("/api/v1/events")).json()["events"]
        missing = await http.get("/api/v1/runs/r2")
    assert (run["run"]["stats"]["delivered"], run["phases"]["execute"]["count"]) == (9, 8)
    assert run["failures"][0]["code"] == "slot_crashed"
    assert [event["kind"] for event in events].count("completed") == 8
    assert events[0]["sequence"] > 2
    assert "worker_joined" in [event["kind"] for event in fleet]
    assert (missing.status_code, "no run 'r2'" in missing.text) == (404, True)


async def test_metrics_page_size_is_bounded(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, slots=2),
        httpx.AsyncClient(base_url=at.status_url, trust_env=False) as http,
    ):
        await outcomes(client, batch(4))
        first = await scraped(http)
        for number in range(5):
            await outcomes(client, batch(20, batch_id=f"more-{number}"))
        new = set(await scraped(http)) - set(first)
    # The store's protocol bounds its operations; each appears once it has happened.
    assert {key[0].rpartition("_")[0] for key in new} <= {"embo_store_op_seconds"}
