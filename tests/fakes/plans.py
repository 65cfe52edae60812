"""Plans in words, tasks over a scene, and the flat with extra objects, for tests of the executor."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from tests.fakes import furniture as make
from tests.fakes.scenes import kitchen_scene, placed, upright

from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import parse_plan
from embomatrix.world.bundle import Bundle
from embomatrix.world.evaluate import render
from embomatrix.world.goal import And, Formula
from embomatrix.world.task import Profile, Task, TaskCategory

if TYPE_CHECKING:
    from collections.abc import Iterable

    from embomatrix.sim.executor import Simulator
    from embomatrix.skills.syntax import Plan
    from embomatrix.skills.trace import Trace
    from embomatrix.world.asset import Asset
    from embomatrix.world.scene import Scene, SceneObject

NOTHING = And(())
"""A goal that always holds."""


def task_over(scene: Scene, goal: Formula = NOTHING, task_id: str = "test") -> Task:
    """Return a task whose table lists every object of the scene in its order."""
    types = {
        synset: tuple(item.name for item in scene.objects if scene.assets[item.asset_id].synset == synset)
        for synset in sorted({asset.synset for asset in scene.assets.values()})
    }
    table = tuple(item.name for item in scene.objects)
    return Task(task_id, scene.scene_id, "Do it.", TaskCategory.COMPOUND, goal, render(goal), table, types)


def plan_of(task: Task, text: str) -> Plan:
    """Parse calls separated by semicolons, with objects by name: ``move fridge_1; open fridge_1``."""
    calls = [
        " ".join(str(task.index_of.get(word, word)) for word in call.split()) for call in text.split(";")
    ]
    return parse_plan("\n".join(calls), Profile.HOUSEHOLD)


def words_of(plan: Plan, task: Task) -> str:
    """Format calls on objects as ``plan_of`` parses them."""
    calls = []
    for call in plan:
        words = [call.skill.value]
        words += [task.table[index] for index in (call.object_index, call.source_index) if index is not None]
        words += [call.relation.value] if call.relation is not None else []
        calls.append(" ".join(words))
    return "; ".join(calls)


def with_objects(scene: Scene, extra: Iterable[tuple[SceneObject, Asset]]) -> Scene:
    """Return the scene with more objects appended."""
    items = list(extra)
    return replace(
        scene,
        objects=(*scene.objects, *(item for item, _ in items)),
        assets={**scene.assets, **{asset.asset_id: asset for _, asset in items}},
    )


def awkward_scene() -> Scene:
    """Return the flat with one object for each failure reason that the plain flat can't produce."""
    kitchen, living = "kitchen_0", "living_room_0"
    anvil = replace(make.block("anvil", "anvil.n.01", (0.2, 0.1, 0.1), {}), mass_kg=30.0)
    chest = make.block("chest", "chest.n.01", (0.5, 0.5, 0.5), {})
    tray = replace(make.block("tray", "tray.n.01", (0.3, 0.3, 0.02), {}), mass_kg=0.5)
    tower = make.block("tower", "tower.n.01", (0.4, 0.4, 2.2), {})
    heat = {"temperature": 42.0, "requires_toggled_on": 0.0, "requires_closed": 0.0, "requires_inside": 0.0}
    warmer = make.block("warmer", "space_heater.n.01", (0.3, 0.3, 0.05), {"heatSource": heat})
    cold = {"temperature": 4.0, "requires_toggled_on": 0.0, "requires_closed": 0.0, "requires_inside": 1.0}
    cooler = make.tub(
        "cooler", "cooler.n.01", (0.3, 0.3, 0.2), 0.02, 0.02, mass_kg=2.0, abilities={"coldSource": cold}
    )
    apple = make.apple()
    counter, board = 0.9, 0.75
    return with_objects(
        kitchen_scene(),
        [
            (placed("anvil_1", anvil, kitchen, upright(2.2, 1.6, board, anvil)), anvil),
            (placed("chest_1", chest, kitchen, upright(0.3, 0.3, 0.0, chest)), chest),
            (placed("tray_1", tray, kitchen, upright(1.8, 1.2, board, tray)), tray),
            (placed("apple_3", apple, kitchen, upright(1.8, 1.2, board + 0.02, apple)), apple),
            (placed("tower_1", tower, living, upright(5.4, 3.75, 0.0, tower), fixed=True), tower),
            (placed("apple_4", apple, living, upright(5.4, 3.75, 2.2, apple)), apple),
            (placed("warmer_1", warmer, kitchen, upright(1.6, 3.7, counter, warmer), fixed=True), warmer),
            (placed("cooler_1", cooler, kitchen, upright(2.0, 3.7, counter, cooler), fixed=True), cooler),
        ],
    )


def executed(simulator: Simulator, text: str, goal: Formula = NOTHING, seed: int = 0) -> Trace:
    """Return the trace of a plan in words. The simulator then holds the final state."""
    task = task_over(simulator.world.scene, goal)
    return simulator.execute(task, plan_of(task, text), seed)


def executed_alone(scene: Scene, text: str) -> Trace:
    """Return the trace of a plan in words from a dedicated simulator."""
    simulator = load_simulator(Bundle(scene, {}))
    try:
        return executed(simulator, text)
    finally:
        simulator.close()
