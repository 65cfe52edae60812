"""Playback of a plan call by call: robot pose, carried objects and moved objects after each step."""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass

from embomatrix.factory.admission import SEED, oracle_plan
from embomatrix.reward.hierarchy import score
from embomatrix.sim.executor import Simulator
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.describe import call_in_words
from embomatrix.world.bundle import Bundle
from embomatrix.world.dataset import TaskRecord
from embomatrix.world.evaluate import evaluate, render, scored_atoms


@dataclass(frozen=True, slots=True)
class PlayMoment:
    """State after a call. The first moment, without a call, is the start.

    ``things_m`` maps the small objects of the table to their positions, ``held`` lists carried objects, ``goal`` the
    goal's atoms with their truth.
    """

    call: str
    said: str
    robot_m: tuple[float, float]
    yaw: float
    held: tuple[str, ...]
    things_m: dict[str, tuple[float, float]]
    open_or_on: tuple[str, ...]
    goal: tuple[tuple[str, bool], ...]


@dataclass(frozen=True, slots=True)
class OraclePlayback:
    """Oracle plan from start to end. ``final`` describes the final state, ``reward`` is the reward earned."""

    moments: tuple[PlayMoment, ...]
    final: tuple[str, ...]
    reward: float
    success: bool


def play_oracle(record: TaskRecord, bundle: Bundle) -> OraclePlayback:
    """Execute the record's oracle plan in its bundle.

    Raise EngineError if the scene can't be loaded, DatasetError if the plan can't be read.
    """
    task, plan = record.task, oracle_plan(record)
    with contextlib.closing(load_simulator(bundle)) as simulator:
        simulator.reset(task, SEED)
        moments = [_moment(simulator, record, "", "")]
        for call in plan:
            step = simulator.run_step(call)
            moments.append(_moment(simulator, record, call_in_words(call, task.table), step.message))
            if not step.ok:
                break
        trace = simulator.execute(task, plan, SEED)
        reward = score(task, trace.touched, simulator.facts)
    return OraclePlayback(tuple(moments), trace.final, reward.total, reward.success)


def _moment(simulator: Simulator, record: TaskRecord, call: str, said: str) -> PlayMoment:
    world, task = simulator.world, record.task
    return PlayMoment(
        call=call,
        said=said,
        robot_m=(world.robot.x_m, world.robot.y_m),
        yaw=world.robot.yaw,
        held=tuple(world.carried),
        things_m=_things(simulator, task.table),
        open_or_on=tuple(name for name in task.table if world.is_open(name) or world.is_on(name)),
        goal=tuple(
            (render(atom), evaluate(atom, simulator.facts, task.types))
            for atom in scored_atoms(task.goal, task.types)
        ),
    )


def _things(simulator: Simulator, table: Sequence[str]) -> dict[str, tuple[float, float]]:
    world = simulator.world
    found: dict[str, tuple[float, float]] = {}
    for name in table:
        if world.is_fixed(name) or not world.is_real(name):
            continue
        x, y, _ = world.engine.aabb(name).center_m
        found[name] = (world.robot.x_m, world.robot.y_m) if name in world.carried else (x, y)
    return found
