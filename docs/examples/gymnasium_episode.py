"""Run the oracle plans and a random agent in the Gymnasium environment: python gymnasium_episode.py DATASET"""

import sys

from embomatrix.envs.gym import HouseholdEnv, action_of
from embomatrix.skills.parse import plan_from_json
from embomatrix.world.dataset import Dataset


def main(dataset: str) -> None:
    env = HouseholdEnv(dataset, render_mode="ansi")
    for record in Dataset.load(dataset).train:
        _, info = env.reset(seed=0, options={"task_id": record.task.task_id})
        total = 0.0
        for call in plan_from_json(list(record.oracle), record.task.profile):
            observation, gain, terminated, truncated, step = env.step(action_of(call, info["rooms"]))
            total += gain
        print(f"{info['task_id']}: {observation['message']} reward {total:.1f}, success {step['success']}")

    env.action_space.seed(0)
    env.reset(seed=0)
    terminated = truncated = False
    failures = 0
    while not (terminated or truncated):
        _, _, terminated, truncated, step = env.step(env.action_space.sample())
        failures += bool(step["failure"])
    print(f"a random agent: {failures} calls failed, success {step['success']}")
    env.close()


if __name__ == "__main__":
    main(sys.argv[1])
