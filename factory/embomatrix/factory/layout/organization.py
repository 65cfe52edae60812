"""Room-level Organization Agent, by rules: what each thing of a room stands on, in or under, as a layout tree.

Hosts are filtered by footprint, height and free height, as in the paper; what is left is ranked by where people keep such
objects, by how much stands there already, and by what has failed before.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from embomatrix.factory.furnish.hosts import NO_HOSTS, kept_behind_doors
from embomatrix.factory.furnish.small_objects import is_appliance_top, preferred_hosts, suits
from embomatrix.factory.layout.values import (
    RELATION_METHODS,
    Branch,
    LayoutRelation,
    PlacementClass,
    RelationMethod,
)
from embomatrix.factory.scenes.editor import LayoutReason

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from embomatrix.factory.layout.values import (
        HostFacts,
        HostOffer,
        LayoutFailure,
        ObjectBrief,
        RoomBrief,
        Size3,
    )
    from embomatrix.world.scene import SceneObject


MAX_ATTEMPTS: Final = 3
SPOT_REASONS: Final = frozenset({LayoutReason.UNSTABLE, LayoutReason.NOT_AT_HAND})
"""Reasons that speak against a spot and not against its host."""
HIGHEST_M: Final = 1.5
"""Nothing is put higher than this: the paper's bound."""
LOWEST_M: Final = 0.15
"""Furniture surfaces lower than this are floor."""
LIKED: Final = 1.2
LIKED_STEP: Final = 0.12
"""What a thing's favourite furniture is worth, and how much less each next one."""
STRANGE: Final = 0.2
"""Of furniture that nothing is known about."""
UNLIKED: Final = -0.6
"""Of furniture that people put nothing down on unless they must."""
UNSUITED: Final = -2.0
FLOOR: Final = -2.5
"""Of the floor, for what does not belong there."""
_FLOOR_GOODS: Final = (
    "wicker_basket storage_box bucket hamper shopping_basket carton toolbox toy_box suitcase backpack duffel_bag "
    "tote_bag ashcan recycling_bin trash_can plastic_bin broom mop vacuum watering_can basketball soccer_ball cage "
    "cooler crate"
)
FLOOR_OBJECTS: Final = frozenset(_FLOOR_GOODS.split())
"""What people put on the floor."""
SHUT: Final = -0.5
"""Things lie in the open rather than behind doors, unless that is where they are kept."""
CROWD: Final = 0.12
COMPANY: Final = 0.35
"""Equal objects stand together."""
CHANCE: Final = 0.45


def organize(brief: RoomBrief) -> LayoutTree:
    """A layout tree that holds every thing of the brief for which any host is left; hosts hang on the floor, the root."""
    rng = np.random.default_rng((brief.seed, len(brief.failures), 7))
    contents = {host.name: Counter(host.contents) for host in brief.hosts}
    hung: dict[str, Branch] = {
        host.name: Branch(brief.room.name, LayoutRelation.ONTOP, host.name) for host in brief.hosts
    }
    for thing in hosts_first(brief.objects):
        options = list(choices(brief, thing, hung))
        if not options:
            continue
        worths = [_worth(brief, thing, branch, contents) for branch in options]
        best = options[int(np.argmax(np.asarray(worths) + CHANCE * rng.random(len(options))))]
        hung[thing.name] = best
        contents.setdefault(best.parent, Counter())[thing.category] += 1
    return LayoutTree.of(brief.room.name, hung.values())


def hosts_first(objects: Sequence[ObjectBrief]) -> list[ObjectBrief]:
    """Things such that each comes after what the task puts it at, as far as that is one of them; the given order else."""
    order: list[ObjectBrief] = []
    waiting = list(objects)
    while waiting:
        names = {thing.name for thing in waiting}
        ready = next((thing for thing in waiting if not names & {thing.host, *thing.beside}), waiting[0])
        waiting.remove(ready)
        order.append(ready)
    return order


def choices(brief: RoomBrief, thing: ObjectBrief, hung: Mapping[str, Branch]) -> Iterator[Branch]:
    """Branches that a thing may hang on: what the task demands, else every host that has room for it; none that failed.

    ``hung`` are the branches of the tree so far, by child.
    """
    failed = Counter((item.host, item.relation) for item in brief.failures if item.object_name == thing.name)
    for branch in _open_choices(brief, thing, hung):
        here = branch.parent == brief.room.name or branch.parent in hung
        if here and failed[branch.parent, branch.relation] < _chances(branch, brief):
            yield branch


def _chances(branch: Branch, brief: RoomBrief) -> int:
    """How often a host is tried: what failed after it was placed may stand well elsewhere on the same host."""
    reasons = {
        item.reason
        for item in brief.failures
        if (item.object_name, item.host, item.relation) == (branch.child, branch.parent, branch.relation)
    }
    return MAX_ATTEMPTS if reasons and reasons <= SPOT_REASONS else 1


def _open_choices(brief: RoomBrief, thing: ObjectBrief, hung: Mapping[str, Branch]) -> Iterator[Branch]:
    floor = Branch(brief.room.name, LayoutRelation.ONTOP, thing.name)
    if thing.relation is not None:
        if RELATION_METHODS[thing.relation] is not RelationMethod.NONE:
            yield Branch(thing.host or brief.room.name, thing.relation, thing.name)
        return
    beside = next((hung[other] for other in thing.beside if other in hung), None)
    if beside is not None:
        yield replace(beside, child=thing.name)
        return
    if thing.kind in (PlacementClass.HUNG, PlacementClass.OVERHEAD):
        yield replace(floor, relation=LayoutRelation.ATTACHED)
        return
    if thing.kind is PlacementClass.GOODS:
        for host in brief.hosts:
            for offer in host.offers:
                if offer.relation is not LayoutRelation.UNDER and fits_offer(offer, thing.size_m):
                    yield Branch(host.name, offer.relation, thing.name)
    yield floor


def fits_offer(offer: HostOffer, size_m: Size3) -> bool:
    """Whether any space of an offer is larger than a thing, turned either way, and no higher than objects are put."""
    if not LOWEST_M <= offer.height_m <= HIGHEST_M:
        return False
    short, long = sorted(size_m[:2])
    return any(
        short <= min(space[:2]) and long <= max(space[:2]) and size_m[2] <= space[2]
        for space in offer.spaces_m
    )


def _worth(brief: RoomBrief, thing: ObjectBrief, branch: Branch, contents: Mapping[str, Counter[str]]) -> float:
    host = next((item for item in brief.hosts if item.name == branch.parent), None)
    if host is None:
        return LIKED if thing.kind is not PlacementClass.GOODS or thing.category in FLOOR_OBJECTS else FLOOR
    there = contents[host.name]
    crowd = CROWD * sum(there.values()) - COMPANY * (there[thing.category] > 0)
    tired = sum(item.host == host.name for item in brief.failures)
    return liking(thing.category, host, branch.relation) - crowd - 0.5 * tired


def liking(category: str, host: HostFacts, relation: LayoutRelation) -> float:
    """How much people would have such a thing there."""
    if category in FLOOR_OBJECTS or not suits(category, host.category):
        return UNSUITED
    wanted = preferred_hosts(category)
    if relation is LayoutRelation.ONTOP and is_appliance_top(host.category):
        worth = UNLIKED
    elif host.category in wanted:
        worth = LIKED - LIKED_STEP * wanted.index(host.category)
    else:
        worth = UNLIKED if host.category in NO_HOSTS else STRANGE
    if relation is LayoutRelation.INSIDE and not kept_behind_doors(category, host.category):
        worth += UNSUITED if is_appliance_top(host.category) and host.category not in wanted else SHUT
    return worth


def describe_failures(failures: Sequence[LayoutFailure]) -> str:
    """What has failed, a line each, for people and models."""
    return "\n".join(
        f"- {item.object_name} {item.relation.value} {item.host}: {item.reason.value}, {item.detail}"
        for item in failures
    )


class TreeError(ValueError):
    """Branches that make no tree; the sentence says which and what to do."""


@dataclass(frozen=True, slots=True)
class RelationNode:
    """All that is in one relation to an object."""

    relation: LayoutRelation
    children: tuple[ObjectNode, ...]


@dataclass(frozen=True, slots=True)
class ObjectNode:
    """An object, or the floor of a room at the root, and what stands in relations to it."""

    name: str
    relations: tuple[RelationNode, ...] = ()


@dataclass(frozen=True, slots=True)
class LayoutTree:
    """How the objects of a room hang together. Every object has one parent, the root none."""

    root: ObjectNode

    @staticmethod
    def of(root: str, branches: Iterable[Branch]) -> LayoutTree:
        """The tree of these branches, in their order. Raises TreeError for a second parent, a cycle or a loose end."""
        children: defaultdict[str, dict[LayoutRelation, list[str]]] = defaultdict(dict)
        parents: dict[str, str] = {}
        for branch in branches:
            if branch.child == root or branch.child in parents:
                first = parents.get(branch.child, "nothing, being the root")
                raise TreeError(
                    f"{branch.child!r} hangs on {branch.parent!r} and on {first}: give every object one parent"
                )
            parents[branch.child] = branch.parent
            children[branch.parent].setdefault(branch.relation, []).append(branch.child)
        reached: set[str] = set()

        def node(name: str) -> ObjectNode:
            reached.add(name)
            return ObjectNode(
                name,
                tuple(
                    RelationNode(relation, tuple(node(child) for child in names))
                    for relation, names in children[name].items()
                ),
            )

        made = node(root)
        if loose := [name for name in parents if name not in reached]:
            raise TreeError(
                f"{loose[0]!r} hangs on {parents[loose[0]]!r}, which does not lead to the root {root!r}: name an object of "
                "the room as its parent"
            )
        return LayoutTree(made)

    def branches(self) -> Iterator[Branch]:
        """All edges, parents before their children."""
        waiting = [self.root]
        while waiting:
            parent = waiting.pop(0)
            for node in parent.relations:
                for child in node.children:
                    yield Branch(parent.name, node.relation, child.name)
                    waiting.append(child)

    def parent_of(self, name: str) -> Branch | None:
        """The edge that ends at an object; None for the root and for what is not in the tree."""
        return next((branch for branch in self.branches() if branch.child == name), None)

    def nested(self) -> dict[str, Any]:
        """Object and relation names in turn, leaves empty: the form in which the paper's factory writes its trees."""
        return {self.root.name: _nested(self.root)}

    def pruned(self, names: Iterable[str]) -> LayoutTree:
        """The part of the tree that leads to these objects."""
        above = {branch.child: branch for branch in self.branches()}
        kept: set[str] = set()
        for name in names:
            while name in above and name not in kept:
                kept.add(name)
                name = above[name].parent
        return LayoutTree.of(self.root.name, [branch for branch in self.branches() if branch.child in kept])

    def drawn(self, labels: Mapping[str, str] | None = None) -> str:
        """The tree as indented lines for people; ``labels`` are added to the names that they know."""
        lines = [self.root.name]

        def add(node: ObjectNode, indent: str) -> None:
            for group in node.relations:
                for child in group.children:
                    label = (labels or {}).get(child.name, "")
                    lines.append(
                        f"{indent}{group.relation.value}: {child.name}{f'  ({label})' if label else ''}"
                    )
                    add(child, indent + "  ")

        add(self.root, "  ")
        return "\n".join(lines)


def tree_in(objects: Iterable[SceneObject], room: str, names: Iterable[str]) -> LayoutTree:
    """How some objects of a scene's room hang together with what they are on, in or under."""
    branches = [
        Branch(
            item.host or room,
            LayoutRelation(item.relation.value) if item.relation else LayoutRelation.ONTOP,
            item.name,
        )
        for item in objects
        if item.room == room and not item.absent
    ]
    known = {branch.child for branch in branches} | {room}
    return LayoutTree.of(room, [branch for branch in branches if branch.parent in known]).pruned(names)


def _nested(node: ObjectNode) -> dict[str, Any]:
    return {
        group.relation.value: {child.name: _nested(child) for child in group.children}
        for group in node.relations
    }
