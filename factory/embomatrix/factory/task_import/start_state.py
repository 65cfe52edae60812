"""Start state of a scene: position of the robot, open doors, symbolic states and substances."""

import dataclasses
from collections import defaultdict
from collections.abc import Iterable

import numpy as np

from embomatrix.factory.admission import RefusalReason, RefusedError
from embomatrix.factory.scenes.floor import ReachableFloor
from embomatrix.factory.scenes.joints import with_joints
from embomatrix.world.bddl import InitLiteral
from embomatrix.world.scene import RobotStart, Scene, SceneObject
from embomatrix.world.state import State, SubstanceFact, SubstanceRelation


def with_robot_in(scene: Scene, room_name: str) -> Scene:
    """Return the scene with the robot on the free floor nearest to the room's centre. Raise RefusedError if there is none."""
    if scene.robot.room == room_name:
        return scene
    room = next(room for room in scene.rooms if room.name == room_name)
    cells = ReachableFloor(scene).cells(room.low_m, room.high_m)  # (n, 2)
    if not len(cells):
        raise RefusedError(
            RefusalReason.DOES_NOT_FIT, f"no free floor of {room_name} can be reached by the robot"
        )
    x, y = cells[np.argmin(np.hypot(*(cells - np.asarray(room.center_m)).T))]
    return dataclasses.replace(scene, robot=RobotStart(float(x), float(y), 0.0, room_name))


def with_states(scene: Scene, literals: Iterable[InitLiteral]) -> Scene:
    """Return the scene with doors, states and substances as the literals say. Relations are ignored."""
    shares: dict[str, float] = {}
    # A literal about something that is no object of the scene, such as a substance, changes nothing.
    states = defaultdict(set, {item.name: set(item.states) for item in scene.objects})
    substances = defaultdict(set, {item.name: set(item.substances) for item in scene.objects})
    # Negative literals come last: they win over positive ones.
    for literal in sorted(literals, key=lambda literal: not literal.positive):
        name, predicate = literal.atom.args[0], literal.atom.predicate
        if predicate == State.OPEN:
            shares[name] = float(literal.positive)
        elif predicate in set(SubstanceRelation):
            fact = SubstanceFact(SubstanceRelation(predicate), literal.atom.args[1])
            (substances[name].add if literal.positive else substances[name].discard)(fact)
        elif predicate in set(State):
            (states[name].add if literal.positive else states[name].discard)(State(predicate))

    def changed(item: SceneObject) -> SceneObject:
        facts = frozenset(substances[item.name])
        return dataclasses.replace(item, states=frozenset(states[item.name]), substances=facts)

    objects = {item.name: item for item in scene.objects}
    for name, share in shares.items():
        joints = (share,) * len(scene.asset_of(name).joints)
        objects |= with_joints(objects, scene.assets, name, joints)
    return dataclasses.replace(scene, objects=tuple(changed(item) for item in objects.values()))
