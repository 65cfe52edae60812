"""Local executor for evaluation plans, with the code of the local worker processes."""

from embomatrix.worker.slots.rollout_pool import execute_scene


class HereExecutor:
    """Executor that runs every rollout at once; ``executed`` counts the rollouts."""

    def __init__(self, folder):
        self.folder = folder
        self.executed = 0

    def execute(self, rollouts, on_result):
        scenes = {}
        for rollout in rollouts:
            scenes.setdefault(rollout.bundle_digest, []).append(rollout)
        for scene in scenes.values():
            for rollout_id, outcome in execute_scene(self.folder, scene):
                self.executed += 1
                on_result(rollout_id, outcome)
