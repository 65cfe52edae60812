"""The environment behind OpenEnv's server, called by OpenEnv's client."""

import json

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.documents import snippets
from tests.fakes.peers import PHYSICS, Peer

from embomatrix.cli.local_cluster import free_port

pytestmark = [pytest.mark.peers, pytest.mark.timeout(900)]
TALK = """
import json, socket, sys, threading, time
from openenv import GenericEnvClient
from embomatrix.world.dataset import Dataset

port = int(sys.argv[3])
threading.Thread(target=exec, args=(compile(sys.argv[2], "docs/adapters.md", "exec"), {}), daemon=True).start()
for _ in range(1200):
    with socket.socket() as probe:
        if probe.connect_ex(("127.0.0.1", port)) == 0:
            break
    time.sleep(0.1)
for record in Dataset.load(sys.argv[1]).train:
    with GenericEnvClient(base_url=f"http://127.0.0.1:{port}").sync() as client:
        first = client.reset(seed=1, task_id=record.task.task_id)
        none = client.step({"text": "I would rather not"})
        unknown = client.step({"text": "move 59"})
        done = client.step({"text": json.dumps([dict(call) for call in record.oracle])})
        state = client.state()
        print(json.dumps({
            "task": first.observation["text"], "none": none.reward, "unknown": unknown.observation["messages"],
            "told": [none.observation["text"], done.observation["text"]], "end": done.observation["end"],
            "total": none.reward + unknown.reward + done.reward, "failed": state["failed_calls"],
            "done": done.done, "success": state["success"], "tiers": state["format"] + state["relevance"] + state["goal"],
        }))
"""


def test_plans_go_through_openenv_s_server_and_come_back_scored(tmp_path):
    dataset = write_kitchen_dataset(tmp_path)
    peer = Peer("openenv", "openenv==0.10.0", "uvicorn", *PHYSICS)
    (block,) = snippets("adapters.md", "OpenEnv", "python")
    assert "port=8000" in block
    port = free_port()
    block = block.replace("build/dataset", str(dataset)).replace("port=8000", f"port={port}")
    printed = peer.run("-c", TALK, dataset, block, port)
    rows = [json.loads(line) for line in printed.splitlines() if line.startswith("{")]
    assert len(rows) == 3
    for each in rows:
        assert "Task: " in each["task"]
        assert (each["none"], each["done"], each["end"], each["success"]) == (-1, True, "goal", True)
        assert each["failed"] == 2
        assert each["told"][0].startswith("Not an action: ")
        assert "Robot: " in each["told"][1]
        assert len(each["unknown"]) == 1
        assert each["total"] == pytest.approx(each["tiers"])
        assert each["total"] > 30
