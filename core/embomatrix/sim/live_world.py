"""State of a rollout: the engine's scene, the symbolic states, the robot's base and its hand."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace

from embomatrix.sim.engine import EngineMark, PhysicsEngine
from embomatrix.sim.floor.navigation import Navigator
from embomatrix.sim.floor.prepared import PreparedScene, prepared_arrays
from embomatrix.sim.joints.swings import Swings
from embomatrix.sim.placing.placement import Placer
from embomatrix.sim.state.facts import EngineFacts, TrackedSets
from embomatrix.sim.state.relations import Relations
from embomatrix.sim.state.sources import Change, ChangeReader, Thermal, Unread, Water
from embomatrix.sim.state.supports import Host
from embomatrix.skills.appliances import cold_source, heat_source
from embomatrix.skills.view import ObjectReach
from embomatrix.world.asset import Asset
from embomatrix.world.bundle import Bundle
from embomatrix.world.geometry import Pose
from embomatrix.world.poses import StandPose
from embomatrix.world.state import Relation, State, SubstanceFact
from embomatrix.world.substances import MEANINGS, facts_of
from embomatrix.world.task import Task

LASTING = frozenset(Relation) - {Relation.INROOM}
"""Relations between objects that are carried together."""
SYMBOLIC = frozenset(State) - {State.OPEN} - MEANINGS.keys()


@dataclass(frozen=True, slots=True)
class HandMark:
    """State of the hand."""

    hosts: Mapping[str, Host]
    pairs: frozenset[tuple[Relation, str, str]]
    offsets: Mapping[str, Pose]


@dataclass(frozen=True, slots=True)
class WorldMark:
    """State of a rollout's world, as far as it differs from the scene's start."""

    engine: EngineMark
    states: Mapping[str, frozenset[State]]
    substances: Mapping[str, frozenset[SubstanceFact]]
    treatments: Mapping[str, frozenset[tuple[State, str]]]
    absent: frozenset[str]
    hand: HandMark
    robot: StandPose
    unread: Unread
    acting: frozenset[str]
    table: tuple[str, ...]

    def changed_since(self, before: WorldMark) -> set[str]:
        """Return the objects whose place, states, substances or presence differ from those in an earlier state."""
        parts: tuple[tuple[Mapping[str, object], Mapping[str, object]], ...] = (
            (self.engine, before.engine),
            (self.states, before.states),
            (self.substances, before.substances),
            (self.hand.offsets, before.hand.offsets),
        )
        found = self.absent ^ before.absent
        for now, then in parts:
            found |= {name for name in now.keys() | then.keys() if now.get(name) != then.get(name)}
        return set(found)


class Hand:
    """Hand of the robot: holds one object with its contents. Empty at first."""

    def __init__(self, engine: PhysicsEngine, relations: Relations) -> None:
        self._engine = engine
        self._relations = relations
        self.hosts: Mapping[str, Host] = {}
        """Hosts of the contents of the held object."""
        self.pairs: set[tuple[Relation, str, str]] = set()
        """Relations between the held object and its contents, which last while they are carried. Changed in place."""
        self.offsets: Mapping[str, Pose] = {}
        """Poses of the held object and its contents in the frame of the held object."""
        self.carried: tuple[str, ...] = ()
        """Held object, then its contents; empty for an empty hand."""

    def forget(self) -> None:
        """Empty the hand without placing anything, after a reset of the world."""
        self._hold({})

    def mark(self) -> HandMark:
        """Return the state for ``return_to``."""
        return HandMark(self.hosts, frozenset(self.pairs), self.offsets)

    def return_to(self, mark: HandMark) -> None:
        """Take on a state without moving anything."""
        self._hold(mark.offsets)
        self.hosts = mark.hosts
        self.pairs.update(mark.pairs)

    def take(self, group: Sequence[str]) -> None:
        """Take the first object of the group, with the others as its contents."""
        back, holds = self._engine.pose(group[0]).inverse(), self._relations.holds
        hosts = {item: host for item in group[1:] if (host := self._relations.host_of(item)) is not None}
        pairs = itertools.product(LASTING, itertools.permutations(group, 2))
        kept = [(relation, a, b) for relation, (a, b) in pairs if holds(relation, a, b)]
        self._hold({item: back @ self._engine.pose(item) for item in group})
        self.hosts = hosts
        self.pairs.update(kept)
        for item in group:
            self._engine.park(item)

    def let_go(self, pose: Pose) -> bool:
        """Place the held object with its contents. Return False and change nothing if the contents do not fit."""
        held, *contents = self.carried
        for item in contents:
            self._engine.set_pose(item, pose @ self.offsets[item])
        # Set directly instead of multiplied by the identity: the placer's pose stays exact to the last bit.
        self._engine.set_pose(held, pose)
        group = frozenset(self.carried)
        if any(self._engine.penetrates(item, ignore=group) for item in contents):
            for item in group:
                self._engine.park(item)
            return False
        self._hold({})
        return True

    def _hold(self, offsets: Mapping[str, Pose]) -> None:
        self.offsets, self.carried, self.hosts = offsets, tuple(offsets), {}
        self.pairs.clear()


class LiveWorld:
    """World of one rollout at a time: answers preconditions, and holds the robot, the hand and the states."""

    def __init__(self, bundle: Bundle, engine: PhysicsEngine) -> None:
        """``engine`` must hold the bundle's scene as loaded."""
        self.scene = bundle.scene
        self.engine = engine
        self.relations = Relations(engine)
        self.navigator = Navigator(engine, self.relations, bundle.poses.stands, PreparedScene.of(bundle))
        self.swings = Swings(engine, self.relations)
        self.placer = Placer(engine, self.relations, bundle.poses, self.navigator)
        self.arm_blockers = bundle.poses.arm_blockers
        """Blockers of the arm in the scene as loaded, by handling and target."""
        self.placing_blockers = bundle.poses.placing_blockers
        """Blockers of placing in the scene as loaded, by relation, held object and target."""
        self.states: TrackedSets[State] = TrackedSets()
        self.substances: TrackedSets[SubstanceFact] = TrackedSets()
        self.treatments: TrackedSets[tuple[State, str]] = TrackedSets()
        """Thermal states of each object with the sources that brought them about."""
        self._future = frozenset(item.name for item in self.scene.objects if item.absent)
        self.absent: set[str] = set(self._future)
        self._changes_since = ChangeReader(engine)
        self.thermal = Thermal(engine, self.relations, self.states, self.treatments)
        self.water = Water(engine, self.relations, self.states, self.substances)
        self.hand = Hand(engine, self.relations)
        self.facts = EngineFacts(
            self.relations,
            self.states,
            self.substances,
            self.absent,
            self._future,
            self.hand.pairs,
            self.treatments,
        )
        self.table: tuple[str, ...] = ()
        self.rooms = tuple(room.name for room in self.scene.rooms)
        self.robot = self.navigator.start
        self._robot_text: tuple[StandPose | None, str] = (None, "")
        """Robot's pose in the last ``state_bytes``, and its text: half of the calls do not move the robot."""
        for item in self.scene.objects:
            self.states[item.name] = set(item.states & SYMBOLIC)
            self.substances[item.name] = set(facts_of(item.states, item.substances))
            self.treatments[item.name] = set()
        self.let_sources_act()
        self.states.snapshot()
        self.substances.snapshot()
        self.treatments.snapshot()

    def reset(self, task: Task) -> None:
        """Return to the scene's start, after the sources have acted on the objects at them."""
        self.engine.reset()
        self.states.restore()
        self.substances.restore()
        self.treatments.restore()
        self.absent.clear()
        self.absent |= self._future
        self.hand.forget()
        self.robot = self.navigator.start
        self.navigator.refresh()
        self.table = task.table

    def mark(self) -> WorldMark:
        """Return the present state for ``return_to``."""
        return WorldMark(
            self.engine.mark(),
            self.states.mark(),
            self.substances.mark(),
            self.treatments.mark(),
            frozenset(self.absent),
            self.hand.mark(),
            self.robot,
            self._changes_since.unread(),
            self.water.acting,
            self.table,
        )

    def return_to(self, mark: WorldMark) -> None:
        """Take on a state of this world since the last reset. All that follows is bit-equal to what followed then."""
        # By way of the start: caches of the scene as loaded are valid again, and the journal of changes stays short.
        self.engine.reset()
        self.engine.return_to(mark.engine)
        self.states.return_to(mark.states)
        self.substances.return_to(mark.substances)
        self.treatments.return_to(mark.treatments)
        self.absent.clear()
        self.absent |= mark.absent
        self.hand.return_to(mark.hand)
        self.robot = mark.robot
        self._changes_since.keep(mark.unread)
        self.water.return_to(mark.acting)
        self.table = mark.table
        self.navigator.refresh()

    def warm_up(self, tables: Sequence[Sequence[str]]) -> Iterator[None]:
        """Look for places beside and behind the open doors of each table's objects, one object per step. Changes no answer.

        A step opens the object and resets the engine. Nothing happens while a rollout has changed the scene.
        """
        for name in dict.fromkeys(itertools.chain.from_iterable(tables)):
            if not self.swings.is_predicted(name) or self.engine.state_bytes() or self.states.changed():
                continue
            before = self.navigator.nearest_stand(name, self.navigator.start)
            self.swings.open(name)
            self.navigator.refresh()
            if before is not None:
                self.navigator.step_aside(name, before)
                beside = self.navigator.nearest_stand(name, before)
                self.placer.look_into(name, tables, beside or before)
            self.engine.reset()
            self.navigator.refresh()
            yield

    def let_sources_act(self) -> tuple[Change, ...]:
        """Let heat, cold and water act on the objects at their sources. Return the changes."""
        self._changes_since.read()
        return (*self.thermal.apply(self._changes_since), *self.water.apply(self._changes_since))

    def is_untouched(self, name: str) -> bool:
        """Return True if the object, its place and its states are certainly those at the start."""
        return (
            self.relations.supports.are_untouched((name,))
            and self.states.is_untouched(name)
            and self.substances.is_untouched(name)
        )

    @property
    def carried(self) -> tuple[str, ...]:
        """Held object, then its contents; empty for an empty hand."""
        return self.hand.carried

    def asset(self, name: str) -> Asset:
        return self.scene.asset_of(name)

    def is_fixed(self, name: str) -> bool:
        return self.scene.by_name[name].fixed

    def is_open(self, name: str) -> bool:
        return self.relations.open(name)

    def is_on(self, name: str) -> bool:
        return State.TOGGLED_ON in self.states.get(name, ())

    def cargo(self, name: str) -> tuple[str, ...]:
        """Objects that are lifted together: the object, its contents and what rests on those."""
        return self.relations.group_of(name)

    def burden(self, name: str) -> str:
        """First object that rests on this one without lying in it; "" for none."""
        cargo = set(self.cargo(name))
        return next((item for item in self.relations.resting_on(name) if item not in cargo), "")

    def closed_around(self, name: str) -> str:
        """Innermost closed container around the object; "" for none."""
        return next((item.name for item in self.relations.enclosing(name) if item.closed), "")

    def reach(self, name: str) -> ObjectReach:
        """Reach from the robot's position to the object's box with doors shut; zero distance for a carried object."""
        box = self.relations.body(name)
        if name in self.carried:
            return ObjectReach(0.0, box.center_m[2])
        return ObjectReach(box.level_distance_m(self.robot.x_m, self.robot.y_m), box.center_m[2])

    def is_approachable(self, name: str) -> bool:
        """Return True if no wall and nothing much taller than the object stands between it and the robot."""
        return name in self.carried or self.navigator.line_is_clear(self.robot, name)

    def is_at(self, name: str, source: str) -> bool:
        """Return True if the object lies where the heat or cold source acts."""
        asset = self.asset(source)
        found = heat_source(asset) or cold_source(asset)
        return found is not None and self.thermal.is_at(name, source, found)

    def is_real(self, name: str) -> bool:
        return name not in self.absent

    def is_sliced(self, name: str) -> bool:
        return State.SLICED in self.states.get(name, ())

    def is_inside(self, name: str, container: str) -> bool:
        return self.relations.inside(name, container)

    def facts_about(self, name: str) -> Set[SubstanceFact]:
        return self.substances[name]

    def room_of(self, name: str) -> str:
        """Room of the object; for a carried one, the robot's."""
        return self.robot_room if name in self.carried else self.relations.room_of(name)

    @property
    def robot_room(self) -> str:
        return self.scene.room_at((self.robot.x_m, self.robot.y_m))

    def state_bytes(self) -> bytes:
        """Differences of the engine's and the symbolic state from the scene's start, plus the robot and the hand."""
        robot = self.robot
        if robot is not self._robot_text[0]:
            self._robot_text = robot, f"{robot.x_m.hex()} {robot.y_m.hex()} {robot.yaw.hex()}\n"
        lines = [self._robot_text[1] + " ".join(self.hand.carried)]
        for name, states in self.states.changed():
            lines.append(f"{name}:{','.join(sorted(states))}")
        for name, treated in self.treatments.changed():
            lines.append(f"{name}:{','.join(f'{state} {source}' for state, source in sorted(treated))}")
        for name, facts in self.substances.changed():
            lines.append(f"{name}:{','.join(f'{fact.relation} {fact.substance}' for fact in sorted(facts))}")
        if self.absent:
            lines += sorted(self.absent)
        return self.engine.state_bytes() + "\n".join(lines).encode()


def prepare(bundle: Bundle, world: LiveWorld) -> Bundle:
    """Bundle with the arrays that the simulator derives from its scene. ``world`` holds that scene and is reset."""
    world.engine.reset()
    start = world.navigator.ground.at_start
    arrays = prepared_arrays(world.engine, start.obstacles, start.grid)
    return replace(bundle, prepared=arrays) if arrays else bundle
