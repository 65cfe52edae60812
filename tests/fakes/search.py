"""Exhaustive plan search in small scenes, a reference for the oracle, with random scenes and goals.

The search is breadth-first over skill calls in the real cached simulator. A *deed* is one call that can change the
facts, preceded by the drive to its object. A state is identified by the truth of every atom of the goals, and by the
hand.
"""

from __future__ import annotations

import contextlib
import itertools
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from tests.fakes import furniture as make
from tests.fakes.formulas import exists, forall, forn, forpairs
from tests.fakes.plans import task_over, words_of
from tests.fakes.pose_caches import build_pose_cache
from tests.fakes.scenes import NORTH, SOUTH, WEST, placed, scene_of, upright

from embomatrix.sim.planner.oracle import PROOF_SEEDS, PlanNotFound, find_plan
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.check import check
from embomatrix.skills.syntax import PlaceRelation, Skill, SkillCall
from embomatrix.world.bundle import Bundle
from embomatrix.world.evaluate import evaluate, render
from embomatrix.world.goal import And, Atom, Imply, Not, Or
from embomatrix.world.state import Relation, State

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.sim.executor import Simulator
    from embomatrix.sim.live_world import LiveWorld
    from embomatrix.skills.syntax import Plan
    from embomatrix.world.asset import Asset
    from embomatrix.world.goal import Formula
    from embomatrix.world.scene import Scene, SceneObject
    from embomatrix.world.task import Task

SEED = 0
AIMED = (Relation.ONTOP, Relation.INSIDE, Relation.UNDER)
MOVABLES = 3
"""Number of small objects in a scene."""
FURNITURE = 4
WALKS = 4
STIRRED = 6
"""Random deeds before a scene is saved: doors are open and objects lie in others."""


def deeds(task: Task) -> tuple[SkillCall, ...]:
    """Return every call that can change a fact."""
    rows = range(len(task.table))
    plain = (Skill.PICK_UP, Skill.OPEN, Skill.CLOSE, Skill.TOGGLE_ON, Skill.TOGGLE_OFF)
    found = [SkillCall(skill, object_index=row) for row in rows for skill in plain]
    found += [
        SkillCall(Skill.PLACE, object_index=row, relation=relation)
        for row in rows
        for relation in PlaceRelation
    ]
    return tuple(found)


def explore(
    simulator: Simulator, task: Task, atoms: Sequence[Atom], limit: int, depth: int
) -> Iterator[Plan]:
    """Yield plans to every new state of facts, fewest deeds first; the simulator is in that state at each yield.

    Ends after ``limit`` states or at plans of ``depth`` deeds.
    """
    simulator.reset(task, SEED)
    known = {_key(simulator, atoms)}
    waiting: deque[tuple[Plan, int]] = deque([((), 0)])
    while waiting and len(known) < limit:
        plan, done = waiting.popleft()
        if done == depth:
            return
        for following in _followers(simulator, task, plan):
            key = _key(simulator, atoms)
            if key not in known:
                known.add(key)
                waiting.append((following, done + 1))
                yield following


def _followers(simulator: Simulator, task: Task, plan: Plan) -> Iterator[Plan]:
    """Yield the plan extended by one successful deed; the simulator is in the resulting state."""
    for row, calls in itertools.groupby(deeds(task), lambda call: call.object_index):
        _replay(simulator, task, plan)
        drive = SkillCall(Skill.MOVE, object_index=row)
        way = (*plan, drive) if simulator.run_step(drive).ok else plan
        for call in calls:
            if check(simulator.world, call) is None and simulator.run_step(call).ok:
                yield (*way, call)
                _replay(simulator, task, way)


def _replay(simulator: Simulator, task: Task, plan: Plan) -> None:
    simulator.reset(task, SEED)
    for call in plan:
        simulator.run_step(call)


def _key(simulator: Simulator, atoms: Sequence[Atom]) -> tuple[object, ...]:
    facts = simulator.facts
    return (simulator.world.carried, *(facts.holds(atom.predicate, atom.args) for atom in atoms))


def atoms_over(scene: Scene) -> tuple[Atom, ...]:
    """Return every ground atom that a skill on the scene's table might change and that distinguishes two states."""
    small = [item.name for item in scene.objects if not item.fixed]
    names = [item.name for item in scene.objects]
    found = [Atom(relation.value, (a, b)) for relation in AIMED for a in small for b in names if a != b]
    found += [Atom("inroom", (a, room.name)) for a in small for room in scene.rooms]
    for item in scene.objects:
        asset = scene.assets[item.asset_id]
        able = {
            State.OPEN: bool(asset.joints),
            State.TOGGLED_ON: asset.can("toggleable"),
            State.HOT: asset.can("heatable"),
            State.COOKED: asset.can("cookable"),
            State.FROZEN: asset.can("freezable"),
        }
        found += [Atom(state.value, (item.name,)) for state, can in able.items() if can]
    return tuple(found)


def beside_atoms(scene: Scene) -> tuple[Atom, ...]:
    """Return atoms about neighbours, which most states share."""
    small = [item.name for item in scene.objects if not item.fixed]
    return tuple(
        Atom(relation.value, (a, item.name))
        for relation in (Relation.NEXTTO, Relation.TOUCHING)
        for a in small
        for item in scene.objects
        if a != item.name
    )


def small_scene(rng: np.random.Generator, number: int) -> Scene:
    """Return the flat with four pieces of furniture and three small objects after some random calls."""
    scene = scene_of(f"small_{number}", _objects(rng))
    with contextlib.closing(load_simulator(Bundle(scene, {}))) as simulator:
        task = task_over(scene)
        for _ in range(STIRRED):
            simulator.reset(task, SEED)
            plan = _random_plan(simulator, task, rng)
            if not simulator.world.carried and plan:
                return _frozen(scene, simulator.world)
    return scene


def _random_plan(simulator: Simulator, task: Task, rng: np.random.Generator) -> Plan:
    done: list[SkillCall] = []
    rows = deeds(task)
    for _ in range(60):
        call = rows[int(rng.integers(len(rows)))]
        simulator.run_step(SkillCall(Skill.MOVE, object_index=call.object_index))
        if simulator.run_step(call).ok:
            done.append(call)
        if len(done) >= STIRRED and not simulator.world.carried:
            break
    return tuple(done)


def _frozen(scene: Scene, world: LiveWorld) -> Scene:
    """Return the scene in its current state."""

    def now(item: SceneObject) -> SceneObject:
        host = world.relations.host_of(item.name)
        return replace(
            item,
            room=world.room_of(item.name),
            pose_world_asset=world.engine.pose(item.name),
            joints=world.engine.joints(item.name),
            host=host.name if host is not None else "",
            relation=host.relation if host is not None else None,
            states=frozenset(world.states[item.name]),
        )

    return replace(scene, objects=tuple(now(item) for item in scene.objects))


def _objects(rng: np.random.Generator) -> list[tuple[SceneObject, Asset]]:
    kitchen, living = "kitchen_0", "living_room_0"
    spots = {
        "fridge_1": (make.fridge(), kitchen, (0.6, 3.65, SOUTH)),
        "stove_1": (make.stove(), kitchen, (3.4, 3.7, SOUTH)),
        "breakfast_table_1": (make.kitchen_table(), kitchen, (2.0, 1.3, 0.0)),
        "shelf_1": (make.shelf(), living, (8.95, 2.0, WEST)),
        "cabinet_1": (make.cabinet(), living, (6.5, 0.225, NORTH)),
        "sink_1": (make.sink(), kitchen, (4.3, 3.7, SOUTH)),
    }
    counter, microwave = make.counter(), make.microwave()
    found = [
        (placed("countertop_1", counter, kitchen, upright(2.2, 3.7, 0, counter, SOUTH), fixed=True), counter)
    ]
    for name in rng.permutation(sorted(spots)).tolist()[: FURNITURE - 1]:
        asset, room, (x, y, yaw) = spots[name]
        found.append((placed(name, asset, room, upright(x, y, 0, asset, yaw), fixed=True), asset))
    if rng.random() < 0.6:
        pose = upright(2.6, 3.75, 0.9, microwave, SOUTH)
        item = placed(
            "microwave_1", microwave, kitchen, pose, fixed=True, host="countertop_1", relation=Relation.ONTOP
        )
        found.append((item, microwave))
    tray = replace(make.block("tray", "tray.n.01", (0.3, 0.3, 0.02), {}), mass_kg=0.5)
    small = {
        "apple_1": make.apple(),
        "apple_2": make.apple(),
        "bowl_1": make.bowl(),
        "mug_1": make.mug(),
        "tray_1": tray,
        "table_lamp_1": make.table_lamp(),
        "chicken_leg_1": make.chicken_leg(),
    }
    for number, name in enumerate(rng.permutation(sorted(small)).tolist()[:MOVABLES]):
        asset = small[name]
        pose = upright(1.6 + 0.35 * number, 3.6, 0.9, asset)
        item = placed(name, asset, kitchen, pose, host="countertop_1", relation=Relation.ONTOP)
        found.append((item, asset))
    return found


def likely_atoms(
    simulator: Simulator, task: Task, atoms: Sequence[Atom], rng: np.random.Generator
) -> tuple[Atom, ...]:
    """Return atoms that a random walk makes true; most goals over other atoms are unreachable."""
    found: set[Atom] = set()
    for _ in range(WALKS):
        simulator.reset(task, SEED)
        _random_plan(simulator, task, rng)
        found |= {atom for atom in atoms if simulator.facts.holds(atom.predicate, atom.args)}
    return tuple(atom for atom in atoms if atom in found)


def random_goal(task: Task, atoms: Sequence[Atom], rng: np.random.Generator) -> Formula:
    """Return a goal of one to three parts over the atoms: literals, alternatives, implications and quantifiers."""
    parts = [_part(task, atoms, rng) for _ in range(int(rng.integers(1, 4)))]
    return parts[0] if len(parts) == 1 else And(tuple(parts))


def _part(task: Task, atoms: Sequence[Atom], rng: np.random.Generator) -> Formula:
    kind = rng.random()
    if kind < 0.6:
        return _literal(atoms, rng)
    if kind < 0.7:
        return Or((_literal(atoms, rng), _literal(atoms, rng)))
    if kind < 0.8:
        return Imply(_literal(atoms, rng), _literal(atoms, rng))
    return _quantified(task, atoms, rng)


def _literal(atoms: Sequence[Atom], rng: np.random.Generator) -> Formula:
    """Return a literal; every predicate is equally likely."""
    by_predicate = sorted({atom.predicate for atom in atoms})
    predicate = by_predicate[int(rng.integers(len(by_predicate)))]
    able = [atom for atom in atoms if atom.predicate == predicate]
    atom = able[int(rng.integers(len(able)))]
    return Not(atom) if rng.random() < 0.25 else atom


def _quantified(task: Task, atoms: Sequence[Atom], rng: np.random.Generator) -> Formula:
    """Return a quantifier over the type of an atom's first argument; pairs quantify over the second argument."""
    atom = atoms[int(rng.integers(len(atoms)))]
    kinds = {name: synset for synset, names in task.types.items() for name in names}
    first, *rest = atom.args
    body = Atom(atom.predicate, ("?a", *rest))
    forms: list[Formula] = [
        forall("?a", kinds[first], body),
        exists("?a", kinds[first], body),
        forn(1, "?a", kinds[first], body),
        forall("?a", kinds[first], Not(body)),
    ]
    if rest and rest[0] in kinds:
        forms.append(forpairs("?a", kinds[first], "?b", kinds[rest[0]], Atom(atom.predicate, ("?a", "?b"))))
    return forms[int(rng.integers(len(forms)))]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Goals of one scene for which the search found a plan, and a sentence about each that the oracle missed."""

    found: int
    missed: tuple[str, ...]


def compare(number: int, goals: int, limit: int, depth: int = 9) -> Comparison:
    """Sample a small scene and goals, search for plans to all goals at once, and compare with the oracle."""
    rng = np.random.default_rng(number)
    scene = small_scene(rng, number)
    small = [item.name for item in scene.objects if not item.fixed]
    poses = build_pose_cache(scene, small, [item.name for item in scene.objects], seed=0)
    with contextlib.closing(load_simulator(Bundle(scene, {}, poses))) as simulator:
        task = task_over(scene)
        atoms = atoms_over(scene)
        pool = likely_atoms(simulator, task, (*atoms, *beside_atoms(scene)), rng)
        asked = _open_goals(simulator, task, pool, goals, rng)
        plans = _search(simulator, task, asked, tuple(dict.fromkeys((*atoms, *pool))), limit, depth)
        missed = []
        for goal, plan in plans.items():
            answer = find_plan(simulator, task_over(scene, goal))
            if isinstance(answer, PlanNotFound):
                missed.append(
                    f"scene {number}: {render(goal)}: {answer.reason}; search: {words_of(plan, task)}"
                )
        return Comparison(len(plans), tuple(missed))


def _open_goals(
    simulator: Simulator, task: Task, pool: Sequence[Atom], count: int, rng: np.random.Generator
) -> list[Formula]:
    """Return distinct goals that don't hold at the start."""
    simulator.reset(task, SEED)
    found: dict[Formula, None] = {}
    while len(found) < count:
        goal = random_goal(task, pool, rng)
        if not evaluate(goal, simulator.facts, task.types):
            found[goal] = None
    return list(found)


def _search(
    simulator: Simulator, task: Task, goals: Sequence[Formula], atoms: Sequence[Atom], limit: int, depth: int
) -> dict[Formula, Plan]:
    """Return the first plan for each goal that succeeds with every seed required of the oracle."""
    plans: dict[Formula, Plan] = {}
    for plan in explore(simulator, task, atoms, limit, depth):
        facts = simulator.facts
        reached = [goal for goal in goals if goal not in plans and evaluate(goal, facts, task.types)]
        for goal in reached:
            if all(_reaches(simulator, task, plan, goal, seed) for seed in PROOF_SEEDS):
                plans[goal] = plan
        if len(plans) == len(goals):
            break
    return plans


def _reaches(simulator: Simulator, task: Task, plan: Plan, goal: Formula, seed: int) -> bool:
    trace = simulator.execute(task, plan, seed)
    return trace.failure is None and evaluate(goal, simulator.facts, task.types)
