"""A dataset of four tasks in the flat, small enough for commands under test."""

from tests.fakes.scenes import kitchen_scene, kitchen_tasks

from embomatrix.sim.executor import Simulator
from embomatrix.sim.planner.oracle import find_plan
from embomatrix.skills.parse import plan_to_json
from embomatrix.world.bundle import Bundle, bundle_digest, encode_bundle
from embomatrix.world.dataset import TaskRecord, write_dataset

HELD_OUT = "tidy_up"


def write_kitchen_dataset(folder):
    """Three tasks to train on and one held out, each with the oracle's plan; returns the folder."""
    scene = kitchen_scene()
    tasks = {task.task_id: task for task in kitchen_tasks(scene)}
    bundle = Bundle(scene, tasks)
    data = encode_bundle(bundle)
    digest = bundle_digest(data)
    simulator = Simulator(bundle)
    records = [
        TaskRecord(
            task,
            digest,
            "heldout" if task.task_id == HELD_OUT else "train",
            tuple(plan_to_json(find_plan(simulator, task))),
            ("kitchen_0",),
            task.category.value,
        )
        for task in tasks.values()
    ]
    write_dataset(folder, records, {digest: data})
    return folder
