"""Multi-level scene generation: a task's objects are laid out in a scene by four agents, one level after the other.

Scene: each thing gets a room. Room: a layout tree tells what it stands on, in or under. Plane: what shares a surface is
arranged together. Object: a continuous pose, free, in reach, at rest. What fails goes back to the room level with its reason.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.editor import PlacementError
from embomatrix.factory.layout.distribution import DistributionError
from embomatrix.factory.layout.facts import hosts_in, rooms_of
from embomatrix.factory.layout.hanging import Hanger
from embomatrix.factory.layout.jobs import Layout, LayoutAgents, Record, kind_of, thing_of
from embomatrix.factory.layout.planes import brief_for, company_on, planes_of, pose_at
from embomatrix.factory.layout.rest import settle
from embomatrix.factory.layout.sampling import ObjectSampler
from embomatrix.factory.layout.tree import LayoutTree
from embomatrix.factory.layout.values import (
    Arrangement,
    Branch,
    DistributionBrief,
    Failure,
    Kind,
    LayoutReason,
    LayoutRelation,
    PlaneCompany,
    RoomBrief,
)
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from embomatrix.factory.editor import SceneEditor
    from embomatrix.factory.layout.jobs import Item
    from embomatrix.factory.layout.planes import Plane
    from embomatrix.factory.layout.values import Spot, Thing, Wish
    from embomatrix.world.asset import Asset
    from embomatrix.world.geometry import Pose
    from embomatrix.world.scene import Room

ROUNDS: Final = 24
"""Trees that are asked for one room at most."""
RESIGNED: Final = 2
"""After so many places where no clear way leads to a thing, one is taken as it is: verification tells."""
CLEARED: Final = 3
"""Things of the base scene that are taken away from a full host, for what the task puts there."""
SURFACES: Final = 4
"""Surfaces of one piece of furniture that are arranged; beyond them the sampler looks alone."""
SHIFT_M: Final = 0.008
TURN_RAD: Final = 0.15
"""How far a thing that nothing aligns is moved off the grid, and turned: people don't put things down on a raster."""
SQUARE: Final = frozenset(
    {Arrangement.CENTER_ALIGNED, Arrangement.FACE_TO, Arrangement.NEXT_TO, Arrangement.EDGE}
)


def lay(editor: SceneEditor, items: Sequence[Item], seed: int, agents: LayoutAgents | None = None) -> Layout:
    """Put the items into the scene. What finds no place is left out, with a failure each. Equal arguments, equal layouts.

    Raises LlmError where an agent is a language model that nobody answers for.
    """
    agents = agents or LayoutAgents()
    record = Record()
    names: dict[str, str] = {}
    trees: dict[str, LayoutTree] = {}
    try:
        rooms = _distributed(editor, items, seed, agents, record)
    except DistributionError as error:
        failures = [item.failure(item.host, LayoutReason.NO_HOST, str(error)) for item in items]
        return Layout({}, {}, tuple(failures), record)
    left: list[Failure] = []
    for number, room in enumerate(dict.fromkeys(rooms.values())):
        mine = [item for item in items if rooms[item.name] == room]
        job = _RoomJob(editor, agents, editor.rooms[room], mine, seed * 1009 + number, record)
        left += job.run()
        names |= job.names
        trees[room] = job.tree()
    return Layout(names, trees, tuple(left), record)


def _distributed(
    editor: SceneEditor, items: Sequence[Item], seed: int, agents: LayoutAgents, record: Record
) -> dict[str, str]:
    """The room of each item, by name. Raises DistributionError."""
    things = tuple(_first_look(item) for item in items)
    named = {name for item in items for name in (item.host, *item.beside) if name in editor.objects}
    homes = {name: editor.objects[name].room for name in sorted(named)}
    brief = DistributionBrief(rooms_of(editor), things, homes, seed)
    answer = agents.distribute(brief)
    record.distribution = (brief, answer)
    return answer.rooms


def _first_look(item: Item) -> Thing:
    return thing_of(item, item.asset(0), {})


def _with_carrier(editor: SceneEditor, thing: Thing) -> Thing:
    """What must stand beside an object that is there goes where that one stands."""
    other = next((editor.objects[name] for name in thing.beside if name in editor.objects), None)
    if other is None or thing.relation is not None:
        return thing
    inside = other.relation is Relation.INSIDE
    return replace(thing, relation=LayoutRelation.INSIDE if inside else LayoutRelation.ONTOP, host=other.host)


@dataclass(slots=True)
class _Waiting:
    """An item without a place: which of its models is tried, and why it has none yet."""

    item: Item
    asset: Asset
    choice: int = 0
    cleared: int = 0
    last: Failure | None = None

    def failure(self, room: str) -> Failure:
        """Why it found no place in a room."""
        if self.last is not None:
            return self.last
        size = " x ".join(f"{extent:.2f}" for extent in self.asset.size_m)
        detail = (
            f"nothing in {room} takes {self.asset.asset_id}, {size} m: try another room or a smaller model"
        )
        return self.item.failure(self.item.host or room, LayoutReason.NO_HOST, detail)


class _RoomJob:
    """The items of one room, tree after tree until each has a place or nothing is left to try."""

    def __init__(
        self,
        editor: SceneEditor,
        agents: LayoutAgents,
        room: Room,
        items: Sequence[Item],
        seed: int,
        record: Record,
    ) -> None:
        self.names: dict[str, str] = {}
        self._editor = editor
        self._agents = agents
        self._room = room
        self._seed = seed
        self._round = 0
        self._record = record
        self._rng = np.random.default_rng((seed, 3))
        self._sampler = ObjectSampler(editor, self._rng)
        self._hanger = Hanger(editor, room, self._rng)
        self._waiting = {item.name: _Waiting(item, item.asset(0)) for item in items}
        self._placed: dict[str, _Waiting] = {}
        self._failures: list[Failure] = []
        self._given_up: list[Failure] = []

    def run(self) -> list[Failure]:
        """Lay the room out; what is left out."""
        for number in range(ROUNDS):
            if not self._waiting:
                break
            self._round = number
            brief = self._brief()
            tree = self._agents.organize(brief)
            self._record.rooms.append((brief, tree))
            hung = {branch.child for branch in tree.branches()}
            for name in [name for name in self._waiting if name not in hung]:
                self._next_model(name)
            before = set(self.names)
            self._realise(tree)
            self._settle([name for name in self.names if name not in before])
        for waiting in self._waiting.values():
            self._given_up.append(waiting.failure(self._room.name))
        return self._given_up

    def tree(self) -> LayoutTree:
        """How the room's objects hang together in the end, in the scene's names: what was laid, and what that stands on."""
        branches = []
        for name, item in self._editor.objects.items():
            if item.room == self._room.name and not item.absent:
                relation = LayoutRelation(item.relation.value) if item.relation else LayoutRelation.ONTOP
                branches.append(Branch(item.host or self._room.name, relation, name))
        known = {branch.child for branch in branches} | {self._room.name}
        whole = LayoutTree.of(self._room.name, [branch for branch in branches if branch.parent in known])
        return whole.pruned(self.names.values())

    def _brief(self) -> RoomBrief:
        things = tuple(_with_carrier(self._editor, self._thing(name)) for name in self._waiting)
        named = {thing.host for thing in things if thing.host in self._editor.objects}
        hosts = hosts_in(self._editor, self._room.name, named)
        room = next(room for room in rooms_of(self._editor) if room.name == self._room.name)
        return RoomBrief(room, hosts, things, tuple(self._failures), self._seed * 31 + self._round)

    def _next_model(self, name: str) -> None:
        """Try the item with its next model, as if nothing had been tried; give it up after the last."""
        waiting = self._waiting[name]
        if waiting.choice + 1 < len(waiting.item.models):
            waiting.choice += 1
            waiting.asset = waiting.item.asset(waiting.choice)
            self._failures = [failure for failure in self._failures if failure.thing != name]
        elif self._waiting.keys() & {waiting.item.host, *waiting.item.beside}:
            return  # what it is to stand at has no place yet
        elif not (self._exchange(waiting.item.host) or self._make_room(waiting)):
            del self._waiting[name]
            self._given_up.append(waiting.failure(self._room.name))

    def _exchange(self, host: str) -> bool:
        """Take out what an item was to stand at, with all on it, to try that with its next model; False where there is none."""
        placed = self._placed.get(host)
        if placed is None or host not in self.names or placed.choice + 1 >= len(placed.item.models):
            return False
        self._take_out(self.names[host])
        self._failures = [failure for failure in self._failures if failure.thing not in self._waiting]
        for each in self._waiting.values():
            if each.item.name != host:
                each.choice, each.asset = 0, each.item.asset(0)
        self._next_model(host)
        return True

    def _make_room(self, waiting: _Waiting) -> bool:
        """Take the largest loose thing that is not the task's from a full host that the task demands; False without one."""
        host = self.names.get(waiting.item.host, waiting.item.host)
        full = waiting.last is not None and waiting.last.reason is LayoutReason.NO_FREE_SPOT
        if not full or waiting.cleared == CLEARED:
            return False
        loose = [
            name
            for name, item in self._editor.objects.items()
            if item.host == host and not item.fixed and self._editor.is_spare(name)
        ]
        if not loose:
            return False
        self._editor.remove(max(loose, key=lambda name: math.prod(self._editor.box_of(name).size_m)))
        waiting.cleared += 1
        waiting.choice, waiting.asset = 0, waiting.item.asset(0)
        self._failures = [failure for failure in self._failures if failure.thing != waiting.item.name]
        return True

    def _take_out(self, scene_name: str) -> None:
        """Remove an object of this job from the scene, with all that rests on it: they wait again."""
        owners = {there: name for name, there in self.names.items()}
        for gone in self._editor.remove(scene_name):
            name = owners[gone]
            del self.names[name]
            self._waiting[name] = self._placed.pop(name)

    def _realise(self, tree: LayoutTree) -> None:
        """Place what the tree says, parents before their children; what stands on one thing together."""
        groups: dict[tuple[str, LayoutRelation], list[str]] = {}
        for branch in tree.branches():
            if branch.child in self._waiting:
                groups.setdefault((branch.parent, branch.relation), []).append(branch.child)
        for (parent, relation), children in groups.items():
            if parent in self._waiting:
                continue  # it found no place itself
            host = self.names.get(parent, parent)
            if relation is LayoutRelation.ONTOP:
                self._onto(host, children)
            elif relation is LayoutRelation.ATTACHED:
                for child in children:
                    self._hang(child)
            else:
                for child in children:
                    self._sample(child, Relation(relation.value), host)

    def _onto(self, host: str, children: list[str]) -> None:
        """Arrange things on the surfaces of one host, the best first; what none takes is left to the sampler."""
        try:
            planes = planes_of(self._editor, host)
        except PlacementError as error:
            for child in children:
                self._failed(child, LayoutRelation.ONTOP, host, error)
            return
        wishes = self._wishes(planes[0], children) if planes else {}
        left = children
        for plane in planes[:SURFACES]:
            fitting = [name for name in left if self._waiting[name].asset.size_m[2] < plane.clearance_m]
            if fitting:
                self._arrange(plane, fitting, wishes)
            left = [name for name in left if name in self._waiting]
        for name in left:
            beside = next((w.other for w in wishes.get(name, ()) if w.required), "")
            if beside:
                self._sample(name, Relation.NEXTTO, self.names.get(beside, beside), host)
            else:
                self._sample(name, None if host in self._editor.rooms else Relation.ONTOP, host)

    def _wishes(self, plane: Plane, children: Sequence[str]) -> dict[str, tuple[Wish, ...]]:
        category = self._editor.asset_of(plane.host).category if plane.host else ""
        company = PlaneCompany(
            plane.host or plane.room,
            category,
            tuple(self._thing(name) for name in children),
            company_on(self._editor, plane),
            plane.on_floor,
            self._seed,
        )
        answer = self._agents.wish(company)
        self._record.company.append((company, answer))
        return answer.of

    def _thing(self, name: str) -> Thing:
        waiting = self._waiting[name]
        return thing_of(waiting.item, waiting.asset, self.names)

    def _arrange(self, plane: Plane, children: Sequence[str], wishes: dict[str, tuple[Wish, ...]]) -> None:
        things = [(self._thing(name), self._waiting[name].asset) for name in children]
        brief = brief_for(self._editor, plane, things, wishes, self._seed * 31 + self._round)
        began = time.process_time()
        found = self._agents.arrange(brief)
        spent = self._record.planar_s
        spent[self._room.name] = spent.get(self._room.name, 0.0) + time.process_time() - began
        self._record.planes.append((brief, found))
        for spot in found[0].spots:
            asset = self._waiting[spot.thing].asset
            others = [other for way in found[1:] for other in way.spots if other.thing == spot.thing]
            with contextlib.suppress(PlacementError):
                pose = self._sampler.first_free(asset, self._near(plane, asset, (spot, *others)), plane.host)
                self._insert(spot.thing, pose, Relation.ONTOP if plane.host else None, plane.host)

    def _near(self, plane: Plane, asset: Asset, spots: Iterable[Spot]) -> Iterator[Pose]:
        """Poses at and around spots: off the grid first where nothing aligns the thing."""
        for spot in spots:
            if not SQUARE & {wish.kind for wish in spot.held}:
                dx, dy, turn = self._rng.uniform(-1.0, 1.0, 3)
                yield pose_at(plane, asset, spot, (SHIFT_M * dx, SHIFT_M * dy), TURN_RAD * turn)
            yield pose_at(plane, asset, spot)

    def _sample(self, name: str, relation: Relation | None, target: str, host: str = "") -> None:
        """Let the sampler look for a pose alone; ``host`` is what the tree said, where the target is a neighbour."""
        try:
            pose = self._sampler.find(self._waiting[name].asset, relation, target)
        except PlacementError as error:
            known = relation in (Relation.INSIDE, Relation.UNDER)
            level = LayoutRelation(relation.value) if relation and known else LayoutRelation.ONTOP
            self._failed(name, level, host or target, error)
        else:
            self._insert(name, pose, *self._sampler.rests(relation, target))

    def _hang(self, name: str) -> None:
        asset = self._waiting[name].asset
        overhead = kind_of(asset) is Kind.OVERHEAD
        try:
            pose = self._hanger.under_ceiling(asset) if overhead else self._hanger.on_wall(asset)
        except PlacementError as error:
            self._failed(name, LayoutRelation.ATTACHED, self._room.name, error)
        else:
            self._insert(name, pose, None, "")
            self._editor.fasten(self.names[name])

    def _insert(self, name: str, pose: Pose, relation: Relation | None, host: str) -> None:
        waiting = self._placed[name] = self._waiting.pop(name)
        self.names[name] = self._editor.insert(waiting.asset, pose, relation, host, self._room.name)

    def _failed(self, name: str, relation: LayoutRelation, host: str, error: PlacementError) -> None:
        failure = Failure(name, relation, host, error.reason, str(error))
        self._waiting[name].last = failure
        self._failures.append(failure)

    def _settle(self, fresh: Sequence[str]) -> None:
        """Let go of what geometry does not prove to be at rest; what does not stay has failed, with all on it."""
        tried = Counter(item.thing for item in self._failures if item.reason is LayoutReason.NOT_AT_HAND)
        resigned = {self.names[name] for name in fresh if tried[name] >= RESIGNED}
        outcome = settle(self._editor, [self.names[name] for name in fresh], resigned)
        self._record.settled += outcome.dropped
        owners = {scene_name: name for name, scene_name in self.names.items()}
        for scene_name, (reason, detail) in outcome.wrong.items():
            if scene_name not in self._editor.objects:
                continue  # it went with what it stood on
            item = self._editor.objects[scene_name]
            relation = LayoutRelation(item.relation.value) if item.relation else LayoutRelation.ONTOP
            self._take_out(scene_name)
            failure = Failure(owners[scene_name], relation, item.host or self._room.name, reason, detail)
            self._waiting[owners[scene_name]].last = failure
            self._failures.append(failure)
