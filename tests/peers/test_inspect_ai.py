"""The task for Inspect AI, run by Inspect with a mock model that calls the oracle's skills."""

import json

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.peers import PHYSICS, Peer

pytestmark = [pytest.mark.peers, pytest.mark.timeout(900)]
EVALUATION = """
import json, sys
from inspect_ai import eval
from inspect_ai.model import ModelOutput, ModelUsage, get_model
from embomatrix.envs.inspect_ai import household
from embomatrix.world.dataset import Dataset

dataset, manager = sys.argv[1:]
records = {record.task.task_id: record for record in Dataset.load(dataset).train}
solved, idle, *_ = records

def answers(messages, tools, tool_choice, config):
    # The task is found by its instruction; one task is solved, in another one nothing is done.
    said = [message.text for message in messages if message.role == "user"][0]
    (record,) = [each for each in records.values() if each.task.instruction in said]
    done = sum(message.role == "assistant" for message in messages)
    if record.task.task_id == idle or done == len(record.oracle):
        return counted(ModelOutput.from_content("mockllm/model", "done"))
    call = dict(record.oracle[done])
    assert {"move", "place"} <= {tool.name for tool in tools}
    return counted(ModelOutput.for_tool_call("mockllm/model", call.pop("action"), call))

def counted(output):
    output.usage = ModelUsage()  # otherwise Inspect fetches a tokenizer to count tokens
    return output

task = household(dataset=dataset, split="train", visibility="full", manager=manager)
(log,) = eval(task, model=get_model("mockllm/model", custom_outputs=answers), display="none", log_dir="logs")
assert log.status == "success", log.error
print(json.dumps({
    "samples": {sample.id: sample.scores["final_state"].value for sample in log.samples},
    "metrics": {score.name: {name: metric.value for name, metric in score.metrics.items()} for score in log.results.scores},
    "told": [message.text for message in log.samples[0].messages if message.role == "tool"],
    "idle": idle,
}))
"""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_kitchen_dataset(tmp_path_factory.mktemp("dataset"))


def test_oracle_s_calls_solve_the_tasks_in_inspect(dataset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    peer = Peer("inspect-ai", "inspect-ai==0.3.285", *PHYSICS)
    found = json.loads(peer.run("-c", EVALUATION, dataset, "").splitlines()[-1])
    idle = found["samples"].pop(found["idle"])
    assert idle == {"success": 0, "reward": -1, "calls": 0, "failed_calls": 0}
    assert all(each["success"] == 1 and each["reward"] > 30 for each in found["samples"].values())
    assert found["metrics"]["success"]["accuracy"] == pytest.approx(2 / 3)
    assert any("Robot: kitchen_0" in text for text in found["told"])
