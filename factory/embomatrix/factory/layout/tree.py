"""Layout trees: object and relation nodes in turn, rooted in the floor of a room."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from embomatrix.factory.layout.values import Branch, LayoutRelation

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from embomatrix.world.scene import SceneObject


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
