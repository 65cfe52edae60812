"""REST API and dashboard files of a real manager."""

import asyncio
import json
import re
from importlib.resources import files

import httpx
import pytest
from tests.contract.test_state_store import no_file_grows
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import BEDROOM, KITCHEN, batch, manager, open_run, outcomes

from embomatrix.manager.web.rest import PREFIX, VIEWERS
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.status import NotFoundError
from embomatrix.rpc.wire.tokens import AccessRole
from embomatrix.rpc.wire.training import RewardTiers, SampledPlan, TrainingReport
from embomatrix.rpc.wire.values import HostUse, LookaheadEntry

pytestmark = pytest.mark.timeout(60)


def http_at(at, **headers):
    return httpx.AsyncClient(base_url=at.status_url, trust_env=False, headers=headers)


async def test_all_lists_come_from_one_snapshot(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, "w1", slots=2),
        http_at(at) as http,
    ):
        await outcomes(client, batch(10))
        seen, workers, runs = [
            (await http.get(f"{PREFIX}/{name}")).json() for name in ("snapshot", "workers", "runs")
        ]
    assert seen["workers"]["items"] == workers["items"]
    assert seen["runs"] == runs["items"]
    assert seen["at_s"] == workers["at_s"] == runs["at_s"]
    assert seen["overview"]["outcomes"] == {"completed": 10}
    assert sum(row["completed"] for row in workers["items"]) == 10


async def seen_until(http, true):
    """Return the first snapshot for which this is true."""
    for _ in range(300):
        seen = (await http.get(f"{PREFIX}/snapshot")).json()
        if true(seen):
            return seen
        await asyncio.sleep(0.1)
    raise AssertionError(seen)


async def test_unplaceable_scene_is_reported_with_its_reason(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, broken={BEDROOM}),
        http_at(at) as http,
    ):
        await client.announce_lookahead(
            "r1", 1, [LookaheadEntry(5, KITCHEN, 8), LookaheadEntry(6, BEDROOM, 4)]
        )
        seen = await seen_until(http, lambda seen: seen["overview"]["unplaceable"])
    assert (
        seen["health"]["sentence"]
        == "1 announced scene fits on no worker: the look-ahead page shows the reason."
    )
    (fine,), (stuck,) = [step["cells"] for step in seen["lookahead"]]
    assert (fine["problem"], stuck["warmth"]) == ("", "unplaceable")
    assert stuck["problem"] == f"scene {BEDROOM} fails to load: the mesh has no triangles"


async def test_full_disk_is_reported_in_the_health_sentence(tmp_path):
    state = tmp_path / "state.sqlite"
    async with (
        manager(tmp_path, state=f"sqlite:{state}", leader_ttl_s=0.6) as at,
        AdminClient(at.address) as client,
    ):
        with no_file_grows(state.with_name(f"{state.name}-wal").stat().st_size):
            await _hear(client, "make room on its disk")
        await _hear(client, "No worker has joined yet")


async def _line_shown(http, line):
    """Wait until the worker's log ends with the line."""
    async with asyncio.timeout(10):
        while True:
            if (await http.get(f"{PREFIX}/workers/w1/log")).json()["lines"][-1] == line:
                return
            await asyncio.sleep(0.05)


async def _hear(client, words):
    """Wait until the manager reports this about itself."""
    async with asyncio.timeout(30):
        while True:
            if words in (await client.fleet()).health:
                return
            await asyncio.sleep(0.05)


async def test_misspelt_filter_is_refused_instead_of_showing_everything(tmp_path):
    async with manager(tmp_path) as at, http_at(at) as http:
        for path, words in (
            (
                "workers?sate=ready",
                "/api/v1/workers has no parameter 'sate': expected limit, offset, search, state",
            ),
            ("overview?limit=1", "has no parameter 'limit': it has none"),
            ("dispatch/pause?now=1", "has no parameter 'now'"),
        ):
            answer = await (http.post if "pause" in path else http.get)(f"/api/v1/{path}")
            assert answer.status_code == 422
            assert words in answer.json()["detail"]
        assert (await http.get("/api/v1/workers?state=ready&limit=5")).status_code == 200


async def test_completed_rollouts_of_a_lost_worker_stay_counted(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, "w1", host=HostUse(0.25, 4000, 16_000)) as gone,
        http_at(at) as http,
    ):
        await seen_until(http, lambda seen: any(row["host"] for row in seen["workers"]["items"]))
        await outcomes(client, batch(10))
        await gone.kill()
        seen = await seen_until(http, lambda seen: "lost" in seen["overview"]["workers"])
    (worker,) = seen["workers"]["items"]
    assert (worker["state"], worker["completed"]) == ("lost", 10)
    assert worker["host"] is None, "nobody knows how much its machine does now"
    assert seen["overview"]["outcomes"] == {"completed": 10}


async def test_rest_commands_equal_the_grpc_commands(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, "w1"),
        FakeWorker(at.address, "w2"),
        http_at(at) as http,
    ):
        assert (await http.post(f"{PREFIX}/dispatch/pause")).json() == {
            "thing": "dispatch",
            "state": "paused",
        }
        assert (
            (await http.get(f"{PREFIX}/snapshot"))
            .json()["health"]["sentence"]
            .startswith("Dispatch is paused")
        )
        waiting = asyncio.create_task(outcomes(client, batch(2)))
        assert (await http.post(f"{PREFIX}/dispatch/resume")).status_code == 200
        assert len(await waiting) == 2
        assert (await http.post(f"{PREFIX}/workers/w1/drain")).json()["state"] == "draining"
        first = (await http.get(f"{PREFIX}/workers")).json()["items"][0]
        assert (first["worker_id"], first["state"] in ("draining", "left")) == ("w1", True)
        assert (await http.post(f"{PREFIX}/workers/w2/resume")).json() == {"thing": "w2", "state": "ready"}
        unknown = await http.post(f"{PREFIX}/workers/nobody/drain")
        assert (unknown.status_code, "nobody" in unknown.json()["detail"]) == (404, True)
        assert (await http.post(f"{PREFIX}/workers/w2/revoke", json={})).status_code == 422
        unguarded = await http.post(f"{PREFIX}/workers/w2/revoke", json={"reason": "sold"})
        assert (unguarded.status_code, "manager init" in unguarded.json()["detail"]) == (409, True)


async def test_invalid_page_parameters_are_refused(tmp_path):
    queries = (
        "workers?limit=0",
        "workers?limit=100000",
        "workers?offset=-1",
        "runs?limit=x",
        "events?after=-1",
    )
    async with manager(tmp_path) as at, http_at(at) as http:
        answers = [await http.get(f"{PREFIX}/{query}") for query in queries]
    assert [answer.status_code for answer in answers] == [422] * len(queries)
    named = [answer.json()["detail"].split(":")[0] for answer in answers]
    assert named == [f"query {name}" for name in ("limit", "limit", "offset", "limit", "after")]
    assert answers[0].json() == {
        "detail": "query limit: input should be greater than or equal to 1, found '0'"
    }


async def test_every_invalid_part_of_a_request_is_named_in_one_sentence(tmp_path):
    async with manager(tmp_path) as at, http_at(at) as http:
        both = await http.get(f"{PREFIX}/workers?limit=0&offset=-1")
        state = await http.get(f"{PREFIX}/workers?state=redy")
        every = await http.get(f"{PREFIX}/snapshot?state=&search=")
        body = await http.post(f"{PREFIX}/workers/w1/revoke", json={})
        text = await http.post(
            f"{PREFIX}/workers/w1/revoke", content=b"{", headers={"content-type": "application/json"}
        )
        described = (await http.get(f"{PREFIX}/openapi.json")).json()["components"]["schemas"]
    assert {answer.status_code for answer in (both, state, body, text)} == {422}
    assert both.json()["detail"].count("; ") == 1
    found = state.json()["detail"]
    assert found.startswith("query state: input should be 'ready', 'suspect', 'lost',")
    assert found.endswith("found 'redy'")
    assert every.status_code == 200
    assert body.json()["detail"] == "body reason: field required"
    assert text.json()["detail"].startswith("body 1: JSON decode error")
    assert ("Refusal" in described, "HTTPValidationError" in described) == (True, False)


async def test_whole_names_of_workers_and_ids_of_runs_are_searched(tmp_path):
    name = "w" * 128
    async with (
        manager(tmp_path) as at,
        open_run(at.address, name),
        FakeWorker(at.address, name),
        http_at(at) as http,
    ):
        for path in ("workers", "runs", f"runs/{name}/timeline"):
            answer = await http.get(f"{PREFIX}/{path}?search={name}")
            assert answer.status_code == 200, path
            assert answer.json().get("total", 1) == 1
        assert (await http.get(f"{PREFIX}/workers?search={name}x")).status_code == 422


async def test_commands_are_refused_to_viewers_and_foreign_origins(tmp_path):
    async with manager(tmp_path, token="secret") as at, http_at(at) as http:
        foreign = {"authorization": "Bearer secret", "origin": "https://evil.example"}
        body = [
            (await http.post(f"{PREFIX}/dispatch/pause", headers=headers)).status_code
            for headers in ({}, {"authorization": "Bearer wrong"}, foreign)
        ]
        own = await http.post(f"{PREFIX}/dispatch/pause", headers={"authorization": "Bearer secret"})
    assert (body, own.status_code) == ([401, 401, 403], 200)


async def test_event_stream_resumes_after_a_sequence_number(tmp_path):
    async def read(http, count, after=0):
        async with http.stream(
            "GET", f"{PREFIX}/events/stream", params={"run": "r1", "after": after}
        ) as answer:
            assert answer.headers["content-type"].startswith("text/event-stream")
            found = []
            async for line in answer.aiter_lines():
                if line.startswith("data: "):
                    found.append(json.loads(line.removeprefix("data: ")))
                if len(found) == count:
                    return found
        return found

    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, slots=2),
        http_at(at) as http,
    ):
        reading = asyncio.create_task(read(http, 6))
        await outcomes(client, batch(8))
        first = await reading
        rest = await read(http, 4, after=first[-1]["sequence"])
        assert (await http.get(f"{PREFIX}/events/stream", params={"run": "nobody"})).status_code == 404
    numbers = [event["sequence"] for event in (*first, *rest)]
    assert numbers == sorted(set(numbers))


@pytest.mark.parametrize("left_open", [False, True])
async def test_stream_of_a_run_ends_after_its_last_event(tmp_path, left_open):
    async def read(http, after=0):
        params = {"run": "r1", "after": after}
        async with http.stream("GET", f"{PREFIX}/events/stream", params=params) as answer:
            lines = [line async for line in answer.aiter_lines()]
        return [json.loads(line.removeprefix("data: ")) for line in lines if line.startswith("data: ")]

    async with manager(tmp_path) as at, open_run(at.address) as client, http_at(at) as http:
        if left_open:
            reading = asyncio.create_task(read(http))
            await asyncio.sleep(0.7)
            await client.close_run("r1")
        else:
            await client.close_run("r1")
            reading = asyncio.create_task(read(http))
        async with asyncio.timeout(10):
            events = await reading
            assert await read(http, after=events[-1]["sequence"]) == []
    assert [event["kind"] for event in events] == ["run_opened", "run_closed"]


@pytest.mark.slow
@pytest.mark.timeout(300)
async def test_unread_event_streams_delay_nobody(tmp_path):
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, slots=2),
        http_at(at, **{"accept-encoding": "identity"}) as http,
    ):
        port = httpx.URL(at.status_url).port
        mute = [await asyncio.open_connection("127.0.0.1", port, limit=64) for _ in range(VIEWERS)]
        for _, writer in mute:
            writer.write(f"GET {PREFIX}/events/stream?run=r1 HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n".encode())
        for reader, _ in mute:
            assert b"200" in await reader.readline()
        refused = await http.get(f"{PREFIX}/events/stream?run=r1")
        assert (refused.status_code, "streams are open" in refused.text) == (503, True)
        assert len(await outcomes(client, batch(200))) == 200
        assert (await http.get(f"{PREFIX}/snapshot")).json()["overview"]["outcomes"] == {"completed": 200}
        for _, writer in mute:
            writer.transport.abort()
        for _ in range(300):
            async with http.stream("GET", f"{PREFIX}/events/stream?run=r1") as again:
                if again.status_code == 200:
                    break
            await asyncio.sleep(0.1)
        assert again.status_code == 200


def named_in(text):
    """Return the files that the page, or one of its scripts, requests."""
    own = re.findall(r'"(/static/[^"]+)"', text)
    return [*own, *(f"/static/{name}" for name in re.findall(r'"\./(\w+\.js)"', text))]


async def test_answers_are_compressed_on_request(tmp_path):
    async with manager(tmp_path) as at, http_at(at) as http, FakeWorker(at.address, "w1"):
        page = f"{PREFIX}/snapshot"
        plain = await http.get(page, headers={"accept-encoding": "identity"})
        packed = await http.get(page)
        style = await http.get("/static/style.css")
        known = {"if-none-match": style.headers["etag"]}
        again = await http.get("/static/style.css", headers=known)
        other = await http.get("/static/app.js", headers=known)
    assert "content-encoding" not in plain.headers
    assert packed.headers["content-encoding"] == style.headers["content-encoding"] == "gzip"
    assert int(packed.headers["content-length"]) < int(plain.headers["content-length"])
    assert packed.json().keys() == plain.json().keys()
    assert (again.status_code, again.content, other.status_code) == (304, b"", 200)


async def test_dashboard_loads_only_its_own_files(tmp_path):
    async with manager(tmp_path, token="secret") as at, http_at(at) as http:
        page = await http.get("/")
        texts = {"/": page}
        while missing := {path for body in texts.values() for path in named_in(body.text)} - texts.keys():
            texts |= {path: await http.get(path) for path in missing}
        outside = [
            (await http.get(path)).status_code
            for path in ("/static/../api.py", "/static/%2e%2e/api.py", "/static/vendor/LICENSE", "/static/")
        ]
    assert "default-src 'none'" in page.headers["content-security-policy"]
    assert "http" not in page.text.replace("http://www.w3.org", "")
    assert {body.status_code for body in texts.values()} == {200}
    scripts = {path.removeprefix("/static/") for path in texts if path.endswith(".js")}
    shipped = files("embomatrix.manager.web") / "dashboard"
    assert scripts == {item.name for item in shipped.iterdir() if item.name.endswith(".js")} | {
        "vendor/uPlot.iife.min.js"
    }
    assert not any(
        "http" in texts[f"/static/{name}"].text for name in scripts - {"dom.js"} if "/" not in name
    )
    assert set(outside) <= {401, 404}


async def test_openapi_page_describes_every_answer(tmp_path):
    async with manager(tmp_path) as at, http_at(at) as http:
        body = (await http.get(f"{PREFIX}/openapi.json")).json()
        for path, methods in body["paths"].items():
            assert path.startswith(PREFIX)
            if "get" in methods and "{" not in path and not path.endswith("stream"):
                assert (await http.get(path)).status_code == 200
    assert {"SnapshotPage", "WorkerPage", "Timeline", "Changed"} <= set(body["components"]["schemas"])
    calls = [one for methods in body["paths"].values() for one in methods.values()]
    groups = {tag["name"] for tag in body["tags"]}
    for one in calls:
        # FastAPI makes up a summary from the function's name: ours are sentences of words of the domain.
        words = one["operationId"].split("_api_v1_")[0].replace("_", " ")
        assert one["summary"].lower() != words, one["operationId"]
        assert one["description"].endswith("."), one["operationId"]
        assert set(one["tags"]) <= groups
        assert all(parameter.get("description") for parameter in one.get("parameters", ())), one[
            "operationId"
        ]
    assert len({one["summary"] for one in calls}) == len(calls)


async def test_training_reports_are_shown_after_their_run_closed(tmp_path):
    plan = SampledPlan("t1", "tidy <b>up</b>", "move 3", RewardTiers(0.5, 0.2, 15.0, False), 1.0)
    async with manager(tmp_path) as at, open_run(at.address) as client, http_at(at) as http:
        for step in (1, 2):
            figures = {"reward": float(step)}
            await client.report_training("r1", TrainingReport("grpo", step, figures, (plan,)))
        with pytest.raises(NotFoundError, match="nobody"):
            await client.report_training("nobody", TrainingReport("grpo", 1))
        body = (await http.get(f"{PREFIX}/training/r1")).json()
        await client.close_run("r1")
        later = (await http.get(f"{PREFIX}/training/r1")).json()
        unknown = await http.get(f"{PREFIX}/training/nobody")
        listed = (await http.get(f"{PREFIX}/training")).json()
        seen = (await http.get(f"{PREFIX}/snapshot")).json()
    assert body["phases"] == [{"phase": "grpo", "steps": [1, 2], "figures": {"reward": [1.0, 2.0]}}]
    assert (body["plans"][0]["instruction"], body["plans_step"]) == ("tidy <b>up</b>", 2)
    assert later == body
    assert listed == seen["training"] == [body["run"]]
    assert (unknown.status_code, "nobody" in unknown.json()["detail"]) == (404, True)


async def test_one_reported_plan_is_shown_by_its_number(tmp_path):
    plan = SampledPlan("t1", "tidy up", "move 3", RewardTiers(0.5, 0.2, 15.0, False), 1.0)
    async with manager(tmp_path) as at, open_run(at.address) as client, http_at(at) as http:
        early = await http.get(f"{PREFIX}/training/r1/plans/1")
        await client.report_training("r1", TrainingReport("grpo", 4, {"reward": 2.0}, (plan, plan)))
        second = (await http.get(f"{PREFIX}/training/r1/plans/2")).json()
        third = await http.get(f"{PREFIX}/training/r1/plans/3")
    assert (second["step"], second["number"], second["count"]) == (4, 2, 2)
    assert (second["plan"]["text"], second["task"]) == ("move 3", None)
    assert "no dataset is shown" in second["notice"]
    assert early.status_code == third.status_code == 404
    assert "expected a number from 1 to 2, found 3" in third.json()["detail"]


async def test_closed_runs_are_listed_by_name_and_keep_story_plans_and_failures(tmp_path):
    plan = SampledPlan("t1", "tidy up", "move 3", RewardTiers(0.5, 0.2, 15.0, False), 1.0)
    async with (
        manager(tmp_path) as at,
        open_run(at.address) as client,
        FakeWorker(at.address, broken={BEDROOM}),
    ):
        await client.report_training("r1", TrainingReport("grpo", 1, {"reward": 2.0}, (plan,)))
        await outcomes(client, batch(8))
        await outcomes(client, batch(1, batch_id="b2", scene=BEDROOM))
        await client.close_run("r1")
        await client.open_run("evening", "r2")
    # Another manager of the same folder knows the run from its file alone.
    async with manager(tmp_path) as at, ClusterClient(at.address) as client, http_at(at) as http:
        await client.open_run("night", "r3")
        lists = {
            query: [run["run_id"] for run in (await http.get(f"{PREFIX}/runs?{query}")).json()["items"]]
            for query in ("", "state=closed", "state=all", "state=all&search=TEST", "state=open&search=test")
        }
        body = (await http.get(f"{PREFIX}/runs/r1")).json()
        training = (await http.get(f"{PREFIX}/training/r1")).json()
        untrained = (await http.get(f"{PREFIX}/runs/r3")).json()
        wrong = await http.get(f"{PREFIX}/runs?state=done")
    assert lists == {
        "": ["r3"],
        "state=closed": ["r1"],
        "state=all": ["r3", "r1"],
        "state=all&search=TEST": ["r1"],
        "state=open&search=test": [],
    }
    assert body["story"][0].startswith("The run test was open from ")
    assert "1 worker completed 8 rollouts; 1 rollout ended in an infrastructure failure." in body["story"]
    assert {total["name"]: total["value"] for total in body["totals"]}["completed rollouts"] == 8
    assert body["failures"][-1]["code"] == "scene_load_failed"
    assert "slot" not in body["failures"][-1], "fields that do not apply are left out"
    assert (body["trained"], untrained["trained"]) == (True, False)
    assert training["phases"] == [{"phase": "grpo", "steps": [1], "figures": {"reward": [2.0]}}]
    assert training["plans"][0]["text"] == "move 3"
    assert wrong.status_code == 422
    assert wrong.json()["detail"].startswith("query state: input should be 'open', 'closed' or 'all', found")


async def test_machine_and_log_of_a_worker_are_shown_without_secrets(tmp_path):
    lines = ["registered with Bearer abc.def", "store redis://user:hidden@host is away"]
    async with (
        manager(tmp_path) as at,
        http_at(at) as http,
        FakeWorker(at.address, "w1", host=HostUse(0.25, 4000, 16_000), log_lines=lines) as worker,
        FakeWorker(at.address, "old"),
    ):
        seen = await seen_until(http, lambda seen: any(row["host"] for row in seen["workers"]["items"]))
        detail = (await http.get(f"{PREFIX}/workers/w1")).json()
        log = (await http.get(f"{PREFIX}/workers/w1/log")).json()
        old = [(await http.get(f"{PREFIX}/workers/old{path}")).json() for path in ("", "/log")]
        unknown = [await http.get(f"{PREFIX}/workers/nobody{path}") for path in ("", "/log")]
        worker.log_lines = ["one more"]
        await _line_shown(http, "one more")
    (row,) = [row for row in seen["workers"]["items"] if row["worker_id"] == "w1"]
    assert row["host"] == {"cpu_share": 0.25, "memory_used_mb": 4000, "memory_mb": 16_000}
    assert detail["worker"]["worker_id"] == "w1"
    assert (detail["host"]["cpu_share"][0], detail["host"]["memory_used_mb"][0]) == (0.25, 4000)
    assert detail["host"]["memory_mb"] == 16_000
    assert log == {
        "worker_id": "w1",
        "lines": ["registered with Bearer ***", "store redis://user:***@host is away"],
    }
    assert (old[0]["worker"]["host"], old[0]["host"]["at_s"], old[1]["lines"]) == (None, [], [])
    assert [answer.status_code for answer in unknown] == [404, 404]
    assert "'nobody' (connected: old, w1)" in unknown[0].json()["detail"]


async def test_caller_learns_its_role_and_why_it_may_not_send_commands(tmp_path):
    async with manager(tmp_path, token="secret") as at:
        async with AdminClient(at.address, "secret") as admin:
            tokens = {
                role: (await admin.issue_token(role))[0] for role in (AccessRole.VIEWER, AccessRole.TRAINER)
            }
        tokens[AccessRole.ADMIN] = "secret"
        found = {}
        for role, token in tokens.items():
            async with http_at(at, authorization=f"Bearer {token}") as http:
                found[role] = (await http.get(f"{PREFIX}/caller")).json()
                paused = await http.post(f"{PREFIX}/dispatch/pause")
                assert (paused.status_code == 200) is not bool(found[role]["refusal"]), role
    assert {role: answer["role"] for role, answer in found.items()} == {role: role.value for role in tokens}
    assert found[AccessRole.VIEWER]["refusal"].startswith("A token of the role viewer may only read")
    async with manager(tmp_path / "open") as at, http_at(at) as http:
        assert (await http.get(f"{PREFIX}/caller")).json() == {"role": "admin", "refusal": ""}


async def test_tasks_need_a_viewer_token(tmp_path):
    async with manager(tmp_path, token="secret", dataset=tmp_path / "nowhere") as at, http_at(at) as http:
        stranger = await http.get(f"{PREFIX}/tasks")
        own = {"authorization": "Bearer secret"}
        damaged = await http.get(f"{PREFIX}/tasks", headers=own)
        wrong = await http.get(f"{PREFIX}/tasks", params={"limit": 100_000}, headers=own)
    assert (stranger.status_code, damaged.status_code, wrong.status_code) == (401, 503, 422)
    assert "--dataset" in damaged.json()["detail"]
