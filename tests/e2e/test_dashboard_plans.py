"""Page of one plan or episode that a trainer reported, in a real browser."""

import pytest
from tests.e2e.test_dashboard_in_use import FAINT, UNNAMED, window
from tests.integration.test_manager_service import manager

from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.training import RewardTiers, SampledPlan, SampledStep, SampledTurn, TrainingReport
from embomatrix.skills.parse import plan_from_json, plan_to_lines
from embomatrix.world.dataset import Dataset

SCRIPT = "<script>document.title = 'taken'</script>"
pytestmark = [pytest.mark.browser, pytest.mark.timeout(300)]


def reported(record):
    """Return an episode of the task, with an answer that is no call and a failed one, and the oracle's plan as a whole."""
    calls = [plan_to_lines((call,)) for call in plan_from_json(list(record.oracle))]
    steps = (
        SampledStep("open", False, "there is no object with index 99", "open 99"),
        *(SampledStep(call.split()[0], True, f"did {call}", call) for call in calls),
    )
    turns = (
        SampledTurn(SCRIPT, "Not an action", 0),
        SampledTurn("open 99", "open 99: failed", 1),
        *(SampledTurn(call, f"{call}: worked", 1) for call in calls),
        SampledTurn("done", "", 0),
    )
    task = record.task
    tiers = RewardTiers(0.5, 0.4, 30.0, True)
    text = "\n".join(turn.answer for turn in turns)
    episode = SampledPlan(
        *(task.task_id, task.instruction, text, tiers, 1.5, "", steps), turns, "Rooms: kitchen_0", "done"
    )
    whole = SampledPlan(task.task_id, task.instruction, "\n".join(calls), tiers, -0.5, "", steps[1:])
    return episode, whole


@pytest.mark.parametrize(("size", "theme"), [("desk", "light"), ("phone", "dark")])
async def test_an_episode_is_watched_turn_by_turn_on_the_floor_plan(browser, kitchen, tmp_path, size, theme):
    record = Dataset.load(kitchen).train[0]
    episode, whole = reported(record)
    async with manager(tmp_path / "data", dataset=kitchen) as at, ClusterClient(at.address) as client:
        run_id = await client.open_run("evening")
        await client.report_training(run_id, TrainingReport("grpo", 7, {"reward": 1.0}, (episode, whole)))
        async with window(browser, at.status_url, size=size, theme=theme) as opened:
            page = opened.page
            await opened.open(f"training?{run_id}")
            await page.get_by_role("link", name="Watch turn by turn").click()
            await opened.until("#said", f"^0 of {len(episode.turns)}$")
            main = await opened.words("main")
            assert record.task.instruction in main
            assert "The episode ended after" in main
            assert "the policy said that it was done" in main
            assert await page.locator(".calls button").count() == len(episode.turns) + 1
            assert await page.locator("svg.floor").count() == 1
            start = await page.locator("circle.robot").get_attribute("cx")
            for number in (1, 2):  # neither moves the robot
                await page.get_by_role("button", name="Next").click()
                await opened.until("#said", f"^{number} of ")
                assert await page.locator("circle.robot").get_attribute("cx") == start
            assert await page.locator(".calls .told.bad").count() == 2
            await page.get_by_role("button", name="Next").click()
            assert await page.locator("circle.robot").get_attribute("cx") != start
            assert await page.evaluate(UNNAMED) == []
            assert await page.evaluate(FAINT) == []
            assert await page.evaluate("document.documentElement.scrollWidth <= innerWidth")

            await page.locator("a.other", has_text="2").click()
            await opened.until("#said", f"^0 of {len(record.oracle)}$")
            assert "What the policy wrote" in await page.locator("main").text_content()
            await page.get_by_role("link", name="Training of this run").click()
            await page.get_by_role("link", name="Watch call by call").wait_for()
            assert opened.wrong == []


async def test_a_plan_without_its_dataset_is_shown_without_a_floor_plan(browser, kitchen, tmp_path):
    episode, _ = reported(Dataset.load(kitchen).train[0])
    async with manager(tmp_path / "data") as at, ClusterClient(at.address) as client:
        run_id = await client.open_run("evening")
        await client.report_training(run_id, TrainingReport("grpo", 7, {"reward": 1.0}, (episode,)))
        async with window(browser, at.status_url) as opened:
            await opened.open(f"training?{run_id}&1")
            await opened.until("#said", f"^0 of {len(episode.turns)}$")
            assert "no dataset is shown" in await opened.words("main")
            await opened.page.get_by_role("button", name="Next").click()
            await opened.until("#said", "^1 of ")
            assert opened.wrong == []
            await opened.open(f"training?{run_id}&9")
            await opened.until("main", "expected a number from 1 to 1, found 9")
