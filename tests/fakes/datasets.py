"""Small datasets in the flat, for tests of commands."""

from dataclasses import replace

from tests.fakes.plans import plan_of
from tests.fakes.scenes import kitchen_scene, kitchen_tasks

from embomatrix.sim.planner.oracle import find_plan
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import plan_to_json
from embomatrix.world.bundle import Bundle, encode_bundle
from embomatrix.world.dataset import TaskRecord, write_dataset
from embomatrix.world.inflation import bundle_digest

HELD_OUT = "tidy_up"


def write_kitchen_dataset(folder):
    """Write three training tasks and one held-out task with the oracle's plans; returns the folder."""
    scene = kitchen_scene()
    tasks = {task.task_id: task for task in kitchen_tasks(scene)}
    bundle = Bundle(scene, tasks)
    data = encode_bundle(bundle)
    digest = bundle_digest(data)
    simulator = load_simulator(bundle)
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


def write_flats_dataset(folder, count, plans):
    """Write ``count`` copies of the flat under different names, with a task for each of ``plans`` (text by task id)."""
    records, bundles = [], {}
    for number in range(count):
        scene = replace(kitchen_scene(), scene_id=f"flat_{number}")
        tasks = [task for task in kitchen_tasks(scene) if task.task_id in plans]
        data = encode_bundle(Bundle(scene, {task.task_id: task for task in tasks}))
        bundles[bundle_digest(data)] = data
        records += [
            TaskRecord(
                task,
                bundle_digest(data),
                "train",
                tuple(plan_to_json(plan_of(task, plans[task.task_id]))),
                ("kitchen_0",),
                "",
            )
            for task in tasks
        ]
    write_dataset(folder, records, bundles)
    return folder
