"""Look-ahead for any data loader: the coming batches are known before they are consumed, so they can be announced.

Wrap your ``DataLoader`` or sampler, and announce the window to the cluster:

    ahead = Lookahead(loader, steps=3)
    for batch in ahead:
        announce(ahead.window())     # this batch and the next three
        ...

Batches keep the loader's order, and each is drawn exactly once, ``steps`` earlier than needed.
"""

import itertools
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Generic, TypeVar

T = TypeVar("T")


class Lookahead(Generic[T]):
    """Iterable over ``batches`` that knows ``steps`` of them ahead. Each iteration starts a new epoch.

    ``batches`` is any re-iterable: a ``torch.utils.data.DataLoader``, a (batch) sampler, a list. Around a sampler, the window
    holds indices only; around a loader, it holds ``steps`` batches in memory. A loader's own prefetching still works.
    """

    def __init__(self, batches: Iterable[T], *, steps: int) -> None:
        if steps < 0:
            raise ValueError(f"a look-ahead of {steps} steps: expected 0 or more")
        self._batches = batches
        self._steps = steps
        self._window: deque[T] = deque()

    def __iter__(self) -> Iterator[T]:
        source = iter(self._batches)
        self._window.clear()
        self._fill(source)
        while self._window:
            # The batch stays in the window while it is worked on.
            yield self._window[0]
            self._window.popleft()
            self._fill(source)

    def __len__(self) -> int:
        """Batches of an epoch. Raises TypeError if ``batches`` has no length."""
        return len(self._batches)  # type: ignore[arg-type]  # a sampler without length raises as len() does

    def window(self) -> tuple[T, ...]:
        """The current batch and up to ``steps`` after it; fewer at the end of the epoch."""
        return tuple(self._window)

    def _fill(self, source: Iterator[T]) -> None:
        self._window.extend(itertools.islice(source, self._steps + 1 - len(self._window)))
