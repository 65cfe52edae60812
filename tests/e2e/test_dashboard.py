"""The status page in a real browser, before a real manager with a real worker: what the cluster does is what the page shows."""

import contextlib
import os
import re
import shutil
import subprocess
from html.parser import HTMLParser

import pytest
from tests.fakes.commands import background

from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.values import Batch, Completed, LookaheadEntry, Rollout
from embomatrix.skills.parse import plan_from_json
from embomatrix.world.dataset import Dataset

ROLLOUTS = 24
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def browser():
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None and os.environ.get("EMBOMATRIX_CI"):
        pytest.fail(f"none of {', '.join(BROWSERS)} is installed: CI checks the status page")
    if found is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is installed: install one to check the status page")
    return found


class Page(HTMLParser):
    """The words of a page by the id of the element that they stand in, and how often each class of element is there."""

    VOID = frozenset(("meta", "link", "input", "br", "line", "polygon", "polyline"))

    def __init__(self, source):
        super().__init__()
        self._open = []
        self.words = {}
        self.classes = []
        self.feed(source)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.classes.append(values.get("class") or "")
        if tag not in self.VOID:
            self._open.append((tag, values.get("id")))

    def handle_endtag(self, tag):
        while self._open and self._open.pop()[0] != tag:
            pass

    def handle_data(self, data):
        for _, name in self._open:
            if name:
                self.words[name] = " ".join(f"{self.words.get(name, '')} {data}".split())


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


def shown(browser, url, folder):
    """The page after its scripts ran for a few seconds."""
    result = subprocess.run(
        [
            browser,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            f"--user-data-dir={folder / 'profile'}",
            "--virtual-time-budget=5000",
            "--dump-dom",
            url,
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return Page(result.stdout)


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
            run_id = await client.open_run("evening-run")
            await client.put_bundles({digest: dataset.bundle_bytes(digest)})
            await client.announce_lookahead(run_id, 1, [LookaheadEntry(7, digest, ROLLOUTS)])
            results = [item async for item in client.execute(Batch(run_id, "b", 1, rollouts), deadline_s=60)]
            assert all(isinstance(result.outcome, Completed) for result in results)
            page = shown(browser, url, tmp_path)
    short = digest.removeprefix("sha256:")[:8]
    assert re.search(r"up \S+ \S+ · 1 ready", page.words["link"])
    assert re.search(rf"kitchen-worker ready 1 warm {short} .* {ROLLOUTS} ", page.words["workers"])
    assert page.classes.count("slot") + page.classes.count("slot busy") == 2
    assert page.classes.count("chip warm") == 1
    assert page.words["slots"] == "0/2"
    peak = re.fullmatch(rf"peak (\d+), {ROLLOUTS} in all", page.words["peak"])
    assert 1 < int(peak[1]) <= ROLLOUTS
    assert float(page.words["rate"]) >= 0
    assert page.words["runs"].startswith("run done open warm failed evening-run 24 0 ")
    assert page.words["ahead"] == f"step 7 {short[:4]}·{ROLLOUTS}"
    assert page.words["failures"].startswith("None.")


def test_page_of_a_cluster_with_a_token_asks_for_it_and_shows_nothing(browser, tmp_path):
    with cluster(tmp_path / "cluster", "--token=the-secret") as (_, url):
        page = shown(browser, url, tmp_path)
    assert page.words["link"] == "the token is missing or wrong"
    assert "kitchen-worker" not in str(page.words)
