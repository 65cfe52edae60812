"""Gymnasium's environment checker, and the example of the docs."""

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.peers import EXAMPLES, PHYSICS, Peer

pytestmark = [pytest.mark.peers, pytest.mark.timeout(900)]
CHECK = """
import gymnasium, sys, warnings
from gymnasium.utils.env_checker import check_env
from embomatrix.envs.gym import HouseholdEnv, SKILLS, action_of, call_of
from embomatrix.skills.syntax import SkillCall, Skill
warnings.simplefilter("error")
gymnasium.register("EmboMatrix/Household-v0", entry_point="embomatrix.envs.gym:HouseholdEnv")
options = dict(dataset=sys.argv[1], render_mode="ansi", disable_env_checker=True)
env = gymnasium.make("EmboMatrix/Household-v0", **options).unwrapped
check_env(env)
first = [env.reset(seed=5)[0], env.reset(seed=5)[0]]
assert first[0] == first[1]
env.action_space.seed(0)
for _ in range(200):
    call = call_of(env.action_space.sample(), ("kitchen_0",))
    if call.room_name in (None, "kitchen_0"):
        assert call_of(action_of(call, ("kitchen_0",)), ("kitchen_0",)) == call
try:
    env.reset(options={"task_id": "elsewhere"})
except ValueError as error:
    print(error)
"""


@pytest.fixture(scope="module")
def peer():
    return Peer("gymnasium", "gymnasium==1.4.0", *PHYSICS)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_kitchen_dataset(tmp_path_factory.mktemp("dataset"))


def test_environment_passes_gymnasiums_checker(peer, dataset):
    assert "there is no task 'elsewhere'" in peer.run("-c", CHECK, dataset)


def test_oracle_plans_reach_their_goals_and_a_random_agent_does_not(peer, dataset):
    *plans, agent = peer.run(EXAMPLES / "gymnasium_episode.py", dataset).splitlines()
    assert len(plans) == 3
    assert all(line.endswith("success True") for line in plans)
    assert agent.endswith("success False")
