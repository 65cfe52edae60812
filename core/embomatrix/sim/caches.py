"""Caches with a limit on their entries."""

import inspect
import weakref
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class BoundedCache(dict[K, V]):
    """Cache that makes missing values with a function of the key, and is emptied when a new key does not fit.

    Reading it costs no more than reading a dictionary. A method's object is held weakly, because it owns the cache: a closed
    scene is then freed at once, without a garbage collection.
    """

    def __init__(self, most: int, make: Callable[[K], V]) -> None:
        super().__init__()
        self._most = most
        self._make: Callable[[], Any] = weakref.WeakMethod(make) if inspect.ismethod(make) else lambda: make

    def __missing__(self, key: K) -> V:
        if len(self) >= self._most:
            self.clear()
        value: V = self._make()(key)
        self[key] = value
        return value


class RecentCache(Generic[K, V]):
    """Cache of the most recently used values."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._values: OrderedDict[K, V] = OrderedDict()

    def get(self, key: K, make: Callable[[], V]) -> V:
        """Value of a key. ``make`` makes a missing one."""
        if key not in self._values:
            if len(self._values) == self._most:
                self._values.popitem(last=False)
            self._values[key] = make()
        self._values.move_to_end(key)
        return self._values[key]
