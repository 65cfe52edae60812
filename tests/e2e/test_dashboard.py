"""Dashboard in a real browser, with a real manager and worker."""

import asyncio
import contextlib
import re

import pytest
from tests.fakes.browser import shown
from tests.fakes.commands import background
from tests.integration.test_manager_service import manager

from embomatrix.manager.web.gallery import no_tasks_yet
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.training import RewardTiers, SampledPlan, SampledStep, TrainingReport
from embomatrix.rpc.wire.values import Batch, Completed, LookaheadEntry, Rollout
from embomatrix.skills.parse import plan_from_json
from embomatrix.world.dataset import Dataset

ROLLOUTS = 24
pytestmark = pytest.mark.browser


@contextlib.contextmanager
def cluster(folder, *options):
    """Yield the gRPC address and page address of a manager with one worker of two slots."""
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
            await asyncio.sleep(1)  # throughput covers whole seconds
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
    assert re.fullmatch(r"[0-2]\.\d/2", page.words["slots"])
    peak = re.fullmatch(rf"peak (\d+), {ROLLOUTS} in total", page.words["peak"])
    assert 1 < int(peak[1]) <= ROLLOUTS
    assert float(page.words["rate"]) >= 0
    assert page.words["runs"].startswith("run done open warm shared failed evening <b>run</b> 24 0 ")
    assert ahead.words["ahead"] == f"evening <b>run</b> {short} step 7 {ROLLOUTS}"
    assert ahead.classes.count("cell warm") == 1
    assert timeline.classes.count("gantt") == 1
    assert failures.words["failures"].startswith("None.")


async def test_page_of_training_shows_curves_and_plans_and_runs_no_script_of_a_model(browser, tmp_path):
    steps = (SampledStep("pick_up", True, "holds the vase"), SampledStep("place", False, "it is closed"))
    solved = SampledPlan("t1", "Tidy <b>up</b>", "move 3", RewardTiers(0.5, 0.4, 30.0, True), 1.5, "", steps)
    script = "<script>document.title = 'taken'</script>"
    lost = SampledPlan("t1", "Tidy <b>up</b>", script, None, 0.0, "worker_lost: it went silent")
    async with manager(tmp_path / "data") as at, ClusterClient(at.address) as client:
        run_id = await client.open_run("evening run")
        for step in (1, 2, 3):
            figures = {"reward": 10.0 * step, "reward_goal": 9.0 * step, "success": 0.25, "entropy": 0.5}
            figures |= {"success_by_category/compound": 0.5, "spent_s/update": 30.0, "spent_s/sampling": 10.0}
            await client.report_training(run_id, TrainingReport("grpo", step, figures, (solved, lost)))
        before = TrainingReport("success before GRPO", 0, {"all": 0.21})
        await client.report_training(run_id, before)
        page = await asyncio.to_thread(shown, browser, f"{at.status_url}#training", tmp_path)
    assert (page.words["step"], page.words["reward"], page.words["solved"]) == ("3", "20.00", "25 %")
    assert page.words["success"] == "step 3 all 0.25 compound 0.5"
    assert page.words["spent"].startswith("activity share time update 75 % 30 s sampling 25 % 10 s")
    assert page.words["heldout"] == "tasks before GRPO after GRPO all tasks 21 % –"
    assert page.words["which"] == "with the largest reward differences in step 3: Tidy <b>up</b>"
    sampled = page.words["sampled"]
    assert sampled.startswith("reached the goal · reward 30.90 (format 0.50, relevance 0.40, goal 30.00)")
    assert "pick_up holds the vase place it is closed" in sampled
    assert (
        f"infrastructure failure, no reward · t1 Watch call by call worker_lost: it went silent {script}"
        in sampled
    )


async def test_training_page_without_reports_shows_the_command(browser, tmp_path):
    async with manager(tmp_path / "data") as at:
        page = await asyncio.to_thread(shown, browser, f"{at.status_url}#training", tmp_path)
    assert page.words["nothing"].startswith("No trainer has reported yet.")
    assert "sampled" not in page.words


async def test_task_pages_show_gallery_and_oracle_plan(browser, kitchen, tmp_path):
    dataset = Dataset.load(kitchen)
    record = dataset.train[0]
    async with manager(tmp_path / "data", dataset=kitchen) as at:
        page = await asyncio.to_thread(shown, browser, f"{at.status_url}#tasks", tmp_path)
        chosen = f"{at.status_url}#tasks?{record.task.task_id}"
        one = await asyncio.to_thread(shown, browser, chosen, tmp_path)
        none = await asyncio.to_thread(shown, browser, f"{at.status_url}#tasks?nothing", tmp_path)
    every = len(dataset.records)
    assert page.words["total"] == f"1 to {every} of {every} tasks, 1 scene"
    assert record.task.instruction in page.words["cards"]
    assert page.classes.count("card") == every
    assert page.classes.count("floor") > 0
    assert record.task.instruction in one.words["main"]
    assert one.words["said"] == f"0 of {len(record.oracle)}"
    assert one.classes.count("step") == len(record.oracle) + 1
    assert one.classes.count("goal") == len(record.task.goal_objects)
    assert one.classes.count("floor") == 1
    assert "the dataset has no task 'nothing'" in none.words["main"]


async def test_task_page_without_dataset_shows_the_option(browser, tmp_path):
    async with manager(tmp_path / "data") as at:
        page = await asyncio.to_thread(shown, browser, f"{at.status_url}#tasks", tmp_path)
    assert page.words["cards"] == "no dataset is shown: start the manager with --dataset FOLDER"


async def test_task_page_of_an_empty_folder_says_how_to_fill_it(browser, tmp_path):
    (tmp_path / "empty").mkdir()
    async with manager(tmp_path / "data", dataset=tmp_path / "empty") as at:
        page = await asyncio.to_thread(shown, browser, f"{at.status_url}#tasks", tmp_path)
    assert page.words["cards"] == no_tasks_yet(tmp_path / "empty")


async def test_unknown_page_says_so(browser, tmp_path):
    async with manager(tmp_path / "data") as at:
        page = await asyncio.to_thread(shown, browser, f"{at.status_url}#wrokers", tmp_path)
    assert page.words["unknown"].startswith("There is no page “wrokers”: choose one of overview, workers,")


def test_dashboard_asks_for_a_token(browser, tmp_path):
    with cluster(tmp_path / "cluster", "--token=the-secret") as (_, url):
        page = shown(browser, url, tmp_path)
    assert page.words["link"] == "this manager asks for a token"
    assert "kitchen-worker" not in str(page.words)
