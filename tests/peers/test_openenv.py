"""The environment behind OpenEnv's server, called by OpenEnv's client."""

import json

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.peers import PHYSICS, Peer

pytestmark = [pytest.mark.peers, pytest.mark.timeout(900)]
TALK = """
import json, sys, threading, time, uvicorn
from openenv import GenericEnvClient
from embomatrix.envs.openenv import server
from embomatrix.world.dataset import Dataset

config = uvicorn.Config(server(sys.argv[1]), port=0, log_level="error")
served = uvicorn.Server(config)
threading.Thread(target=served.run, daemon=True).start()
while not served.started:
    time.sleep(0.05)
port = served.servers[0].sockets[0].getsockname()[1]
for record in Dataset.load(sys.argv[1]).train:
    with GenericEnvClient(base_url=f"http://127.0.0.1:{port}").sync() as client:
        first = client.reset(seed=1, task_id=record.task.task_id)
        none = client.step({"text": "I would rather not"})
        unknown = client.step({"text": "move 59"})
        done = client.step({"text": json.dumps([dict(call) for call in record.oracle])})
        state = client.state()
        print(json.dumps({
            "task": first.observation["task"], "none": none.reward, "unknown": unknown.observation["messages"],
            "unchanged": unknown.observation["state"] == first.observation["state"], "total": unknown.reward + done.reward,
            "done": done.done, "success": state["success"], "tiers": state["format"] + state["relevance"] + state["goal"],
        }))
served.should_exit = True
"""


def test_plans_go_through_openenv_s_server_and_come_back_scored(tmp_path):
    dataset = write_kitchen_dataset(tmp_path)
    peer = Peer("openenv", "openenv==0.10.0", "uvicorn", *PHYSICS)
    rows = [json.loads(line) for line in peer.run("-c", TALK, dataset).splitlines() if line.startswith("{")]
    assert len(rows) == 3
    for each in rows:
        assert "Task: " in each["task"]
        assert (each["none"], each["unchanged"], each["done"], each["success"]) == (-1, True, True, True)
        assert len(each["unknown"]) == 1
        assert each["total"] == pytest.approx(each["tiers"])
        assert each["total"] > 30
