"""Figures of the dashboard's pages against the REST API, while rollouts flow and after a worker was killed with SIGKILL."""

import asyncio
import contextlib
import itertools
import os
import re
import signal
import time
import zlib

import httpx
import pytest
from tests.e2e.test_dashboard_in_use import window
from tests.fakes import waiting
from tests.fakes.commands import background, run_anew

from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.values import Batch, Completed, InfraFailure, LookaheadEntry, Rollout
from embomatrix.skills.parse import plan_from_json
from embomatrix.world.dataset import Dataset
from embomatrix.world.inflation import bundle_digest

DAMAGED = zlib.compress(b"not a scene")
FAILED = 60
"""Rollouts in the damaged scene: more than the manager lists."""
SIZE = 64
"""Rollouts of a batch."""
HOLD_S = 2.8
"""Shorter than the silence after which the manager gives a worker nothing."""
ATTEMPTS = 20
"""Attempts to stop the workers while the first holds queued rollouts."""
NOTICED_S = 1.5
"""A worker whose connection broke is given up after a second."""
TEXTS = """() => Object.fromEntries([...document.querySelectorAll("main [id]")]
    .map(part => [part.id, part.innerText.replace(/\\s+/g, " ").trim()]))"""
ROWS = """id => [...document.querySelectorAll(`#${id} tbody tr`)].map(row => [...row.cells].map(cell =>
    (cell.querySelector("[role=img]")?.getAttribute("aria-label") ?? cell.innerText).replace(/\\s+/g, " ").trim()))"""
pytestmark = [pytest.mark.browser, pytest.mark.timeout(600)]


class Cluster:
    """Manager with two workers of one slot as real processes, and a run whose trainer submits without end."""

    def __init__(self, folder, dataset, stack):
        self._stack = stack
        self._record = dataset.train[0]
        self._bundle = dataset.bundle_bytes(self._record.bundle_digest)
        serve = ("manager", "serve", "--port=0", "--http-port=0", "--state=memory:")
        manager = stack.enter_context(
            background(folder / "manager.log", *serve, f"--data-dir={folder / 'data'}")
        )
        manager.wait_for("status page")
        found = re.search(r"manager serves at (\S+), status page (\S+),", manager.text)
        self.address, self.url = found[1], found[2]
        self.workers = [self._worker(folder, name) for name in ("first", "second")]
        for worker in self.workers:
            worker.wait_for("registered with the manager")
        self.results = []

    def _worker(self, folder, name):
        lend = ("worker", "run", f"--manager={self.address}", "--slots=1", f"--name={name}", "--no-sharing")
        return self._stack.enter_context(
            background(folder / f"{name}.log", *lend, f"--cache-dir={folder / name}")
        )

    def _batch(self, run_id, number, count, digest):
        plan = plan_from_json(list(self._record.oracle))
        task = self._record.task.task_id
        rollouts = (
            Rollout(f"b{number}-{at}", f"g{at}", digest, task, plan, number * SIZE + at)
            for at in range(count)
        )
        return Batch(run_id, f"b{number}", number, tuple(rollouts))

    async def submit(self, client, run_id, ended):
        """Submit batches until the event is set; the first one is in a scene that loads nowhere."""
        digest, damaged = self._record.bundle_digest, bundle_digest(DAMAGED)
        await client.put_bundles({digest: self._bundle, damaged: DAMAGED})
        await client.announce_lookahead(run_id, 1, [LookaheadEntry(1, digest, SIZE)])
        await self._execute(client, self._batch(run_id, 0, FAILED, damaged))
        for number in itertools.count(1):
            if ended.is_set():
                return
            await self._execute(client, self._batch(run_id, number, SIZE, digest))

    async def _execute(self, client, batch):
        self.results += [result async for result in client.execute(batch, deadline_s=60)]

    def completed(self):
        return sum(result.count for result in self.results if isinstance(result.outcome, Completed))

    def failed(self):
        return sum(result.count for result in self.results if isinstance(result.outcome, InfraFailure))

    async def kill_first_at_work(self, http):
        """Kill the first worker while it holds rollouts that nobody else has.

        With both workers stopped, nobody takes over what the first one holds before the manager notices its end.
        """
        first, second = (worker.process.pid for worker in self.workers)
        for _ in range(ATTEMPTS):
            if await self._stopped_with_work(first, second, http):
                break
        os.kill(first, signal.SIGKILL)
        await asyncio.sleep(NOTICED_S)
        os.kill(second, signal.SIGCONT)

    async def _stopped_with_work(self, first, second, http):
        ends_s = time.monotonic() + HOLD_S
        for pid in (first, second):
            os.kill(pid, signal.SIGSTOP)
        await asyncio.sleep(1.0)  # the manager gives out what is queued
        while time.monotonic() < ends_s:
            workers = (await http.get("workers")).json()["items"]
            if any(worker["worker_id"] == "first" and worker["waiting"] for worker in workers):
                return True
            await asyncio.sleep(0.1)
        for pid in (first, second):
            os.kill(pid, signal.SIGCONT)
        return False


def _count(number):
    return f"{number:,}"


def _counted(number, noun, ending="s"):
    return f"{_count(number)} {noun}{'' if number == 1 else ending}"


def _rate(per_second):
    recent = sum(per_second[-10:]) / 10
    return _count(int(recent + 0.5)) if recent >= 100 else f"{recent:.1f}"


def _failed(outcomes):
    return {name: n for name, n in outcomes.items() if name not in ("completed", "cancelled")}


def _overview(seen):
    """Texts of the overview by id."""
    now = seen["overview"]
    (run_,) = seen["runs"]
    stats = run_["stats"]
    overhead = now["overhead"]
    return {
        "rate": _rate(now["throughput"]),
        "peak": f"peak {_count(max(now['throughput']))}, {_count(now['outcomes']['completed'])} in total",
        "slots": f"{now['slots_at_work']:.1f}/{now['slots']}",
        "slotsnote": f"mean of a minute; {_counted(now['queued'], 'rollout')} queued",
        "overhead": f"{100 * overhead:.{1 if overhead < 0.1 else 0}f} %" if overhead else "–",
        "bad": _count(sum(_failed(now["outcomes"]).values())),
        "badnote": f"{_counted(now['redispatched'], 're-dispatch', 'es')}, {_counted(now['stale_results'], 'late result')}",
        "runs": (
            "evening",
            _count(stats["delivered"]),
            _count(run_["pending"]),
            _count(stats["infra_failures"]),
        ),
        "outcomes": {name: _count(n) for name, n in now["outcomes"].items()},
    }


async def _overview_shown(page):
    texts = await page.evaluate(TEXTS)
    rows = await page.evaluate(ROWS, "runs")
    return {
        **{
            name: texts[name] for name in ("rate", "peak", "slots", "slotsnote", "overhead", "bad", "badnote")
        },
        "runs": next(((row[0], row[1], row[2], row[5]) for row in rows), None),
        "outcomes": {row[0]: row[1] for row in await page.evaluate(ROWS, "outcomes")},
    }


def _workers(seen):
    """State, slots and completed rollouts by worker."""
    return {
        row["worker_id"]: (
            f"{row['state']} {row['reason']}".strip(),
            f"{row['busy']} of {row['slots']} busy",
            _count(row["completed"]),
        )
        for row in seen["workers"]["items"]
    }


async def _workers_shown(page):
    return {row[0]: (row[1], row[2], row[5]) for row in await page.evaluate(ROWS, "workers")}


def _failures(seen):
    now = seen["overview"]
    failed, again = sum(_failed(now["outcomes"]).values()), now["redispatched"]
    return {
        "sum": f"{_count(failed)} rollouts ended in an infrastructure failure, which is never scored as a reward. "
        f"Rollouts were leased again {_counted(again, 'time')}, after a lease that failed or expired.",
        "reasons": {name: _count(n) for name, n in _failed(now["outcomes"]).items()},
        "listed": f"the latest {len(now['failures'])} of {_count(failed)}",
    }


async def _failures_shown(page):
    texts = await page.evaluate(TEXTS)
    rows = await page.evaluate(ROWS, "reasons")
    return {
        "sum": texts["sum"],
        "reasons": {row[0]: row[1] for row in rows if row[1] != "0"},
        "listed": texts["listed"],
    }


def _runs(seen):
    return [
        (run_["name"], _count(run_["stats"]["delivered"]), _count(run_["stats"]["infra_failures"]))
        for run_ in seen["runs"]
    ]


async def _runs_shown(page):
    return [(row[1], row[6], row[8]) for row in await page.evaluate(ROWS, "runs")]


PAGES = {
    "overview": (_overview, _overview_shown),
    "workers": (_workers, _workers_shown),
    "failures": (_failures, _failures_shown),
    "runs": (_runs, _runs_shown),
}
"""Pages with their texts as the API's snapshot gives them, and as a reader sees them."""


async def _agreed(opened, http, name):
    """Open the page and return the snapshot that it shows. Raise AssertionError if it agrees with none for 20 s."""
    expected, read = PAGES[name]
    await opened.open(name)
    ends_s = time.monotonic() + 20
    while True:
        # All viewers within 0.9 s share one snapshot: soon the page's and this one are the same.
        seen = (await http.get("snapshot", params={"limit": 50})).json()
        shown = await read(opened.page)
        if shown == expected(seen):
            return seen
        assert time.monotonic() < ends_s, f"{name} shows {shown}, the API gives {expected(seen)}"
        await asyncio.sleep(0.1)


async def _agreed_on_every_page(opened, http):
    """Return the snapshot of each page, in order."""
    return [await _agreed(opened, http, name) for name in PAGES]


async def test_every_page_shows_the_figures_of_the_api_while_rollouts_flow_and_after_a_kill(
    browser, kitchen, tmp_path
):
    async with contextlib.AsyncExitStack() as stack:
        cluster = Cluster(tmp_path, Dataset.load(kitchen), stack)
        client = await stack.enter_async_context(ClusterClient(cluster.address))
        api = f"{cluster.url.rstrip('/')}/api/v1/"
        http = await stack.enter_async_context(httpx.AsyncClient(base_url=api, trust_env=False))
        opened = await stack.enter_async_context(window(browser, cluster.url))
        run_id = await client.open_run("evening")
        ended = asyncio.Event()
        trainer = asyncio.create_task(cluster.submit(client, run_id, ended))
        await waiting.until(lambda: cluster.completed() >= SIZE, limit_s=60)

        flowing = await _agreed_on_every_page(opened, http)
        assert flowing[-1]["overview"]["failed"] == FAILED == cluster.failed()
        assert {len(seen["overview"]["failures"]) for seen in flowing} == {50}

        await cluster.kill_first_at_work(http)
        await _until_workers_are(http, {"ready": 1, "lost": 1})
        killed = await _agreed_on_every_page(opened, http)
        assert killed[-1]["overview"]["workers"]["lost"] == 1
        assert killed[-1]["overview"]["slots_at_work"] > 0
        ended.set()
        await trainer

        await _until_all_are_counted(http, cluster)
        calm = (await _agreed_on_every_page(opened, http))[-1]["overview"]
        assert calm["redispatched"] > 0, "the kill hit no rollout: the test shows nothing"
        assert (calm["outcomes"]["completed"], calm["failed"]) == (cluster.completed(), cluster.failed())
        await _assert_run_page_agrees(opened, http, run_id, calm)
        await client.close_run(run_id)
        assert opened.wrong == []
        await _assert_reports_agree(opened, cluster, calm, tmp_path)


async def _until_workers_are(http, states):
    """Wait until the manager counts the workers in these states: a worker that was stopped is suspect for a while."""
    ends_s = time.monotonic() + 30
    while (seen := (await http.get("overview")).json()["workers"]) != states:
        assert time.monotonic() < ends_s, f"workers are {seen}, expected {states}"
        await asyncio.sleep(0.1)


async def _until_all_are_counted(http, cluster):
    """Wait for a snapshot that was taken after the last result: viewers share one for 0.9 s, and batches take less."""
    ends_s = time.monotonic() + 20
    while (outcomes := (await http.get("overview")).json()["outcomes"])["completed"] < cluster.completed():
        assert time.monotonic() < ends_s, f"{outcomes}, the trainer received {cluster.completed()} completed"
        await asyncio.sleep(0.1)


async def _assert_run_page_agrees(opened, http, run_id, calm):
    """Compare the page of the run with the API's totals, and these with the overview's."""
    totals = {total["name"]: total["value"] for total in (await http.get(f"runs/{run_id}")).json()["totals"]}
    assert totals["completed rollouts"] == calm["outcomes"]["completed"]
    assert totals["infrastructure failures"] == calm["failed"]
    assert totals["re-dispatches"] == calm["redispatched"]
    await opened.open(f"runs?{run_id}")
    await opened.until("#totals", "completed rollouts")
    tiles = await opened.page.locator("#totals .tile").all_inner_texts()
    shown = {name.lower(): value for name, value in (text.split("\n", 1) for text in tiles)}
    for name in ("completed rollouts", "infrastructure failures", "re-dispatches"):
        assert shown[name].strip() == _count(totals[name])
    rows = await opened.page.evaluate(ROWS, "work")
    assert sum(int(row[1].replace(",", "")) for row in rows) == totals["completed rollouts"]


async def _assert_reports_agree(opened, cluster, calm, folder):
    """Compare the report of the closed run, asked for by its name, and the metrics with the overview."""
    page = folder / "evening.html"
    ended = await asyncio.to_thread(
        run_anew, "cluster", "report", "evening", f"--manager={cluster.address}", f"--out={page}"
    )
    assert ended.status == 0, ended.text
    await opened.page.goto(page.as_uri())
    tile = await opened.words("section.tile:has-text('Completed')")
    assert tile.endswith(
        f"{_count(calm['outcomes']['completed'])} {_count(calm['failed'])} failed, "
        f"{_counted(calm['redispatched'], 're-dispatch', 'es')}"
    )
    assert "every lease brought a result" not in await opened.words("#failures")
    async with httpx.AsyncClient(trust_env=False) as http:
        metrics = (await http.get(f"{cluster.url.rstrip('/')}/metrics")).text
    assert f"embo_redispatched_total {float(calm['redispatched'])}" in metrics
    assert f'embo_rollouts_total{{outcome="completed"}} {float(calm["outcomes"]["completed"])}' in metrics
