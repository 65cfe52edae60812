"""Side panels of worktops without cabinets: low walls at both ends that carry the slab."""

from typing import Final

from embomatrix.factory.furnish.pieces import REST_GAP_M, Placed
from embomatrix.factory.furnish.roles import FurnitureRole
from embomatrix.factory.furnish.space import Box

PANEL_M: Final = 0.1
"""Thickness of a side panel."""
_INSET: Final = 0.06
"""Share of the depth by which panels stay behind the slab's front edge."""


def side_panels(item: Placed) -> tuple[Box, ...]:
    """Return the panels under both ends of a worktop that no cabinet carries; none for any other piece."""
    if item.piece.role is not FurnitureRole.COUNTERTOP or item.host >= 0:
        return ()
    x0, y0, bottom, x1, y1, _ = item.box
    top = bottom - REST_GAP_M
    if y1 - y0 >= x1 - x0:
        inset = _INSET * (x1 - x0)
        low, high = x0 + inset, x1 - inset
        return ((low, y0, 0.0, high, y0 + PANEL_M, top), (low, y1 - PANEL_M, 0.0, high, y1, top))
    inset = _INSET * (y1 - y0)
    low, high = y0 + inset, y1 - inset
    return ((x0, low, 0.0, x0 + PANEL_M, high, top), (x1 - PANEL_M, low, 0.0, x1, high, top))
