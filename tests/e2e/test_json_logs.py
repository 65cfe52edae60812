"""JSON logs of real daemons: every line is an object with the ids that it concerns, and no line holds a secret."""

import json
import re

from tests.fakes.commands import background, run

from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.wire.values import Batch, Completed, Rollout
from embomatrix.skills.parse import plan_from_json
from embomatrix.world.dataset import Dataset

SECRET = "the-secret-of-this-test"
JSON = "--log-format=json"


def lines(log):
    """Return the JSON objects of a log and its other lines."""
    output = log.read_text().splitlines()
    return [json.loads(line) for line in output if line.startswith("{")], [
        line for line in output if not line.startswith("{")
    ]


async def test_json_log_lines_have_ids_and_no_token(kitchen, tmp_path):
    dataset = Dataset.load(kitchen)
    record = dataset.train[0]
    digest, task, plan = record.bundle_digest, record.task.task_id, plan_from_json(list(record.oracle))
    rollouts = (Rollout("good", "g", digest, task, plan, 0),)
    ports = ("--port=0", "--http-port=0", "--state=memory:", f"--data-dir={tmp_path / 'data'}")
    token = {"EMBOMATRIX_TOKEN": SECRET}
    with background(
        tmp_path / "m.log", "manager", "serve", *ports, JSON, "--log-level=debug", **token
    ) as manager:
        manager.wait_for("status page")
        address = re.search(r"manager serves at (\S+),", manager.text)[1]
        lend = ("worker", "run", f"--manager={address}", "--slots=1", "--name=lab-pc", JSON, "--verbose")
        with background(tmp_path / "w.log", *lend, f"--cache-dir={tmp_path / 'cache'}", **token) as worker:
            worker.wait_for("registered with the manager")
            async with ClusterClient(address, SECRET) as client:
                run_id = await client.open_run("evening")
                await client.put_bundles({digest: dataset.bundle_bytes(digest)})
                batch = Batch(run_id, "b", 1, rollouts)
                outcomes = {
                    result.rollout_id: result.outcome async for result in client.execute(batch, deadline_s=60)
                }
                await client.close_run(run_id)
            run("cluster", "workers", f"--manager={address}", "--token=wrong")
    assert isinstance(outcomes["good"], Completed)
    of_manager, other = lines(tmp_path / "m.log")
    assert [line.split(" at ")[0] for line in other] == ["manager serves"]
    assert any(line.get("run") == run_id for line in of_manager)
    of_worker, other = lines(tmp_path / "w.log")
    assert other == []
    assert {line["worker"] for line in of_worker} == {"lab-pc"}
    assert any("session" in line for line in of_worker)
    assert any(line.get("scene") == digest for line in of_worker)
    for log in ("m.log", "w.log"):
        assert SECRET not in (tmp_path / log).read_text()


def test_unknown_log_format_is_refused():
    output = run("manager", "serve", "--log-format=xml")
    assert output.status == 2
    assert "xml" in output.text
    assert "Traceback" not in output.text
