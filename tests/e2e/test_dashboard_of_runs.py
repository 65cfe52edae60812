"""Pages of runs, of one worker and of the REST API in a browser: history, comparison, machine, log, and roles."""

import asyncio
import contextlib
import json
import re

import httpx
import pytest
from tests.e2e.test_dashboard import cluster
from tests.e2e.test_dashboard_in_use import FAINT, SIZES, UNNAMED, window
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import BEDROOM, BUNDLES, batch, manager

from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.tokens import AccessRole
from embomatrix.rpc.wire.training import RewardTiers, SampledPlan, SampledStep, TrainingReport
from embomatrix.rpc.wire.values import HostUse

SCRIPT = "<script>document.title = 'taken'</script>"
PLAN = SampledPlan(
    "t1",
    "tidy <b>up</b>",
    SCRIPT,
    RewardTiers(0.5, 0.2, 15.0, False),
    1.0,
    "",
    (SampledStep("move", True, "done"),),
)
PARTS = ("runs", "runs?r1", "runs?r1&r2", "runs?r9", "workers?w1", "workers?nobody", "rest")
pytestmark = [pytest.mark.browser, pytest.mark.timeout(300)]


@contextlib.asynccontextmanager
async def finished(tmp_path, **changes):
    """Yield a manager with a worker, two closed runs of one trainer each, and an open run."""
    token = changes.get("token", "")
    async with (
        manager(tmp_path, **changes) as at,
        FakeWorker(
            at.address,
            "w1",
            token=token,
            broken={BEDROOM},
            host=HostUse(0.3, 5000, 16_000),
            log_lines=[f"registered {SCRIPT}", "sent Bearer abc.def"],
        ),
        ClusterClient(at.address, token) as client,
    ):
        for run_id, name, success in (
            ("r1", "evening", 0.25),
            ("r2", f"night {SCRIPT}", 0.5),
            ("r3", "open", 0),
        ):
            await client.open_run(name, run_id)
            await client.put_bundles(BUNDLES)
            for step in (1, 2, 3):
                await client.report_training(
                    run_id, TrainingReport("grpo", step, {"reward": step, "success": success}, (PLAN,))
                )
            assert len([row async for row in client.execute(batch(8, run_id=run_id), deadline_s=60)]) == 8
            if run_id == "r1":
                lost = batch(1, batch_id="b2", scene=BEDROOM, run_id=run_id)
                assert len([row async for row in client.execute(lost, deadline_s=60)]) == 1
            if run_id != "r3":
                await client.close_run(run_id)
        yield at


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
async def test_every_part_fits_its_window_and_labels_its_parts(browser, tmp_path, size, theme):
    async with finished(tmp_path) as at, window(browser, at.status_url, size=size, theme=theme) as opened:
        for name in PARTS:
            await opened.open(name)
            await opened.page.wait_for_timeout(600)
            if name == "rest":
                await opened.page.evaluate(
                    "document.querySelectorAll('details').forEach(one => { one.open = true; })"
                )
            beyond = await opened.page.evaluate("document.documentElement.scrollWidth - innerWidth")
            assert beyond <= 0, f"{name} is {beyond} px wider than its window"
            assert await opened.page.evaluate(UNNAMED) == [], name
            assert await opened.page.evaluate(FAINT) == [], name
        assert {wrong for wrong in opened.wrong if "404" not in wrong} == set()
        assert "taken" not in await opened.page.title()


async def test_history_finds_runs_by_name_and_compares_two(browser, tmp_path):
    async with finished(tmp_path) as at, window(browser, at.status_url) as opened:
        page = opened.page
        await opened.open("runs")
        rows = await opened.until("#runs", "evening")
        assert re.search(r"open r3 open .* UTC .*night .* r2 closed .*evening r1 closed", rows)
        await page.get_by_label("search by name or id").fill("EVEN")
        await opened.until("#total", "1 to 1 of 1")
        assert "night" not in await opened.words("#runs")
        await page.get_by_label("search by name or id").fill("")
        await opened.until("#total", "1 to 3 of 3")
        assert await page.locator("#compare").is_disabled()
        await page.get_by_label("compare evening r1").check()
        await opened.until("#picked", "Tick another run")
        await page.wait_for_timeout(3500)  # a refresh keeps the tick
        await page.get_by_label(f"compare night {SCRIPT} r2").check()
        await page.locator("#compare").click()
        assert await opened.until("#title", "evening") == f"evening and night {SCRIPT}"
        totals = await opened.words("#totals")
        assert "completed rollouts 8 8 same" in totals
        assert "infrastructure failures 1 0 −1 better" in totals
        assert "success, latest steps 25.0 % 50.0 % +25.0 points better" in totals
        assert await page.locator("#curve-success canvas").count() == 1
        assert (await opened.words("#story0")).startswith("The run evening was open from 20")
        assert opened.wrong == []


async def test_page_of_a_closed_run_tells_its_story_and_is_saved_as_one_file(browser, tmp_path):
    async with finished(tmp_path / "data") as at, window(browser, at.status_url) as opened:
        page = opened.page
        await opened.open("runs")
        await page.locator("#runs a", has_text="evening").click()
        story = await opened.until("#story", "The run evening was open")
        assert "1 worker completed 8 rollouts; 1 rollout ended in an infrastructure failure." in story
        assert "scene_load_failed" in await opened.words("#lost")
        assert (
            f"did not reach the goal · reward 15.70 (format 0.50, relevance 0.20, goal 15.00) · advantage 1.00 · t1 "
            f"Watch call by call {SCRIPT}" in await opened.words("#sampled")
        )
        async with page.expect_download() as waiting:
            await page.get_by_role("button", name="Download report").click()
        report = tmp_path / "report.html"
        await (await waiting.value).save_as(report)
        async with page.expect_download() as waiting:
            await page.get_by_role("button", name="Download figures").click()
        figures = tmp_path / "figures.json"
        await (await waiting.value).save_as(figures)
        assert opened.wrong == []
        await page.goto(f"{at.status_url}#runs?r9")
        assert "no run 'r9' is open or kept" in await opened.until("#title", "r9")
    assert json.loads(figures.read_text())["run"]["name"] == "evening"
    text = report.read_text()
    assert not [part for part in ('src="/', "<script", "<button") if part in text]
    async with window(browser, report.as_uri()) as alone:
        await alone.page.goto(report.as_uri())
        assert (await alone.words("#story")).startswith("The run evening was open from 20")
        assert SCRIPT in await alone.words("#sampled")
        assert await alone.page.locator("img").count() == 3
        assert await alone.page.evaluate("[...document.images].every(one => one.naturalWidth > 0)")
        assert alone.wrong == []


async def test_training_of_an_archived_run_opens_after_a_restart(browser, tmp_path):
    async with finished(tmp_path):
        pass
    async with manager(tmp_path) as at, window(browser, at.status_url) as opened:
        await opened.open("runs?r1")
        await opened.until("#story", "Its trainer reported 3 steps of GRPO")
        await opened.page.locator("#curves").click()
        assert await opened.until("#step", "3") == "3"
        assert (await opened.words("#solved")) == "25 %"
        await opened.open("training?r9")
        assert "no training of run 'r9' was reported" in await opened.until("#nothing", "r9")


async def test_worker_page_shows_a_real_machine_and_log(browser, tmp_path):
    with cluster(tmp_path) as (_, url):
        async with window(browser, url) as opened:
            await opened.open("workers")
            await opened.page.locator("#workers a", has_text="kitchen-worker").click()
            log = await opened.until("#log", "registered with the manager")
            assert re.search(
                r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3}Z INFO worker kitchen-worker: 2 slots", log
            )
            assert re.fullmatch(
                r"\d+ % of \d+ cores? now, by all programs", await opened.until("#cpunow", "now")
            )
            assert re.fullmatch(r"[\d,]+ of [\d,]+ MB now, by all programs", await opened.words("#memorynow"))
            assert "UTC" in await opened.words("#cpu .u-legend")
            await opened.page.get_by_role("button", name="Drain").click()
            await opened.until("#facts", "draining|left")
            assert opened.wrong == []


async def test_viewer_finds_commands_disabled_with_the_reason_and_an_admin_uses_them(browser, tmp_path):
    async with finished(tmp_path, token="secret") as at:
        async with AdminClient(at.address, "secret") as admin:
            viewer, _ = await admin.issue_token(AccessRole.VIEWER)
        async with window(browser, at.status_url, token=viewer) as opened:
            page = opened.page
            for place, names in (("workers", ("Pause dispatch", "drain w1")), ("workers?w1", ("Drain",))):
                await opened.open(place)
                await opened.until(
                    "#allowed", "A token of the role viewer may only read: commands need an admin"
                )
                for name in names:
                    button = page.get_by_role("button", name=name)
                    assert await button.is_disabled(), name
                    assert "viewer may only read" in await button.get_attribute("title"), name
            await page.get_by_role("button", name="Enter another token").click()
            await page.keyboard.type("secret")
            await page.keyboard.press("Enter")
            await page.get_by_role("button", name="Drain").click()
            await opened.until("#facts", "draining|left")
            assert await opened.words("#allowed") == ""
            assert opened.wrong == []


async def _calls(url):
    """Return the calls of the manager's OpenAPI description."""
    async with httpx.AsyncClient(
        base_url=url, trust_env=False, headers={"authorization": "Bearer secret"}
    ) as http:
        paths = (await http.get("/api/v1/openapi.json")).json()["paths"]
    return [(path, method) for path, methods in paths.items() for method in methods]


async def test_rest_page_describes_every_call_and_sends_one(browser, tmp_path):
    async with (
        finished(tmp_path, token="secret") as at,
        window(browser, at.status_url, token="secret") as opened,
    ):
        page = opened.page
        await opened.open("rest")
        await opened.until("#calls", "/api/v1/snapshot")
        calls = await _calls(at.status_url)
        assert await page.locator("details.call").count() == len(calls)
        await page.get_by_label("search calls").fill("log lines")
        shown = page.locator("details.call:visible")
        assert await shown.count() == 1
        await shown.locator("summary").first.click()
        assert "Latest 50 lines of the worker's log" in await shown.inner_text()
        assert (
            f"curl -H \"Authorization: Bearer $EMBOMATRIX_TOKEN\" '{at.status_url.rstrip('/')}/api/v1/workers/office-3/log'"
            in await shown.inner_text()
        )
        await shown.get_by_label("worker_id").fill("w1")
        await shown.get_by_role("button", name="Send").click()
        await opened.until("details.call:visible pre[aria-live]", r"sent Bearer \*\*\*")
        assert opened.wrong == []
        async with asyncio.timeout(20), page.expect_download() as waiting:
            await page.get_by_role("button", name="Download OpenAPI").click()
        await (await waiting.value).save_as(tmp_path / "openapi.json")
    assert "/api/v1/snapshot" in json.loads((tmp_path / "openapi.json").read_text())["paths"]
