"""Room-level Organization Agent: layout trees, and the rules that choose a host for each object of a room.

Hosts are filtered by footprint, height and free height, as in the paper. The rules rank the rest by household
conventions, by the objects already there, and by earlier failures.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Protocol, TypeVar

import numpy as np

from embomatrix.factory.furnish.hosts import NO_HOSTS, kept_behind_doors
from embomatrix.factory.furnish.small_objects import is_appliance_top, preferred_hosts, suits
from embomatrix.factory.layout.values import (
    CLOTH_RELATIONS,
    Branch,
    HostFacts,
    HostOffer,
    LayoutFailure,
    LayoutRelation,
    ObjectBrief,
    PlacementClass,
    RoomBrief,
    Size3,
)
from embomatrix.factory.scenes.editor import LayoutReason
from embomatrix.world.scene import SceneObject


class _Named(Protocol):
    @property
    def name(self) -> str: ...


NamedT = TypeVar("NamedT", bound=_Named)


class TreeError(ValueError):
    """Branches that form no tree. The message names the branch and the remedy."""


@dataclass(frozen=True, slots=True)
class LayoutTree:
    """Layout tree of a room: the children of each object by relation. Every object has one parent; the root has none."""

    root: str
    children: Mapping[str, Mapping[LayoutRelation, Sequence[str]]]

    @staticmethod
    def of(root: str, branches: Iterable[Branch]) -> LayoutTree:
        """Build a tree from branches in their order. Raise TreeError for a second parent, a cycle or an unconnected branch."""
        children: defaultdict[str, dict[LayoutRelation, list[str]]] = defaultdict(dict)
        parents: dict[str, str] = {}
        for branch in branches:
            if branch.child == root or branch.child in parents:
                first = parents.get(branch.child, "nothing, as the root")
                raise TreeError(
                    f"{branch.child!r} has the parents {branch.parent!r} and {first}: give every object one parent"
                )
            parents[branch.child] = branch.parent
            children[branch.parent].setdefault(branch.relation, []).append(branch.child)
        tree = LayoutTree(root, children)
        reached = {branch.child for branch in tree.branches()}
        if loose := [name for name in parents if name not in reached]:
            raise TreeError(
                f"{loose[0]!r} has the parent {parents[loose[0]]!r}, which is not connected to the root {root!r}: name an "
                "object of the room as its parent"
            )
        return tree

    def branches(self) -> Iterator[Branch]:
        """Yield all edges, parents before children."""
        waiting = [self.root]
        for parent in waiting:  # grows during the iteration
            for relation, names in self.children.get(parent, {}).items():
                for child in names:
                    yield Branch(parent, relation, child)
                    waiting.append(child)

    def nested(self) -> dict[str, Any]:
        """Return nested mappings of object and relation names, in the form of the paper's trees."""

        def below(name: str) -> dict[str, Any]:
            relations = self.children.get(name, {})
            return {
                relation.value: {child: below(child) for child in names}
                for relation, names in relations.items()
            }

        return {self.root: below(self.root)}

    def pruned(self, names: Iterable[str]) -> LayoutTree:
        """Return the part of the tree that leads to these objects."""
        above = {branch.child: branch for branch in self.branches()}
        kept: set[str] = set()
        for name in names:
            while name in above and name not in kept:
                kept.add(name)
                name = above[name].parent
        return LayoutTree.of(self.root, [branch for branch in self.branches() if branch.child in kept])

    def drawn(self, labels: Mapping[str, str] | None = None) -> str:
        """Return the tree as indented lines. ``labels`` are appended to object names."""
        lines = [self.root]

        def add(parent: str, indent: str) -> None:
            for relation, names in self.children.get(parent, {}).items():
                for name in names:
                    label = (labels or {}).get(name, "")
                    lines.append(f"{indent}{relation.value}: {name}{f'  ({label})' if label else ''}")
                    add(name, indent + "  ")

        add(self.root, "  ")
        return "\n".join(lines)


def tree_in(objects: Iterable[SceneObject], room: str, names: Iterable[str]) -> LayoutTree:
    """Return the layout tree of the named objects of a scene's room, with the objects that support them."""
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


MAX_ATTEMPTS: Final = 3
SPOT_REASONS: Final = frozenset({LayoutReason.UNSTABLE, LayoutReason.INACCESSIBLE})
"""Reasons that exclude a spot but not its host."""
HIGHEST_M: Final = 1.5
"""Maximum height for objects, from the paper."""
LOWEST_M: Final = 0.15
"""Lower furniture surfaces count as floor."""
PREFERRED_SCORE: Final = 1.2
RANK_PENALTY: Final = 0.12
"""Score of an object's preferred host, and its decrease for each further host in the list."""
UNKNOWN_SCORE: Final = 0.2
"""Score of a host without a known convention."""
AVOIDED_SCORE: Final = -0.6
"""Score of a host that people avoid."""
UNSUITABLE_SCORE: Final = -2.0
FLOOR_SCORE: Final = -2.5
"""Score of the floor for objects that don't belong there."""
_FLOOR_GOODS: Final = (
    "wicker_basket storage_box bucket hamper shopping_basket carton toolbox toy_box suitcase backpack duffel_bag "
    "tote_bag ashcan recycling_bin trash_can plastic_bin broom mop vacuum watering_can basketball soccer_ball cage "
    "cooler crate"
)
FLOOR_OBJECTS: Final = frozenset(_FLOOR_GOODS.split())
"""Categories that people put on the floor."""
CLOSED_SCORE: Final = -0.5
"""Score of a closed cavity, unless the object is usually stored there."""
CROWD_PENALTY: Final = 0.12
SAME_CATEGORY_BONUS: Final = 0.35
"""Bonus for standing with an object of the same category."""
RANDOM_SCORE: Final = 0.45


def organize(brief: RoomBrief) -> LayoutTree:
    """Return a layout tree with every object that has a host left. Hosts are children of the root, the floor."""
    rng = np.random.default_rng((brief.seed, len(brief.failures), 7))
    contents = {host.name: Counter(host.contents) for host in brief.hosts}
    hung: dict[str, Branch] = {
        host.name: Branch(brief.room.name, LayoutRelation.ONTOP, host.name) for host in brief.hosts
    }
    for brief_item in named_first(brief.objects, lambda item: (item.host, *item.beside)):
        options = list(choices(brief, brief_item, hung))
        if not options:
            continue
        scores = [_branch_score(brief, brief_item, branch, contents) for branch in options]
        best = options[int(np.argmax(np.asarray(scores) + RANDOM_SCORE * rng.random(len(options))))]
        hung[brief_item.name] = best
        contents.setdefault(best.parent, Counter())[brief_item.category] += 1
    return LayoutTree.of(brief.room.name, hung.values())


def named_first(items: Sequence[NamedT], needs: Callable[[NamedT], Iterable[str]]) -> list[NamedT]:
    """Return the items after those whose names they need, otherwise in the given order."""
    order: list[NamedT] = []
    waiting = list(items)
    while waiting:
        left = {item.name for item in waiting}
        free = (item for item in waiting if (left - {item.name}).isdisjoint(needs(item)))
        order.append(next(free, waiting[0]))
        waiting.remove(order[-1])
    return order


def choices(brief: RoomBrief, brief_item: ObjectBrief, hung: Mapping[str, Branch]) -> Iterator[Branch]:
    """Yield the branches that an object may take: the task's demand, or every host with room for it.

    Failed branches are left out.

    ``hung`` holds the branches of the tree so far, by child.
    """
    failed = Counter(
        (item.host, item.relation) for item in brief.failures if item.object_name == brief_item.name
    )
    for branch in _open_choices(brief, brief_item, hung):
        here = branch.parent == brief.room.name or branch.parent in hung
        if here and failed[branch.parent, branch.relation] < _max_attempts(branch, brief):
            yield branch


def _max_attempts(branch: Branch, brief: RoomBrief) -> int:
    """Return the number of attempts at a host.

    An object that failed after its placement may be stable elsewhere on the host.
    """
    reasons = {
        item.reason
        for item in brief.failures
        if (item.object_name, item.host, item.relation) == (branch.child, branch.parent, branch.relation)
    }
    return MAX_ATTEMPTS if reasons and reasons <= SPOT_REASONS else 1


def _open_choices(brief: RoomBrief, brief_item: ObjectBrief, hung: Mapping[str, Branch]) -> Iterator[Branch]:
    floor = Branch(brief.room.name, LayoutRelation.ONTOP, brief_item.name)
    if brief_item.relation is not None:
        if brief_item.relation not in CLOTH_RELATIONS:
            yield Branch(brief_item.host or brief.room.name, brief_item.relation, brief_item.name)
        return
    beside = next((hung[other] for other in brief_item.beside if other in hung), None)
    if beside is not None:
        yield replace(beside, child=brief_item.name)
        return
    if brief_item.kind in (PlacementClass.HUNG, PlacementClass.OVERHEAD):
        yield replace(floor, relation=LayoutRelation.ATTACHED)
        return
    if brief_item.kind is PlacementClass.GOODS:
        for host in brief.hosts:
            for offer in host.offers:
                if offer.relation is not LayoutRelation.UNDER and fits_offer(offer, brief_item.size_m):
                    yield Branch(host.name, offer.relation, brief_item.name)
    yield floor


def fits_offer(offer: HostOffer, size_m: Size3) -> bool:
    """True if a space of the offer is larger than the object, in either orientation, and at a permitted height."""
    if not LOWEST_M <= offer.height_m <= HIGHEST_M:
        return False
    short, long = sorted(size_m[:2])
    return any(
        short <= min(space[:2]) and long <= max(space[:2]) and size_m[2] <= space[2]
        for space in offer.spaces_m
    )


def _branch_score(
    brief: RoomBrief, brief_item: ObjectBrief, branch: Branch, contents: Mapping[str, Counter[str]]
) -> float:
    host = next((item for item in brief.hosts if item.name == branch.parent), None)
    if host is None:
        return (
            PREFERRED_SCORE
            if brief_item.kind is not PlacementClass.GOODS or brief_item.category in FLOOR_OBJECTS
            else FLOOR_SCORE
        )
    there = contents[host.name]
    crowd = CROWD_PENALTY * sum(there.values()) - SAME_CATEGORY_BONUS * (there[brief_item.category] > 0)
    tired = sum(item.host == host.name for item in brief.failures)
    return host_score(brief_item.category, host, branch.relation) - crowd - 0.5 * tired


def host_score(category: str, host: HostFacts, relation: LayoutRelation) -> float:
    """Return how well a host suits a category."""
    if category in FLOOR_OBJECTS or not suits(category, host.category):
        return UNSUITABLE_SCORE
    wanted = preferred_hosts(category)
    if relation is LayoutRelation.ONTOP and is_appliance_top(host.category):
        score = AVOIDED_SCORE
    elif host.category in wanted:
        score = PREFERRED_SCORE - RANK_PENALTY * wanted.index(host.category)
    else:
        score = AVOIDED_SCORE if host.category in NO_HOSTS else UNKNOWN_SCORE
    if relation is LayoutRelation.INSIDE and not kept_behind_doors(category, host.category):
        score += (
            UNSUITABLE_SCORE
            if is_appliance_top(host.category) and host.category not in wanted
            else CLOSED_SCORE
        )
    return score


def describe_failures(failures: Sequence[LayoutFailure]) -> str:
    """Return the failures as text, one per line."""
    return "\n".join(
        f"- {item.object_name} {item.relation.value} {item.host}: {item.reason.value}, {item.detail}"
        for item in failures
    )
