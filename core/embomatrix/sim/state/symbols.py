"""What is so of each object beyond where it is, as sets by name, with the cost of few changes among many objects."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Sequence

T = TypeVar("T")


class Symbols(dict[str, set[T]]):
    """Sets by object name. Only those that were asked for by name can have been changed: it remembers which.

    Read with ``items`` and ``values``, which do not remember; change through ``[]``.
    """

    def __init__(self) -> None:
        super().__init__()
        self._asked: set[str] = set()
        self._kept: dict[str, frozenset[T]] = {}

    def __getitem__(self, name: str) -> set[T]:
        self._asked.add(name)
        return super().__getitem__(name)

    def __setitem__(self, name: str, members: set[T]) -> None:
        self._asked.add(name)
        super().__setitem__(name, members)

    def keep(self) -> None:
        """Take what is so now as that which ``restore`` goes back to."""
        self._kept = {name: frozenset(members) for name, members in self.items()}
        self._asked.clear()

    def changed(self) -> Sequence[tuple[str, set[T]]]:
        """Names and sets that are not as kept, by name."""
        if not self._asked:
            return ()
        asked = [(name, super(Symbols, self).__getitem__(name)) for name in sorted(self._asked)]
        return [(name, members) for name, members in asked if members != self._kept[name]]

    def restore(self) -> None:
        """Make every set equal to the one that was kept."""
        for name, _ in self.changed():
            super().__setitem__(name, set(self._kept[name]))
        self._asked.clear()
