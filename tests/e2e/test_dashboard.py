"""The status page in a real browser, before a real manager with a real worker: what the cluster does is what the page shows."""

import contextlib
import re

import pytest
from tests.fakes.browser import shown
from tests.fakes.commands import background

from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.values import Batch, Completed, LookaheadEntry, Rollout
from embomatrix.skills.parse import plan_from_json
from embomatrix.world.dataset import Dataset

ROLLOUTS = 24
pytestmark = pytest.mark.browser


@contextlib.contextmanager
def cluster(folder, *options):
    """A manager and one worker of two slots; yields the manager's address and its page."""
    folder.mkdir(exist_ok=True)
    data = f"--data-dir={folder / 'data'}"
    serve = ("manager", "serve", "--port=0", "--http-port=0", "--state=memory:", data, *options)
    with background(folder / "manager.log", *serve) as manager:
        manager.wait_for("status page")
        found = re.search(r"manager serves at (\S+), status page (\S+),", manager.text)
        lend = ("worker", "run", f"--manager={found[1]}", "--slots=2", "--name=kitchen-worker")
        token = [item for item in options if item.startswith("--token")]
        with background(folder / "worker.log", *lend, f"--cache-dir={folder / 'cache'}", *token) as worker:
            worker.wait_for("registered with the manager")
            yield found[1], found[2]


async def test_page_shows_workers_slots_warm_scenes_and_throughput(browser, kitchen, tmp_path):
    dataset = Dataset.load(kitchen)
    record = dataset.train[0]
    digest = record.bundle_digest
    plan = plan_from_json(list(record.oracle))
    rollouts = tuple(
        Rollout(f"r{number}", "g", digest, record.task.task_id, plan, 0) for number in range(ROLLOUTS)
    )
    with cluster(tmp_path / "cluster") as (address, url):
        async with ClusterClient(address) as client:
            run_id = await client.open_run("evening <b>run</b>")
            await client.put_bundles({digest: dataset.bundle_bytes(digest)})
            await client.announce_lookahead(run_id, 1, [LookaheadEntry(7, digest, ROLLOUTS)])
            results = [item async for item in client.execute(Batch(run_id, "b", 1, rollouts), deadline_s=60)]
            assert all(isinstance(result.outcome, Completed) for result in results)
            page = shown(browser, url, tmp_path)
            workers = shown(browser, f"{url}#workers", tmp_path)
            ahead = shown(browser, f"{url}#lookahead", tmp_path)
            timeline = shown(browser, f"{url}#timeline", tmp_path)
            failures = shown(browser, f"{url}#failures", tmp_path)
    short = digest.removeprefix("sha256:")[:8]
    assert re.search(r"up \S+ \S+ · 1 ready", page.words["link"])
    assert page.words["health"].startswith("All is well.")
    assert re.search(rf"kitchen-worker ready 1 warm {short} .* {ROLLOUTS} ", workers.words["workers"])
    assert workers.classes.count("slot") + workers.classes.count("slot busy") == 2
    assert workers.classes.count("chip warm") == 1
    assert workers.words["total"] == "1 to 1 of 1"
    assert page.words["slots"] == "0/2"
    peak = re.fullmatch(rf"peak (\d+), {ROLLOUTS} in all", page.words["peak"])
    assert 1 < int(peak[1]) <= ROLLOUTS
    assert float(page.words["rate"]) >= 0
    assert page.words["runs"].startswith("run done open warm failed evening <b>run</b> 24 0 ")
    assert ahead.words["ahead"] == f"evening <b>run</b> {short[:4]} step 7 {ROLLOUTS}"
    assert ahead.classes.count("cell warm") == 1
    assert timeline.classes.count("gantt") == 1
    assert failures.words["failures"].startswith("None.")


def test_page_of_a_cluster_with_a_token_asks_for_it_and_shows_nothing(browser, tmp_path):
    with cluster(tmp_path / "cluster", "--token=the-secret") as (_, url):
        page = shown(browser, url, tmp_path)
    assert page.words["link"] == "the token is missing or wrong"
    assert "kitchen-worker" not in str(page.words)
