"""What a writer asks of the robot before it writes a wish: whether that can be done at all in the scene as it begins."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from embomatrix.world.state import Relation, State


class Robot(Protocol):
    """Answers about one thing at a time, from the start of the scene. Names are those of scene objects."""

    def fetches(self, thing: str) -> bool:
        """Whether it gets the thing into its hand."""
        ...

    def puts(self, thing: str, relation: Relation, host: str) -> bool:
        """Whether it brings the thing on or into another."""
        ...

    def swings(self, name: str, *, shut: bool) -> bool:
        """Whether it opens, or shuts, all doors and drawers of an object."""
        ...

    def switches(self, name: str, *, on: bool) -> bool:
        """Whether it switches an object on, or off."""
        ...

    def exposes(self, thing: str, source: str, state: State) -> bool:
        """Whether the thing becomes hot, cooked or frozen at a source, and was not so before."""
        ...


class AnyRobot:
    """One that can do all: nobody was asked."""

    def fetches(self, thing: str) -> bool:
        return True

    def puts(self, thing: str, relation: Relation, host: str) -> bool:
        return True

    def swings(self, name: str, *, shut: bool) -> bool:
        return True

    def switches(self, name: str, *, on: bool) -> bool:
        return True

    def exposes(self, thing: str, source: str, state: State) -> bool:
        return True
