"""Dashboard in both themes, on desktops and phones, by keyboard, and without its manager."""

import asyncio
import contextlib
import re

import pytest
from tests.fakes.commands import background
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import BEDROOM, KITCHEN, batch, manager, open_run

from embomatrix.cli.local_cluster import free_port
from embomatrix.rpc.wire.values import LookaheadEntry

SIZES = {"desk": (1366, 900), "phone": (390, 844)}
PAGES = ("overview", "workers", "lookahead", "timeline", "runs", "failures", "training", "tasks", "rest")
SCRIPT = "<script>document.title = 'taken'</script>"
LONG = "basement.with-a-rather-long-name-of-a-machine.lab.example.org"
UNNAMED = """() => [...document.querySelectorAll("a, button, input, select, canvas, [role=img], [role=region]")]
    .filter(part => part.offsetParent && !part.parentElement.closest("[role=img]") &&
        !(part.getAttribute("aria-label") ?? part.textContent).trim() && !part.labels?.length)
    .map(part => part.outerHTML.slice(0, 120))"""
FAINT = """() => {
    const numbers = text => text.match(/[\\d.]+/g).map(Number);
    const light = text => {
        const [r, g, b] = numbers(text).map(n => n / 255).map(n => n <= 0.03928 ? n / 12.92 : ((n + 0.055) / 1.055) ** 2.4);
        return 0.2126 * r + 0.7152 * g + 0.0722 * b;
    };
    const ground = part => {
        for (; part; part = part.parentElement) {
            const painted = getComputedStyle(part).backgroundColor, values = numbers(painted);
            if (values.length === 3 || values[3] === 1) return painted;
        }
    };
    const said = [...document.querySelectorAll("body *")].filter(part => part.offsetParent && !part.disabled
        && !part.closest("svg") && [...part.childNodes].some(node => node.nodeType === 3 && node.textContent.trim()));
    return said.map(part => {
        const [over, under] = [light(getComputedStyle(part).color), light(ground(part))].sort((a, b) => b - a);
        return [(over + 0.05) / (under + 0.05), part.textContent.trim().slice(0, 40)];
    }).filter(([contrast]) => contrast < 4.5);
}"""
"""Words with less contrast to what is behind them than WCAG's level AA asks of small text."""
pytestmark = [pytest.mark.browser, pytest.mark.timeout(300)]


class Window:
    """Page in a browser, with the errors that it logged."""

    def __init__(self, page, url):
        self.page = page
        self.url = url
        self.wrong = []
        page.on("pageerror", lambda error: self.wrong.append(str(error)))
        page.on("console", lambda said: said.type in ("error", "warning") and self.wrong.append(said.text))
        page.on("request", lambda asked: asked.url.startswith(url) or self.wrong.append(asked.url))

    async def open(self, name):
        """Open a page, or the part of one that follows a question mark."""
        await self.page.goto(f"{self.url}#{name}")
        await self.page.locator(f'nav a[href="#{name.split("?")[0]}"][aria-current]').wait_for()
        await self.page.locator("#health:visible").wait_for()

    async def words(self, selector):
        return " ".join((await self.page.locator(selector).inner_text()).split())

    async def until(self, selector, pattern):
        """Return the element's text once it satisfies the condition."""
        await self.page.locator(selector).filter(has_text=re.compile(pattern)).wait_for()
        return await self.words(selector)


def _brief(digest):
    return digest.removeprefix("sha256:")[:8]


@contextlib.asynccontextmanager
async def window(browser, url, *, size="desk", theme="light", token=""):
    playwright = pytest.importorskip("playwright.async_api")
    wide, high = SIZES[size]
    async with playwright.async_playwright() as driver:
        program = await driver.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        viewport = {"width": wide, "height": high}
        page = await program.new_page(viewport=viewport, color_scheme=theme)
        page.set_default_timeout(20_000)
        if token:
            await page.add_init_script(f"sessionStorage.setItem('token', '{token}')")
        yield Window(page, url)
        await program.close()


@contextlib.asynccontextmanager
async def ten_workers(address):
    """Start ten workers: one killed, one paused, one with many log lines; one of two scenes loads nowhere."""
    names = [LONG, *(f"office-{number}" for number in range(1, 10))]
    async with contextlib.AsyncExitStack() as stack, open_run(address) as client:
        workers = [FakeWorker(address, name, slots=2, broken={BEDROOM}) for name in names]
        workers[3].labels = {"room": "attic", "owner": SCRIPT}
        for worker in workers:
            await stack.enter_async_context(worker)
        workers[2].pause("its owner uses it")
        await client.announce_lookahead(
            "r1", 1, [LookaheadEntry(step, scene, 4) for step in (7, 8) for scene in (KITCHEN, BEDROOM)]
        )
        for wanted in (batch(8, batch_id="b1"), batch(2, batch_id="b2", scene=BEDROOM)):
            assert len([result async for result in client.execute(wanted, deadline_s=60)]) == len(
                wanted.rollouts
            )
        await workers[0].kill()
        yield workers


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
async def test_every_page_fits_its_window_and_labels_its_parts(browser, tmp_path, size, theme):
    async with (
        manager(tmp_path) as at,
        ten_workers(at.address),
        window(browser, at.status_url, size=size, theme=theme) as opened,
    ):
        for name in PAGES:
            await opened.open(name)
            await opened.page.wait_for_timeout(300)
            beyond = await opened.page.evaluate("document.documentElement.scrollWidth - innerWidth")
            assert beyond <= 0, f"{name} is {beyond} px wider than its window"
            assert await opened.page.evaluate(UNNAMED) == [], name
            assert await opened.page.evaluate(FAINT) == [], name
        assert opened.wrong == []


async def test_failures_and_script_names_are_shown_as_text(browser, tmp_path):
    async with manager(tmp_path) as at, ten_workers(at.address), window(browser, at.status_url) as opened:
        await opened.open("workers")
        rows = await opened.until("#workers", "lost")
        assert rows.startswith("worker state slots")
        assert f"{LONG} lost" in rows
        assert f"office-3 owner {SCRIPT}, room attic ready" in rows
        await opened.page.get_by_label("search by name or label").fill("room=ATT")
        await opened.until("#total", "1 to 1 of 1")
        await opened.open("failures")
        assert "scene_load_failed" in await opened.until("#failures", "scene_load_failed")
        assert LONG in await opened.words("#attempts")
        await opened.open("overview")
        assert await opened.words("#bad") == "2"
        assert "taken" not in await opened.page.title()


async def test_look_ahead_is_read_by_keyboard(browser, tmp_path):
    async with manager(tmp_path) as at, ten_workers(at.address), window(browser, at.status_url) as opened:
        await opened.open("lookahead")
        await opened.until("#cell", "Each cell shows")
        await opened.page.get_by_role("region", name="steps by scenes").focus()
        await opened.page.keyboard.press("Tab")
        (first, second), places = (
            sorted((KITCHEN, BEDROOM)),
            {KITCHEN: "warm, on", BEDROOM: "fits on no worker"},
        )
        await opened.until("#cell", f"^Step 7, {_brief(first)}: 4 rollouts, {places[first]}")
        await opened.page.keyboard.press("ArrowDown")
        await opened.until("#cell", f"^Step 8, {_brief(first)}: 4 rollouts, {places[first]}")
        await opened.page.keyboard.press("ArrowRight")
        await opened.until("#cell", f"^Step 8, {_brief(second)}: 4 rollouts, {places[second]}")
        await opened.page.keyboard.press("ArrowRight")
        await opened.page.wait_for_timeout(1500)  # a refresh keeps the scroll position
        assert (await opened.words("#cell")).startswith("Step 8, ")
        assert await opened.page.evaluate("document.activeElement.dataset.key.includes(' 8 ')")


async def _slots_shown_s(opened, pattern="shown"):
    """Return the visible duration of the timeline in seconds, once its labels fit."""
    number, unit = (await opened.until("#range", pattern)).split()[:2]
    return float(number) * {"ms": 0.001, "s": 1, "min": 60}[unit]


async def _point_at_a_rollout(opened):
    """Move the mouse over a rollout of the timeline and return the page position."""
    await opened.page.locator("canvas.gantt").wait_for()
    box = await opened.page.locator("canvas.gantt").bounding_box()
    for left in range(int(box["x"]) + 160, int(box["x"] + box["width"]), 6):
        await opened.page.mouse.move(left, box["y"] + 30)
        if "on office slot 1: completed" in await opened.words("#one"):
            return left, box["y"] + 30
    raise AssertionError("no rollout is on the timeline")


async def test_timeline_zooms_and_pans_with_the_mouse(browser, tmp_path):
    async with (
        manager(tmp_path) as at,
        FakeWorker(at.address, "office", slots=1, execute_s=0.3),
        open_run(at.address) as client,
        window(browser, at.status_url) as opened,
    ):
        assert len([result async for result in client.execute(batch(4), deadline_s=60)]) == 4
        await opened.open("timeline")
        left, top = await _point_at_a_rollout(opened)
        whole_s = await _slots_shown_s(opened)
        await opened.page.mouse.dblclick(left, top)
        one_s = await _slots_shown_s(opened)
        assert 0.3 <= one_s < min(3.0, whole_s)
        for key, times in (("Control", 1), ("Shift", 1), ("Control", -1), ("Shift", -1)):
            before_s = await _slots_shown_s(opened)
            async with _held_down(opened.page, key):
                # With Shift a wheel turns sideways.
                await opened.page.mouse.wheel(*((120 * times, 0) if key == "Shift" else (0, 120 * times)))
            await opened.page.wait_for_timeout(100)
            longer = await _slots_shown_s(opened) > before_s
            assert longer == (times > 0), f"{key} and the wheel by {times}"
        await opened.page.mouse.move(left, top)
        shown = await opened.words("#one")
        await opened.page.mouse.down()
        await opened.page.mouse.move(left + 400, top, steps=8)
        await opened.page.mouse.up()
        assert (await opened.words("#one")) == shown, "what was grabbed stays under the mouse"
        await opened.page.wait_for_timeout(1200)
        assert await _slots_shown_s(opened) == pytest.approx(one_s, rel=0.1), "a refresh takes no view away"
        await opened.page.locator("canvas.gantt").focus()
        await opened.page.keyboard.press("Escape")
        async with asyncio.timeout(20):
            while await _slots_shown_s(opened) < whole_s:
                await opened.page.wait_for_timeout(50)
        assert opened.wrong == []


@contextlib.asynccontextmanager
async def _held_down(page, key):
    await page.keyboard.down(key)
    yield
    await page.keyboard.up(key)


async def test_page_shows_its_age_without_a_manager_and_recovers(browser, tmp_path):
    port = free_port()
    serve = (
        "manager",
        "serve",
        "--port=0",
        f"--http-port={port}",
        "--state=memory:",
        f"--data-dir={tmp_path}",
    )

    async def at_work():
        manager = stack.enter_context(background(tmp_path / "manager.log", *serve))
        await asyncio.to_thread(manager.wait_for, "status page")

    async with window(browser, f"http://127.0.0.1:{port}/") as opened:
        with contextlib.ExitStack() as stack:
            await at_work()
            await opened.open("overview")
            await opened.until("#health", "No worker has joined yet")
        assert "the manager has not answered since" in await opened.until(
            "#health", "This page shows the state of"
        )
        with contextlib.ExitStack() as stack:
            await at_work()
            await opened.until("#health", "No worker has joined yet")
            assert await opened.page.locator("main.old").count() == 0


@pytest.mark.slow
async def test_thousand_workers_are_shown_in_pages_of_fifty(browser, tmp_path):
    async with manager(tmp_path, heartbeat_s=10.0) as at, contextlib.AsyncExitStack() as stack:
        for first in range(0, 1000, 20):
            some = [FakeWorker(at.address, f"pc-{number:04}") for number in range(first, first + 20)]
            await asyncio.gather(*(stack.enter_async_context(worker) for worker in some))
        async with window(browser, at.status_url) as opened:
            await opened.open("workers")
            await opened.until("#total", "1 to 50 of 1,000")
            await opened.page.get_by_role("button", name="Next").click()
            await opened.until("#total", "51 to 100 of 1,000")
            await opened.page.get_by_label("search by name or label").fill("pc-0777")
            await opened.until("#total", "1 to 1 of 1")
            for name in PAGES:
                await opened.open(name)
            assert opened.wrong == []
