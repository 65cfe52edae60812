"""`embomatrix cluster` before a real manager: it shows what the cluster does, and what a person gets wrong in a sentence."""

import asyncio
import json

import pytest
from tests.fakes.browser import shown
from tests.fakes.commands import run
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import KITCHEN, batch, manager, open_run, outcomes

from embomatrix.rpc.values import Batch, LookaheadEntry

NOWHERE = "127.0.0.1:1"
UNREACHABLE = f"no manager answers at {NOWHERE}"


async def told(*arguments):
    return await asyncio.to_thread(run, "cluster", *arguments)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("cluster")


async def closed_run(folder, address):
    """A run of 41 rollouts on two slots, of which one crashes each time; closed when this ends."""
    async with (
        open_run(address) as client,
        FakeWorker(address, worker_id="lab-pc", slots=2, poison={"poison"}),
    ):
        good, bad = batch(40), batch(1, batch_id="b2", task="poison")
        await client.announce_lookahead("r1", 1, [LookaheadEntry(7, KITCHEN, 40)])
        await outcomes(client, Batch("r1", "mixed", 1, good.rollouts + bad.rollouts))
        (cell,) = json.loads((await told("plan", "r1", f"--manager={address}", "--json")).text)
        assert (cell["step"], cell["count"], cell["warmth"], cell["worker_ids"]) == (
            7,
            40,
            "warm",
            ["lab-pc"],
        )
        workers = await told("workers", f"--manager={address}")
        assert "lab-pc ready 2 0 40 1 1024" in workers.text
        open_runs = await told("runs", f"--manager={address}", "--json")
        assert [(run["run_id"], run["closed_s"]) for run in json.loads(open_runs.text)] == [("r1", 0.0)]
        await client.close_run("r1")


@pytest.mark.browser
async def test_report_and_trace_of_a_run_that_is_over_show_what_it_did(browser, folder):
    async with manager(folder / "data") as at:
        await closed_run(folder, at.address)
        there = f"--manager={at.address}"
        runs = await told("runs", "--closed", there)
        assert "r1 test closed" in runs.text
        report, trace = folder / "report.html", folder / "trace.json"
        assert (await told("report", "r1", f"--out={report}", there)).status == 0
        assert (await told("trace", "r1", f"--out={trace}", there)).status == 0
        lines = (await told("events", "r1", "--json", there)).text
        fleet = await told("events", there)
    page = shown(browser, report.as_uri(), folder)
    assert page.words["about"].startswith("run r1 · opened 20")
    assert "slot_crashed" in page.words["failures"]
    assert page.words["workers"].split("share of the work ")[1].startswith("lab-pc 40 3 ")
    assert page.words["kept"].startswith("All ")
    names = [event["name"] for event in json.loads(trace.read_text())["traceEvents"]]
    assert names.count("submit 41") == 1
    kinds = [event["kind"] for event in map(json.loads, lines.replace("} {", "}\n{").splitlines())]
    assert (kinds[0], kinds[-1], kinds.count("completed")) == ("run_opened", "run_closed", 40)
    assert "worker_joined worker=lab-pc size=2" in fleet.text


@pytest.mark.parametrize("command", ["workers", "runs", "plan", "pause", "resume-dispatch", "events"])
def test_a_manager_that_can_not_be_reached_is_named(command):
    answer = run("cluster", command, f"--manager={NOWHERE}")
    assert (answer.status, UNREACHABLE in answer.text, "Traceback" in answer.text) == (2, True, False)


async def test_what_is_not_there_is_named_with_what_to_do(tmp_path):
    async with manager(tmp_path) as at:
        there = f"--manager={at.address}"
        report = await told("report", "r9", there)
        assert (report.status, "no run 'r9' is open or kept" in report.text) == (2, True)
        drain = await told("drain", "w9", there)
        assert (drain.status, "there is no worker 'w9'" in drain.text) == (2, True)
        assert (await told("workers", there)).text.startswith("no workers: start one")
        async with open_run(at.address):
            written = await told("report", "r1", f"--out={tmp_path / 'no' / 'r.html'}", there)
        assert (written.status, "can't be written" in written.text) == (2, True)


async def test_a_worker_is_drained_and_taken_back_and_dispatch_is_paused(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, worker_id="lab-pc"),
    ):
        there = f"--manager={at.address}"
        assert (await told("drain", "lab-pc", there)).text == "worker lab-pc, state draining"
        (row,) = json.loads((await told("workers", there, "--json")).text)
        assert row["state"] == "draining"
        assert (await told("resume", "lab-pc", there)).text == "worker lab-pc, state ready"
        assert json.loads((await told("pause", there, "--json")).text) == {"dispatch": "paused"}
        waiting = asyncio.create_task(outcomes(client, batch(4)))
        await asyncio.sleep(0.3)
        assert not waiting.done()
        await told("resume-dispatch", there)
        assert len(await waiting) == 4
