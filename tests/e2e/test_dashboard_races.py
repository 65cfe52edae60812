"""Dashboard whose answers come late, are refused, or are of another manager."""

import asyncio
import json
import re

import pytest
from tests.e2e.test_dashboard_in_use import window
from tests.e2e.test_dashboard_of_runs import finished
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import manager

from embomatrix.world.dataset import Dataset

pytestmark = [pytest.mark.browser, pytest.mark.timeout(300)]


class Late:
    """Answer that is held back until it is released, the first one to a path."""

    def __init__(self):
        self.asked = asyncio.Event()
        self.released = asyncio.Event()

    async def __call__(self, route):
        if self.asked.is_set():
            await route.continue_()
            return
        self.asked.set()
        await self.released.wait()
        await route.continue_()


def failures_of(opened):
    """Return the errors of a page, except for refused requests."""
    return [wrong for wrong in opened.wrong if "Failed to load resource" not in wrong]


async def answer(route, change):
    """Answer with what the manager answers, after a change."""
    response = await route.fetch()
    body = await response.json()
    change(body)
    await route.fulfill(response=response, json=body)


async def test_task_that_arrives_after_its_page_was_left_is_not_shown(browser, kitchen, tmp_path):
    record, late = Dataset.load(kitchen).train[0], Late()
    async with (
        manager(tmp_path / "data", dataset=kitchen) as at,
        window(browser, at.status_url) as opened,
    ):
        await opened.page.route(re.compile(r"/api/v1/tasks/"), late)
        await opened.open(f"tasks?{record.task.task_id}")
        await late.asked.wait()
        await opened.open("overview")
        await opened.until("#slots", "0")
        late.released.set()
        await opened.page.wait_for_timeout(1500)
        assert await opened.page.locator("#slots").count() == 1
        assert await opened.words("#states") == "no workers"
        assert failures_of(opened) == []


async def test_task_is_shown_without_its_picture_and_says_why(browser, kitchen, tmp_path):
    record = Dataset.load(kitchen).train[0]

    def promised(detail):
        detail["card"]["picture"] = True

    async with (
        manager(tmp_path / "data", dataset=kitchen) as at,
        window(browser, at.status_url) as opened,
    ):
        await opened.page.route(re.compile(r"/api/v1/tasks/"), lambda route: answer(route, promised))
        await opened.open(f"tasks?{record.task.task_id}")
        assert "embomatrix factory pictures" in await opened.until("#picture", "no picture")
        assert record.task.instruction in await opened.words("main")
        assert failures_of(opened) == []


async def test_failures_of_a_manager_that_started_anew_replace_the_former_ones(browser, tmp_path):
    logs = {"former": [("old-pc", 5), ("old-pc", 6)], "present": [("new-pc", 1)]}
    leader = "former"

    async def events(route):
        after = int(re.search(r"after=(\d+)", route.request.url)[1])
        found = [
            {"sequence": number, "at_s": 1.8e9, "kind": "worker_lost", "worker_id": name}
            for name, number in logs[leader]
            if number > after
        ]
        await route.fulfill(json={"events": found, "dropped": 0})

    def aged(seen):
        seen["overview"]["uptime_s"] += 3600.0 if leader == "former" else 0.0

    async with manager(tmp_path) as at, window(browser, at.status_url) as opened:
        await opened.page.route(re.compile(r"/api/v1/events\?"), events)
        await opened.page.route(re.compile(r"/api/v1/snapshot"), lambda route: answer(route, aged))
        await opened.open("failures")
        await opened.until("#attempts", "old-pc")
        leader = "present"
        assert "old-pc" not in await opened.until("#attempts", "new-pc")
        assert failures_of(opened) == []


async def test_curves_of_the_run_that_was_chosen_last_are_shown(browser, tmp_path):
    late = Late()
    async with finished(tmp_path) as at, window(browser, at.status_url) as opened:
        await opened.page.route(re.compile(r"/api/v1/training/r1$"), late)
        await opened.open("training?r1")
        await late.asked.wait()
        await opened.page.get_by_label("run").select_option("r2")
        await opened.until("#solved", "50")
        late.released.set()
        await opened.page.wait_for_timeout(1500)
        assert await opened.words("#solved") == "50 %"
        assert await opened.words("#solvednote") == "mean of 3 steps"
        assert failures_of(opened) == []


async def test_worker_page_shows_no_former_facts_with_a_refusal_and_recovers(browser, tmp_path):
    refused = False

    async def worker(route):
        if refused:
            await route.fulfill(status=404, json={"detail": "there is no worker 'w1'"})
        else:
            await route.continue_()

    async with finished(tmp_path) as at, window(browser, at.status_url) as opened:
        await opened.page.route(re.compile(r"/api/v1/workers/w1$"), worker)
        await opened.open("workers?w1")
        await opened.until("#facts", "slots")
        refused = True
        await opened.until("#title", "there is no worker")
        assert await opened.words("#facts") == ""
        assert await opened.page.locator("#log:visible, #scenes:visible, #cpu:visible").count() == 0
        refused = False
        assert await opened.until("#title", "^w1$") == "w1"
        await opened.page.locator("#log:visible").wait_for()
        assert failures_of(opened) == []


async def test_page_beyond_the_end_leads_to_the_last_one_and_a_quarantine_can_be_lifted(browser, tmp_path):
    total = 60

    def changed(seen):
        page = seen["workers"]
        page["total"] = total
        if page["offset"] >= 50:
            page["items"] = []
        for row in page["items"]:
            row["state"] = "quarantined"

    async def counted(route):
        nonlocal total
        if "offset=50" in route.request.url:
            total = 1
        await answer(route, changed)

    async with (
        manager(tmp_path) as at,
        FakeWorker(at.address, "w1"),
        window(browser, at.status_url) as opened,
    ):
        await opened.page.route(re.compile(r"/api/v1/snapshot"), counted)
        await opened.open("workers")
        await opened.until("#total", "1 to 1 of 60")
        await opened.page.get_by_role("button", name="Next").click()
        await opened.until("#total", "1 to 1 of 1$")
        assert "No workers yet" not in await opened.words("#workers")
        assert await opened.page.get_by_role("button", name="resume w1").count() == 1
        assert failures_of(opened) == []


async def test_refused_filter_is_told_and_not_taken_for_silence(browser, tmp_path):
    why = "query search: string should have at most 128 characters"

    async def refused(route):
        if "search=long" in route.request.url:
            await route.fulfill(status=422, body=json.dumps({"detail": why}))
        else:
            await route.continue_()

    async with manager(tmp_path) as at, window(browser, at.status_url) as opened:
        await opened.page.route(re.compile(r"/api/v1/snapshot"), refused)
        await opened.open("workers")
        search = opened.page.get_by_label("search by name or label")
        assert await search.get_attribute("maxlength") == "128"
        await search.fill("long")
        await opened.until("#states", f"^{why}$")
        assert (await opened.words("#health")).endswith(f": {why}.")
        await search.fill("")
        await opened.until("#health", "No worker has joined yet")
        assert failures_of(opened) == []
