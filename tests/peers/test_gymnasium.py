"""Gymnasium's environment checker, and the example of the docs."""

import re

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.peers import EXAMPLES, PHYSICS, ROOT, Peer

pytestmark = [pytest.mark.peers, pytest.mark.timeout(900)]
CHECK = """
import gymnasium, sys, warnings
from gymnasium.utils.env_checker import check_env
from embomatrix.envs.gym import ENV_ID, HouseholdEnv, action_of, call_of
from embomatrix.skills.syntax import SkillCall, Skill
warnings.simplefilter("error")
options = dict(dataset=sys.argv[1], render_mode="ansi", disable_env_checker=True)
env = gymnasium.make("EmboMatrix/Household-v0", **options).unwrapped
check_env(env)
check_env(gymnasium.make(ENV_ID, text_actions=True, **options).unwrapped)
first = [env.reset(seed=5)[0], env.reset(seed=5)[0]]
assert first[0] == first[1]
env.action_space.seed(0)
for _ in range(200):
    call = call_of(env.action_space.sample(), ("kitchen_0",))
    if call.room_name in (None, "kitchen_0"):
        assert call_of(action_of(call, ("kitchen_0",)), ("kitchen_0",)) == call
_, info = env.reset(seed=1, options={"task_id": "apple_to_counter"})
for _ in range(20):
    sampled = env.action_space.sample(mask=info["action_mask"])
    assert int(sampled["object"]) < len(info["objects"])
_, gain, over, cut, step = env.step("dance")
assert (gain, over, cut, step) == (-1.0, False, False, {"failure": "unparsable"})
total = 0.0
for call in ("move 10", "pick_up 10", "move 0", "place 0 ontop"):
    observation, gain, over, cut, step = env.step(call)
    total += gain
assert over and step["success"], observation["message"]
assert "2 calls: expected one" in env.step("move 10\\nmove 0")[0]["message"]
wrongs = (
    ({"skill": 0}, "the action lacks distance"), (3, "the action is int"), (b"move 3", "the action is bytes"),
    ({**sampled, "skill": 99}, "skill is 99: expected a whole number from 0 to"),
    ({**sampled, "skill": "move"}, "skill is 'move': expected a whole number"),
    ({**sampled, "object": -1}, "object is -1: expected a whole number"),
    ({**sampled, "room": -1}, "room is -1: expected a whole number"),
    ({**sampled, "source": 1.5}, "source is 1.5: expected a whole number"),
    ({**sampled, "yaw": float("nan")}, "yaw is nan: expected a finite number"),
    ({**sampled, "distance": None}, "distance is None: expected a finite number"),
)
for wrong, words in wrongs:
    try:
        env.step(wrong)
    except ValueError as error:
        assert words in str(error), error
    else:
        raise AssertionError(wrong)
try:
    HouseholdEnv(sys.argv[1], render_mode="human")
except ValueError as error:
    assert "expected ansi or rgb_array" in str(error)
filmed = HouseholdEnv(sys.argv[1], render_mode="rgb_array")
filmed.reset(seed=1, options={"task_id": "apple_to_counter"})
before = filmed.render()
filmed.step("move 10")
assert before.shape == (480, 640, 3) and before.dtype == "uint8" and (before != filmed.render()).any()
filmed.close()
try:
    env.reset(options={"task": "apple_to_counter"})
except ValueError as error:
    assert "no option 'task': expected task_id" in str(error)
try:
    env.reset(options={"task_id": "elsewhere"})
except ValueError as error:
    print(error)
"""


PRINTED = """
import pathlib, re, sys
blocks = re.findall(r"```python\\n(.*?)```", pathlib.Path(sys.argv[2]).read_text(), re.DOTALL)
block, _ = [text for text in blocks if "gymnasium" in text]
known = {}
exec(compile(block.replace("build/dataset", sys.argv[1]), "adapters.md", "exec"), known)
print(known["observation"]["message"])
"""


@pytest.fixture(scope="module")
def peer():
    return Peer("gymnasium", "gymnasium==1.4.0", *PHYSICS)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_kitchen_dataset(tmp_path_factory.mktemp("dataset"))


def test_environment_passes_gymnasiums_checker(peer, dataset):
    assert "there is no task 'elsewhere'" in peer.run("-c", CHECK, dataset)


def test_example_of_the_page_runs(peer, dataset):
    assert peer.run("-c", PRINTED, dataset, ROOT / "docs" / "adapters.md").strip()


def test_vector_example_of_the_page_runs(peer, dataset, tmp_path):
    page = (ROOT / "docs" / "adapters.md").read_text(encoding="utf-8")
    (block,) = [each for each in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "make_vec" in each]
    script = tmp_path / "vector.py"
    printed = "    for message in observations['message']:\n        print(message)\n    envs.close()\n"
    script.write_text(block.replace("build/dataset", str(dataset)) + printed)
    messages = peer.run(script).splitlines()
    assert len(messages) == 4
    assert all(message.strip("0") for message in messages)


def test_oracle_plans_reach_their_goals_and_a_random_agent_does_not(peer, dataset):
    *plans, agent = peer.run(EXAMPLES / "gymnasium_episode.py", dataset).splitlines()
    assert len(plans) == 3
    assert all(line.endswith("success True") for line in plans)
    assert agent.endswith("success False")
