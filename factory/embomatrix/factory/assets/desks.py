"""Desks: with drawers in a pedestal beside the knees or under the top, and with a hutch where they are high."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.factory.assets.body import Body, Walls, centred, clamp, raised, region, shell
from embomatrix.factory.assets.drawers import add_drawers
from embomatrix.factory.assets.furniture import leg_thickness, table, top_thickness
from embomatrix.factory.assets.shapes import box

if TYPE_CHECKING:
    from embomatrix.world.geometry import Vec2, Vec3

PEDESTAL_FROM_M: Final = 1.15
"""A desk as wide as this has its drawers in a pedestal: a chair still fits beside it."""
TALL_M: Final = 1.05
"""A desk higher than this is one with a hutch: nobody works at its top."""
_WORK_M: Final = 0.76
_PANEL_M: Final = 0.018
_BOARD_M: Final = 0.012
_FIT_M: Final = 0.002


def desk(size_m: Vec3) -> Body:
    """A top on four legs; a high one carries a hutch at its back."""
    if size_m[2] <= TALL_M:
        return table(size_m)
    return _with_hutch(table(_below_hutch(size_m)), size_m)


def drawer_desk(size_m: Vec3) -> Body:
    """A desk with drawers in a pedestal at its left, a narrow one with a drawer under its top."""
    if size_m[2] <= TALL_M:
        return _desk_of_drawers(size_m)
    return _with_hutch(_desk_of_drawers(_below_hutch(size_m)), size_m)


def drawer_table(size_m: Vec3) -> Body:
    """A table with a drawer under its top, one too small for that without."""
    body = table(size_m)
    leg, under = leg_thickness(size_m), size_m[2] / 2 - top_thickness(size_m)
    depth = clamp(0.3 * size_m[2], 0.09, 0.13)
    if min(size_m[:2]) >= 0.25:
        half = size_m[1] / 2 - leg
        _hang(body, size_m, (-half, half), (under - depth, under))
    return body


def _desk_of_drawers(size_m: Vec3) -> Body:
    if size_m[1] < PEDESTAL_FROM_M:
        return drawer_table(size_m)
    body = table(size_m)
    left = size_m[1] / 2 - leg_thickness(size_m)
    width = clamp(0.28 * size_m[1], 0.3, 0.45)
    _hang(body, size_m, (left - width, left), (0.12 - size_m[2] / 2, size_m[2] / 2 - top_thickness(size_m)))
    return body


def _hang(body: Body, size_m: Vec3, y: Vec2, z: Vec2) -> None:
    """A carcass of drawers below the top, which closes it above."""
    x = size_m[0] / 2
    carcass = region((-x, x - _PANEL_M), y, z)
    boards, bay = shell(carcass, Walls(_BOARD_M, 0.0, _BOARD_M, _BOARD_M, _BOARD_M, 0.0))
    body.parts += boards
    add_drawers(body, bay, region((x - _PANEL_M + _FIT_M, x), y, (z[0], z[1] - _FIT_M)))


def _below_hutch(size_m: Vec3) -> Vec3:
    return (size_m[0], size_m[1], min(_WORK_M, 0.65 * size_m[2]))


def _with_hutch(lower: Body, size_m: Vec3) -> Body:
    """A shelf between two uprights on the back of a desk, the whole of the size asked for."""
    (x0, y0, z0), (_, y1, z1) = centred(size_m).low_m, centred(size_m).high_m
    work = _below_hutch(size_m)[2]
    body = raised(lower, (work - size_m[2]) / 2)
    deck, depth, board = z0 + work, 0.4 * size_m[0], 0.02
    body.parts += [
        box((x0, y0, deck), (x0 + depth, y0 + board, z1 - board)),
        box((x0, y1 - board, deck), (x0 + depth, y1, z1 - board)),
        box((x0, y0, z1 - board), (x0 + depth, y1, z1)),
    ]
    body.supports = [surface for surface in body.supports if surface.interior]
    body.add_support("worktop", (x0 + depth, y0), (-x0, y1), deck)
    body.add_support("under_hutch", (x0, y0 + board), (x0 + depth, y1 - board), deck, z1 - board - deck)
    body.add_support("top", (x0, y0), (x0 + depth, y1), z1)
    return body
