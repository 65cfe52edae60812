"""`embomatrix cluster` with a real manager: tables and files of the cluster, and one sentence for each user error."""

import asyncio
import itertools
import json

import pytest
from tests.e2e.test_dashboard import cluster
from tests.fakes.browser import shown
from tests.fakes.commands import background, run
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import batch, manager, open_run, outcomes

from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.values import Batch, Completed, LookaheadEntry, Rollout
from embomatrix.skills.parse import plan_from_json
from embomatrix.world.dataset import Dataset

NOWHERE = "127.0.0.1:1"
UNREACHABLE = f"no manager answers at {NOWHERE}"


async def cluster_command(*arguments):
    return await asyncio.to_thread(run, "cluster", *arguments)


async def finished_run(kitchen, address):
    """Closed run of 40 rollouts on two slots."""
    dataset = Dataset.load(kitchen)
    record = dataset.train[0]
    digest, task, plan = record.bundle_digest, record.task.task_id, plan_from_json(list(record.oracle))
    rollouts = [Rollout(f"x{number}", f"g{number // 8}", digest, task, plan, number) for number in range(40)]
    there = f"--manager={address}"
    async with ClusterClient(address) as client:
        await client.open_run("evening", "r1")
        await client.put_bundles({digest: dataset.bundle_bytes(digest)})
        await client.announce_lookahead("r1", 1, [LookaheadEntry(7, digest, 40)])
        batch = Batch("r1", "b", 6, tuple(rollouts))
        results = [result async for result in client.execute(batch, deadline_s=60)]
        (cell,) = json.loads((await cluster_command("plan", "r1", there, "--json")).text)
        assert (cell["step"], cell["count"], cell["worker_ids"]) == (7, 40, ["kitchen-worker"])
        workers = await cluster_command("workers", there)
        assert "kitchen-worker ready 2 0 40 1 " in workers.text
        open_runs = await cluster_command("runs", there, "--json")
        assert [(run["run_id"], run["closed_s"]) for run in json.loads(open_runs.text)] == [("r1", 0.0)]
        await client.close_run("r1")
    return results


def assert_a_trace_of(events, rollouts):
    """Assert that spans of a slot never overlap and that every rollout ran once, after its submission."""
    tracks, executed = {}, []
    for event in events:
        if event["ph"] == "X":
            tracks.setdefault((event["pid"], event["tid"]), []).append(event)
        if event["name"] == "execute":
            executed.append(event["args"]["rollout"])
    assert sorted(executed) == sorted(rollouts)
    assert len(tracks) == 3, "submissions and two slots"
    for track in tracks.values():
        assert all(one["ts"] + one["dur"] <= two["ts"] + 0.01 for one, two in itertools.pairwise(track))
    (submitted,) = [event["ts"] for event in events if event["name"] == "submit 40"]
    assert all(event["ts"] >= submitted for event in events if event["name"] == "execute")


@pytest.mark.browser
async def test_report_and_trace_of_a_closed_run_show_its_rollouts(browser, kitchen, tmp_path):
    report, trace = tmp_path / "report.html", tmp_path / "trace.json"
    with cluster(tmp_path / "cluster") as (address, _):
        results = await finished_run(kitchen, address)
        there = f"--manager={address}"
        assert "r1 evening closed" in (await cluster_command("runs", "--closed", there)).text
        assert (await cluster_command("report", "r1", f"--out={report}", there)).status == 0
        assert (await cluster_command("trace", "evening", f"--out={trace}", there)).status == 0
        lines = (await cluster_command("events", "evening", "--json", there)).text
        fleet = await cluster_command("events", there)
    page = shown(browser, report.as_uri(), tmp_path)
    assert page.words["about"].startswith("run r1 · opened 20")
    assert page.words["workers"].split("share of the work ")[1].startswith("kitchen-worker 40 0 ")
    assert page.words["kept"].startswith("All ")
    done = [result.rollout_id for result in results if isinstance(result.outcome, Completed)]
    assert_a_trace_of(json.loads(trace.read_text())["traceEvents"], done)
    kinds = [event["kind"] for event in map(json.loads, lines.replace("} {", "}\n{").splitlines())]
    assert (kinds[0], kinds[-1], kinds.count("completed")) == ("run_opened", "run_closed", 40)
    assert "worker_joined worker=kitchen-worker size=2" in fleet.text


@pytest.mark.parametrize("command", ["workers", "plan", "events"])
def test_cluster_command_names_an_unreachable_manager(command):
    answer = run("cluster", command, f"--manager={NOWHERE}")
    assert (answer.status, UNREACHABLE in answer.text, "Traceback" in answer.text) == (2, True, False)


async def test_unknown_run_or_worker_error_names_the_remedy(tmp_path):
    async with manager(tmp_path) as at:
        there = f"--manager={at.address}"
        report = await cluster_command("report", "r9", there)
        assert (report.status, "no run 'r9' is open or kept" in report.text) == (2, True)
        revoke = await cluster_command("revoke", "w9", "--reason=a test", there)
        assert (revoke.status, "token" in revoke.text, "Traceback" in revoke.text) == (2, True, False)
        drain = await cluster_command("drain", "w9", there)
        assert (drain.status, "there is no worker 'w9'" in drain.text) == (2, True)
        assert (await cluster_command("workers", there)).text.startswith("no workers: start one")
        async with open_run(at.address):
            (tmp_path / "file").touch()
            written = await cluster_command("report", "r1", f"--out={tmp_path / 'file' / 'r.html'}", there)
        assert (written.status, "can't be written" in written.text) == (2, True)


async def test_report_and_trace_without_a_file_name_replace_only_their_own_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    async with manager(tmp_path / "data") as at, open_run(at.address):
        there = f"--manager={at.address}"
        for command, name in (("report", "r1.html"), ("trace", "r1.trace.json")):
            file = tmp_path / name
            file.write_text("mine")
            refused = await cluster_command(command, "r1", there)
            assert (refused.status, f"{name} was not written by this command" in refused.text) == (2, True)
            assert file.read_text() == "mine"
            assert (await cluster_command(command, "r1", there, "--force")).status == 0
            assert (await cluster_command(command, "r1", there)).status == 0
            file.write_text("mine")
            assert (await cluster_command(command, "r1", there, f"--out={file}")).status == 0
            assert file.read_text() != "mine", "a named file is replaced"


async def test_reports_are_found_by_name_and_an_ambiguous_name_lists_the_ids(tmp_path):
    async with manager(tmp_path) as at, ClusterClient(at.address) as client:
        there = f"--manager={at.address}"
        for run_id, name in (("r1", "morning"), ("r2", "evening"), ("r3", "evening"), ("evening", "night")):
            await client.open_run(name, run_id)
            if run_id != "r3":
                await client.close_run(run_id)
        named = await cluster_command("report", "morning", "--json", there)
        assert json.loads(named.text)["run"]["run_id"] == "r1"
        by_id = await cluster_command("report", "evening", "--json", there)
        assert json.loads(by_id.text)["run"]["name"] == "night", "an id comes before a name"
        await client.open_run("morning", "r4")
        twice = await cluster_command("report", "morning", there)
    assert twice.status == 2
    assert "2 runs are named 'morning': pass the id of one, r4 or r1;" in twice.text


async def test_run_of_a_killed_trainer_is_closed_by_name(tmp_path):
    async with manager(tmp_path) as at, ClusterClient(at.address) as client:
        there = f"--manager={at.address}"
        await client.open_run("evening", "r1")
        closed = await cluster_command("close", "evening", there)
        assert (closed.status, closed.text) == (0, "run r1, state closed, delivered 0")
        again = await cluster_command("close", "evening", there)
        assert (again.status, "run 'r1' is not open" in again.text) == (2, True)
        (kept,) = json.loads((await cluster_command("runs", "--closed", "--json", there)).text)
    assert kept["run_id"] == "r1"


async def test_operator_drains_and_resumes_a_worker_and_pauses_dispatch(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, worker_id="lab-pc"),
    ):
        there = f"--manager={at.address}"
        assert (await cluster_command("drain", "lab-pc", there)).text == "worker lab-pc, state draining"
        (row,) = json.loads((await cluster_command("workers", there, "--json")).text)
        assert row["state"] == "draining"
        assert (await cluster_command("resume", "lab-pc", there)).text == "worker lab-pc, state ready"
        with background(tmp_path / "log", "cluster", "events", "--follow", there) as following:
            await asyncio.to_thread(following.wait_for, "worker_joined worker=lab-pc")
            async with FakeWorker(at.address, worker_id="late-pc"):
                await asyncio.to_thread(following.wait_for, "worker_joined worker=late-pc")
            assert (await asyncio.to_thread(following.interrupt)).status == 0
        assert json.loads((await cluster_command("pause", there, "--json")).text) == {"dispatch": "paused"}
        waiting = asyncio.create_task(outcomes(client, batch(4)))
        await asyncio.sleep(0.3)
        assert not waiting.done()
        await cluster_command("resume", there)
        assert len(await waiting) == 4
