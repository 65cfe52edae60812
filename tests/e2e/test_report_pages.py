"""Reports of training, of an evaluation and of a cluster run in a browser: both themes, on desktops and phones."""

import re

import pytest
from tests.e2e.test_bad_cluster import manager, worker
from tests.e2e.test_dashboard_in_use import FAINT, SIZES, UNNAMED, window
from tests.fakes.commands import run_anew

SMALLEST_PX = 9
"""Smallest letters that a reader can be asked to read."""
TINY = """smallest => [...document.querySelectorAll("body *")].filter(part => part.getClientRects().length
        && [...part.childNodes].some(node => node.nodeType === 3 && node.textContent.trim()) && !part.closest("title"))
    .map(part => {
        const drawn = part.getScreenCTM?.(), scale = drawn ? Math.hypot(drawn.a, drawn.b) : 1;
        return [parseFloat(getComputedStyle(part).fontSize) * scale, part.textContent.trim().slice(0, 40)];
    })
    .filter(([size]) => size < smallest)"""
"""Words with smaller letters than asked for, as they are drawn."""
DRAWN_FAINT = """() => {
    const light = text => {
        const linear = n => n <= 0.03928 ? n / 12.92 : ((n + 0.055) / 1.055) ** 2.4;
        const [r, g, b] = text.match(/[\\d.]+/g).map(n => linear(n / 255));
        return 0.2126 * r + 0.7152 * g + 0.0722 * b;
    };
    const under = part => part.classList.contains("number") ? getComputedStyle(part.previousElementSibling).fill
        : getComputedStyle(part.closest("section")).backgroundColor;
    return [...document.querySelectorAll("svg text")].map(part => {
        const [over, behind] = [light(getComputedStyle(part).fill), light(under(part))].sort((a, b) => b - a);
        return [(over + 0.05) / (behind + 0.05), part.textContent.trim().slice(0, 40)];
    }).filter(([contrast]) => contrast < 4.5);
}"""
"""Words of drawings with too little contrast: numbers on their circles, all others on their card."""
SMALL = """
[tiny]
layers = 1
width = 16
heads = 1
inner = 16

[grpo]
tasks_per_step = 2
group = 4

[evaluation]
samples = 2
"""
"""Settings of a training that takes seconds."""
pytestmark = [pytest.mark.browser, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def reports(kitchen, tmp_path_factory):
    """Return the files of the three reports by name, written by the commands."""
    folder = tmp_path_factory.mktemp("reports")
    asked = ("eval", f"--bench={kitchen}", "--split=all", "--baseline=random", "--samples=3", "--jobs=1")
    with manager(folder / "data", "--state=memory:") as (_, address, _), worker(folder / "cache", address):
        train = ("train", f"--dataset={kitchen}", f"--manager={address}", "--threads=1", "--processes=1")
        small = folder / "small.toml"
        small.write_text(SMALL)
        steps = ("--imitate-steps=2", "--steps=2", "--evaluate-every=1", f"--settings={small}")
        closed = ("cluster", "report", "train", f"--manager={address}", f"--out={folder / 'run.html'}")
        for command in (
            (*train, *steps, f"--out={folder / 'train'}"),
            (*asked, f"--out={folder / 'eval'}"),
            closed,
        ):
            ended = run_anew(*command)
            assert ended.status == 0, ended.text
    return {
        "training": folder / "train" / "report.html",
        "evaluation": folder / "eval" / "report.html",
        "run": folder / "run.html",
    }


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
async def test_every_report_fits_its_window_and_can_be_read(browser, reports, size, theme):
    async with window(browser, "file://", size=size, theme=theme) as opened:
        page = opened.page
        for name, file in reports.items():
            await page.goto(file.as_uri())
            await page.evaluate("document.querySelectorAll('details').forEach(one => { one.open = true; })")
            beyond = await page.evaluate("document.documentElement.scrollWidth - innerWidth")
            assert beyond <= 0, f"{name} is {beyond} px wider than its window"
            assert await page.evaluate(UNNAMED) == [], name
            assert await page.evaluate(FAINT) == [], name
            assert await page.evaluate(DRAWN_FAINT) == [], name
            assert await page.evaluate(TINY, SMALLEST_PX) == [], name
        assert opened.wrong == []


async def test_reports_show_drawings_and_name_causes_alike(browser, reports):
    async with window(browser, "file://") as opened:
        for name, words in (("training", "Training of tiny"), ("evaluation", "random on"), ("run", "train")):
            await opened.page.goto(reports[name].as_uri())
            assert (await opened.words("h1")).startswith(words)
            assert await opened.page.locator("svg").count() >= 3, name
        await opened.page.goto(reports["evaluation"].as_uri())
        causes = await opened.words("section:has(h2:text-is('Why plans failed'))")
        assert not re.search(r"\b(goal_not_met|missing_step|wrong_order)\b", causes)
