"""Looking ahead in any data loader: the batches to come are known without being consumed, and can be announced.

A trainer of your own wraps its ``DataLoader``, or its sampler, and tells the cluster what the window holds:

    ahead = Lookahead(loader, steps=3)
    for batch in ahead:
        announce(ahead.window())     # this batch and the three after it
        ...

Nothing is drawn twice and nothing is skipped: batches come in the loader's order, each ``steps`` earlier than it is needed.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

T = TypeVar("T")


class Lookahead(Generic[T]):
    """Iterates like ``batches``, and knows ``steps`` of them ahead. Each iteration over it begins a new epoch.

    ``batches`` is whatever can be iterated again and again: a ``torch.utils.data.DataLoader``, a (batch) sampler, a list.
    Wrapped around a sampler it costs indices only; around a loader it holds ``steps`` batches in memory. With worker
    processes of a loader, its own prefetching goes on below.
    """

    def __init__(self, batches: Iterable[T], *, steps: int) -> None:
        if steps < 0:
            raise ValueError(f"a look-ahead of {steps} steps: expected 0 or more")
        self._batches = batches
        self._steps = steps
        self._window: deque[T] = deque()
        self._consumed = 0

    def __iter__(self) -> Iterator[T]:
        source = iter(self._batches)
        self._window.clear()
        self._consumed = 0
        self._fill(source)
        while self._window:
            # The batch stays in the window while it is worked on.
            yield self._window[0]
            self._window.popleft()
            self._consumed += 1
            self._fill(source)

    def __len__(self) -> int:
        """Batches of an epoch. Raises TypeError where ``batches`` has no length."""
        return len(self._batches)  # type: ignore[arg-type]  # a sampler without length raises as len() does

    @property
    def step(self) -> int:
        """Number of the batch that is worked on, from 0, within the epoch."""
        return self._consumed

    def window(self) -> tuple[T, ...]:
        """The batch that is worked on and those after it, ``steps`` at most; fewer at the end of the epoch."""
        return tuple(self._window)

    def _fill(self, source: Iterator[T]) -> None:
        while len(self._window) <= self._steps:
            try:
                self._window.append(next(source))
            except StopIteration:
                return
