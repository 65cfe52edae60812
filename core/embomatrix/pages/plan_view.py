"""Plan view of a scene as SVG: rooms and furniture from above, north up."""

from collections.abc import Collection, Iterable, Sequence
from html import escape
from typing import Final

import numpy as np

from embomatrix.world.scene import Scene

OVERHEAD_M: Final = 1.6
"""Objects that begin above this height hang over the robot and are left out."""


class PlanView:
    """Mapping from the world to an SVG, and the shapes of a plan view.

    Shows the given rooms with a margin, all rooms if none of them exists. ``unit`` is in SVG units per metre; without it,
    the view fits into ``fit`` (width, height). CSS classes of the page colour the shapes.
    """

    def __init__(
        self,
        scene: Scene,
        rooms: Collection[str],
        *,
        margin_m: float = 0.4,
        unit: float = 100.0,
        fit: tuple[float, float] | None = None,
    ) -> None:
        self.rooms = [room for room in scene.rooms if room.name in rooms] or list(scene.rooms)
        self._low = np.min([room.low_m for room in self.rooms], axis=0) - margin_m
        self._high = np.max([room.high_m for room in self.rooms], axis=0) + margin_m
        size_m = self._high - self._low
        self._unit = unit if fit is None else float(min(np.array(fit) / size_m))
        width, height = (float(side) for side in size_m * self._unit)
        # A fitted view is as wide as asked for, with the rooms in the middle.
        self._left = 0.0 if fit is None else (fit[0] - width) / 2
        self.size = (round(width if fit is None else fit[0]), round(height))
        """Width and height in SVG units."""

    def at(self, x_m: float, y_m: float) -> tuple[int, int]:
        """Return a point of the world in SVG units. Whole numbers keep the file small."""
        return (
            round(self._left + (x_m - self._low[0]) * self._unit),
            round((self._high[1] - y_m) * self._unit),
        )

    def is_visible(self, low_m: Sequence[float], high_m: Sequence[float]) -> bool:
        """True if a rectangle overlaps the view."""
        return bool(np.all(low_m[:2] < self._high) and np.all(high_m[:2] > self._low))

    def box(self, low_m: Sequence[float], high_m: Sequence[float], kind: str, name: str = "") -> str:
        """Return a rectangle with the CSS class ``kind``, and ``name`` as its title."""
        (left, bottom), (right, top) = self.at(*low_m[:2]), self.at(*high_m[:2])
        shape = f'<rect class="{kind}" x="{left}" y="{top}" width="{max(2, right - left)}" height="{max(2, bottom - top)}"'
        return (
            f'{shape} data-name="{escape(name)}"><title>{escape(name)}</title></rect>'
            if name
            else f"{shape}/>"
        )

    def text(self, x_m: float, y_m: float, words: str, attributes: str, dx: int = 0, dy: int = 0) -> str:
        """Return a text at a point of the world, moved by (dx, dy) SVG units."""
        x, y = self.at(x_m, y_m)
        return f'<text {attributes} x="{x + dx}" y="{y + dy}">{escape(words)}</text>'

    def line(self, points: Iterable[tuple[float, float]], kind: str) -> str:
        """Return a polyline through points of the world."""
        corners = " ".join("{},{}".format(*self.at(*point)) for point in points)
        return f'<polyline class="{kind}" points="{corners}"/>'

    def svg(self, parts: Iterable[str], label: str, attributes: str = "") -> str:
        """Return the complete SVG element."""
        width, height = self.size
        return (
            f'<svg {attributes} viewBox="0 0 {width} {height}" role="img" aria-label="{escape(label)}">'
            f"{''.join(parts)}</svg>"
        )
