"""Executor of an evaluation's plans in this process, with the code of the local processes."""

from embomatrix.worker.slots.rollout_pool import execute_scene


class HereExecutor:
    """Executes every rollout at once; ``executed`` counts them."""

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
