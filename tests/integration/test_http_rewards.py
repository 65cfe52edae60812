"""Rewards over HTTP: OpenRLHF's format, access, and refusals."""

import ast
import asyncio

import httpx
import pytest
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.documents import snippets
from tests.fakes.guarded import guarded
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import KITCHEN, manager, open_run
from tests.integration.test_rest import http_at

from embomatrix.manager.web.rewards import REWARDS, RUN_ID, run_of
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.reward_label import RewardLabel
from embomatrix.rpc.wire.tokens import AccessRole
from embomatrix.trainer.adapters.openrlhf import rows
from embomatrix.world.task import Profile

pytestmark = pytest.mark.timeout(60)
PROMPT = 'Answer with a plan, such as [{"action": "move", "object_index": 1}].'
LABEL = RewardLabel("t", KITCHEN, Profile.PAPER, 7).text()


def asked(*answers, prompt=PROMPT, label=LABEL, mark=""):
    count = len(answers)
    return {
        "query": [f"{mark}{prompt}{answer}" for answer in answers],
        "prompts": [prompt] * count,
        "labels": [label] * count,
    }


async def test_plans_are_scored_in_order_and_unparsable_texts_are_not_executed(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address),
        FakeWorker(at.address, slots=2) as worker,
        http_at(at) as http,
    ):
        answer = await http.post(REWARDS, json=asked("move 3", "I can't.", "open 2", mark="<s>"))
        runs = (await http.get("/api/v1/runs")).json()["items"]
    assert answer.status_code == 200, answer.text
    answered = answer.json()
    assert answered["rewards"] == [pytest.approx(15.7), -1.0, pytest.approx(15.7)]
    assert answered["scores"] == [0.0, 0.0, 0.0]
    assert {name: len(values) for name, values in answered["extra_logs"].items()} == {
        "format": 3,
        "relevance": 3,
        "goal": 3,
    }
    assert len(worker.executed) == 2
    assert RUN_ID in {run["run_id"] for run in runs}


async def test_address_names_coefficients_and_requests_with_equal_ones_share_a_run(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address),
        FakeWorker(at.address, slots=2),
        http_at(at) as http,
    ):
        answers = [
            await http.post(f"{REWARDS}{query}", json=asked("move 3", "I can't."))
            for query in (
                "?goal=10&unparsable=-2",
                "?unparsable=-2.0&goal=10.0",
                "?unparsable=-3",
                "?goal=30",
            )
        ]
        runs = {run["run_id"] for run in (await http.get("/api/v1/runs")).json()["items"]}
        refused = [
            await http.post(f"{REWARDS}?{query}", json=asked("move 3"))
            for query in ("goal=-1", "goal=much", "gaol=1")
        ]
    assert [answer.json()["rewards"][1] for answer in answers] == [-2.0, -2.0, -3.0, -1.0]
    assert answers[0].json()["extra_logs"]["goal"] == answers[1].json()["extra_logs"]["goal"]
    settings = (RewardSettings(goal=10.0, unparsable=-2.0), RewardSettings(unparsable=-3.0), PAPER)
    assert {run_of(each) for each in settings} == {run for run in runs if run.startswith(RUN_ID)}
    assert [answer.status_code for answer in refused] == [422, 422, 422]
    for answer, words in zip(refused, ("found -1: expected 0 or more", "goal", "gaol"), strict=True):
        assert words in answer.text


async def test_concurrent_requests_share_a_run(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address),
        FakeWorker(at.address, slots=2),
        http_at(at) as http,
    ):
        answers = await asyncio.gather(
            *(http.post(REWARDS, json=asked(*["move 1"] * count)) for count in (1, 2, 3))
        )
    assert [len(answer.json()["rewards"]) for answer in answers] == [1, 2, 3]


async def test_infrastructure_failure_returns_503_without_a_reward(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address),
        FakeWorker(at.address, poison={"t"}),
        http_at(at) as http,
    ):
        answer = await http.post(REWARDS, json=asked("move 3"))
    assert (answer.status_code, "infrastructure failure" in answer.json()["detail"]) == (503, True)


@pytest.mark.parametrize(
    ("body", "status", "words"),
    [
        ({"query": ["a"]}, 422, "prompts"),
        ({"query": [], "prompts": [], "labels": []}, 422, "query"),
        ({**asked("move 1"), "labels": []}, 422, "send the same number of each"),
        (asked("move 1", label="42"), 422, "found the label '42'"),
        (
            asked("move 1", label=LABEL.replace('"seed": 7', '"seed": -1')),
            422,
            "seed: Input should be greater than or equal to 0",
        ),
        ({**asked("move 1"), "query": ["move 1"]}, 422, "the query 'move 1' does not contain its prompt"),
        (
            asked("move 1", label=RewardLabel("t", f"sha256:{'0' * 64}", Profile.PAPER, 0).text()),
            409,
            "lacks 1 bundles",
        ),
    ],
)
async def test_invalid_requests_are_refused_with_a_message(tmp_path, body, status, words):
    async with manager(tmp_path) as at, open_run(at.address), http_at(at) as http:
        answer = await http.post(REWARDS, json=body)
    assert answer.status_code == status
    assert words in answer.json()["detail"]


async def test_invalid_json_and_oversized_bodies_are_refused(tmp_path):
    async with manager(tmp_path) as at, http_at(at) as http:
        broken = await http.post(REWARDS, content=b"{")
        large = await http.post(REWARDS, content=b" " * (64 * 1024 * 1024 + 1), timeout=50)
    assert (broken.status_code, large.status_code) == (422, 413)


async def test_rewards_need_a_trainer_token(tmp_path):
    async with guarded(tmp_path) as at, httpx.AsyncClient(base_url=at.page, verify=False) as http:
        answered = {
            role: (
                await http.post(REWARDS, json={}, headers={"authorization": f"Bearer {at.token(role)}"})
            ).status_code
            for role in (AccessRole.WORKER, AccessRole.VIEWER, AccessRole.TRAINER, AccessRole.ADMIN)
        }
        anonymous = await http.post(REWARDS, json={})
    assert answered == {
        AccessRole.WORKER: 403,
        AccessRole.VIEWER: 403,
        AccessRole.TRAINER: 422,
        AccessRole.ADMIN: 422,
    }
    assert anonymous.status_code == 401


def test_label_round_trips():
    assert RewardLabel.parse(LABEL) == RewardLabel("t", KITCHEN, Profile.PAPER, 7)


@pytest.mark.timeout(180)
async def test_blocks_of_the_adapters_page_upload_scenes_and_name_the_route(tmp_path):
    dataset = write_kitchen_dataset(tmp_path / "dataset")
    (upload,) = snippets("adapters.md", "OpenRLHF", "python")
    (options,) = snippets("adapters.md", "OpenRLHF", "")
    given = dict(zip(options.split()[::2], options.split()[1::2], strict=False))
    route = given["--reward.remote_url"].removeprefix("http://HOST:8070")
    async with (
        manager(tmp_path) as at,
        FakeWorker(at.address, slots=2),
        http_at(at) as http,
    ):
        text = upload.replace("HOST:50070", at.address).replace("build/dataset", str(dataset))
        names = {}
        await eval(compile(text, "docs/adapters.md", "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT), names)
        row = rows(dataset)[0]
        label, prompt = row[given["--data.label_key"]], row[given["--data.input_key"]][1]["content"]
        answer = await http.post(route, json=asked("move 3", prompt=prompt, label=label))
    assert answer.status_code == 200, answer.text
    assert len(answer.json()["rewards"]) == 1
