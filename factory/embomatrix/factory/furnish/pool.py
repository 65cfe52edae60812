"""The pieces of a room that no group has taken yet."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.factory.furnish.roles import importance_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from embomatrix.factory.furnish.pieces import FurniturePiece, Member
    from embomatrix.factory.furnish.roles import FurnitureRole


class Pool:
    """Pieces by category and role; what is taken is gone. ``room_type`` and ``floor_m`` tell what room it is."""

    def __init__(
        self, pieces: Iterable[FurniturePiece], room_type: str = "", floor_m: tuple[float, float] = (5.0, 5.0)
    ) -> None:
        self.rest = list(pieces)
        self.room_type = room_type
        self.floor_m = floor_m

    def of(self, *categories: str) -> list[FurniturePiece]:
        return [p for c in categories for p in self.rest if p.category == c]

    def with_role(self, *roles: FurnitureRole) -> list[FurniturePiece]:
        return [p for p in self.rest if p.role in roles]

    def take(self, pieces: Iterable[FurniturePiece]) -> list[FurniturePiece]:
        """Remove the pieces from the pool and return them."""
        taken = list(pieces)
        numbers = {p.number for p in taken}
        self.rest = [p for p in self.rest if p.number not in numbers]
        return taken


def worth(members: Sequence[Member]) -> float:
    """Importance of a group: its best member's, and a little for each."""
    return max(importance_of(m.piece.category, m.piece.role) for m in members) + 0.1 * len(members)
