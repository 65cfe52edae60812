"""Shading of a rendered picture: textures, soft light, reflections and the sky, point by point.

A renderer delivers the depth and the part at every pixel, at twice the picture's resolution. Inside a part one point is shaded
for each pixel of the picture; at the edges of parts all four are, so that edges are smooth.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.looks.light import ShadowMap
from embomatrix.sim.looks.patterns import atlas
from embomatrix.sim.looks.surfaces import PartTable, surface_points
from embomatrix.sim.looks.view import FloatArray, IntArray, View

FINER: Final = 2
"""Rendered pixels per pixel of a picture, in both directions."""
NOTHING: Final = -1
"""Number of no part: the sky or the ground outside."""
FIGURE: Final = -2
"""Number of a part whose colour the renderer has shaded: the robot."""

_AMBIENT: Final = 0.36
"""Light without a direction: it has been reflected many times."""
_BOUNCE: Final = 0.20
"""Light from the floor on surfaces that face down."""
_DIRECT: Final = 0.98
_SKY_HIGH: Final = np.array([0.30, 0.52, 0.82], np.float32) ** 2.2
_SKY_LOW: Final = np.array([0.86, 0.92, 0.96], np.float32) ** 2.2
_GROUND: Final = np.array([0.50, 0.58, 0.42], np.float32) ** 2.2
_PAGE: Final = np.array([1.0, 1.0, 1.0], np.float32)


@dataclass(frozen=True)
class Rendering:
    """Buffers of a renderer, at ``FINER`` times the size of the picture.

    ``part`` holds rows of a `PartTable`, ``NOTHING`` or ``FIGURE``; ``color`` the renderer's own sRGB colours.
    """

    view: View
    depth: NDArray[np.float32]
    part: IntArray
    color: NDArray[np.uint8]


@dataclass(frozen=True)
class RoomTints:
    """Colours of walls by the room that they face: boxes (rooms, 4) as low x, low y, high x, high y, and linear colours."""

    boxes: FloatArray
    colors: FloatArray
    walls: IntArray
    """Rows of the parts that are walls."""
    panes: IntArray
    """Rows of the parts that show the sky."""


def shaded(
    rendering: Rendering,
    table: PartTable,
    maps: Sequence[ShadowMap],
    tints: RoomTints,
    *,
    outdoors: bool,
) -> NDArray[np.uint8]:
    """Return sRGB values of the picture, shape (height, width, 3). Without parts there is sky and ground, or a white page."""
    height, width = (side // FINER for side in rendering.part.shape)
    picture = np.zeros((height * width, 3), np.float32)
    rows, columns, target, weight = _samples(rendering.part)
    colors = _colors(rendering, table, maps, tints, rows, columns, outdoors=outdoors)
    np.minimum(colors, 1.0, out=colors)
    # A pixel has either one sample of full weight, or four whose mean it shows.
    single = weight == 1.0
    picture[target[single]] = colors[single]
    rest = ~single
    for channel in range(3):
        picture[:, channel] += np.bincount(
            target[rest], colors[rest, channel] * weight[rest], minlength=height * width
        ).astype(np.float32)
    srgb = np.power(picture, np.float32(1 / 2.2))
    return (srgb * 255 + 0.5).astype(np.uint8).reshape(height, width, 3)


def _samples(part: IntArray) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """Return rows and columns of the rendered pixels to shade, their pixels in the picture, and their weights there."""
    height, width = (side // FINER for side in part.shape)
    blocks = part.reshape(height, FINER, width, FINER)
    first = blocks[:, :1, :, :1]
    edge = (blocks != first).any(axis=(1, 3)).reshape(-1)  # (pixels,)
    pixel = np.arange(height * width, dtype=np.int32)
    whole, mixed = pixel[~edge], np.repeat(pixel[edge], FINER * FINER)
    corner = np.tile(np.arange(FINER * FINER), int(edge.sum()))
    target = np.concatenate([whole, mixed])
    rows = np.concatenate([whole // width * FINER, mixed // width * FINER + corner // FINER])
    columns = np.concatenate([whole % width * FINER, mixed % width * FINER + corner % FINER])
    weight = np.ones(len(target), np.float32)
    weight[len(whole) :] = 1 / FINER**2
    return rows, columns, target, weight


def _colors(
    rendering: Rendering,
    table: PartTable,
    maps: Sequence[ShadowMap],
    tints: RoomTints,
    rows: IntArray,
    columns: IntArray,
    *,
    outdoors: bool,
) -> FloatArray:
    """Return linear colours of the rendered pixels."""
    view, part = rendering.view, rendering.part[rows, columns]
    height, width = rendering.part.shape
    rays = view.rays(rows, columns, width, height)
    colors = np.empty((len(rows), 3), np.float32)
    empty = part == NOTHING
    colors[empty] = _outdoors(view, rays[empty]) if outdoors else _PAGE
    solid = np.flatnonzero(part >= 0)
    distance = view.distances(rendering.depth[rows[solid], columns[solid]])
    points = rays[solid] * distance[:, None] + view.eye_m.astype(np.float32)
    texel_m = distance * np.float32(2 * view.tangent * FINER / height)
    colors[solid] = _surface_colors(table, maps, tints, part[solid], points, rays[solid], texel_m)
    figure = part == FIGURE
    colors[figure] = (rendering.color[rows[figure], columns[figure]] / np.float32(255)) ** np.float32(2.2)
    return colors


def _surface_colors(
    table: PartTable,
    maps: Sequence[ShadowMap],
    tints: RoomTints,
    row: IntArray,
    points: FloatArray,
    rays: FloatArray,
    texel_m: FloatArray,
) -> FloatArray:
    book = atlas()
    surface = surface_points(table, row, points, rays, book.tile_m)
    factor, white = book.look_up(
        table.pattern[row], surface.u, surface.v, texel_m / (surface.tile_m * surface.slant)
    )
    color = table.color[row]
    _tint_walls(color, tints, row, points, surface.normal)
    color = color * factor
    color += white * (np.float32(0.85) - color)
    light = _light(maps, points, surface.normal)
    traits = table.traits[row]
    shaded_color = color * light[:, None] * (1 - 0.6 * traits[:, :1] * traits[:, 1:2])
    shaded_color += color * traits[:, 2:]
    glossy = np.flatnonzero(traits[:, 0] > 0)
    shaded_color[glossy] += _reflections(
        rays[glossy], surface.normal[glossy], color[glossy], traits[glossy], light[glossy]
    )
    panes = np.flatnonzero(np.isin(row, tints.panes))
    shaded_color[panes] = _sky(rays[panes], surface.v[panes])
    return shaded_color


def _light(maps: Sequence[ShadowMap], points: FloatArray, normal: FloatArray) -> FloatArray:
    """Return the light on surfaces, shape (n,): about 1 on an open floor."""
    light = np.full(len(points), _AMBIENT, np.float32)
    light += np.float32(_BOUNCE) * np.maximum(-normal[:, 2], 0)
    # Walls that face the camera differ a little from those across, so that corners show.
    light += np.float32(0.03) * normal[:, 0]
    for shadow in maps:
        cosine = normal @ shadow.lamp.direction.astype(np.float32)
        facing = np.flatnonzero(cosine > 0)
        near = points[facing] + normal[facing] * np.float32(0.01)
        lit = shadow.light_at(near, cosine[facing])
        # Wrapped: light of a wide lamp reaches a surface that it only grazes.
        light[facing] += np.float32(_DIRECT * shadow.lamp.share) * lit * (0.35 + 0.65 * cosine[facing])
    return light


def _tint_walls(
    color: FloatArray, tints: RoomTints, row: IntArray, points: FloatArray, normal: FloatArray
) -> None:
    """Give walls the colour of the room before them, and a skirting board."""
    walls = np.flatnonzero(np.isin(row, tints.walls))
    before = points[walls, :2] + normal[walls, :2] * np.float32(0.12)
    upright = np.abs(normal[walls, 2]) < 0.5
    for (low_x, low_y, high_x, high_y), tint in zip(tints.boxes.tolist(), tints.colors, strict=True):
        inside = (before[:, 0] > low_x) & (before[:, 0] < high_x)
        inside &= (before[:, 1] > low_y) & (before[:, 1] < high_y) & upright
        color[walls[inside]] = tint
    skirting = walls[upright & (points[walls, 2] < 0.08)]
    color[skirting] *= np.float32(0.62)


def _reflections(
    rays: FloatArray, normal: FloatArray, color: FloatArray, traits: FloatArray, light: FloatArray
) -> FloatArray:
    """Return reflected surroundings: bright above, dark below, stronger at grazing angles (Schlick 1994)."""
    ahead = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    toward = np.einsum("ni,ni->n", ahead, normal)
    up = ahead[:, 2] - 2 * toward * normal[:, 2]
    surroundings = np.float32(0.22) + np.float32(0.75) / (1 + np.exp(np.float32(-5.0) * (up - 0.15)))
    gloss, metal = traits[:, :1], traits[:, 1:2]
    grazing = (1 - np.clip(-toward, 0, 1))[:, None] ** 5
    share = gloss + (1 - gloss) * 0.25 * gloss * grazing
    tint = metal * color + (1 - metal)
    return np.asarray(
        share * tint * (surroundings * np.minimum(light, 1.0))[:, None] * (0.45 + 0.55 * metal), np.float32
    )


def _sky(rays: FloatArray, height: FloatArray) -> FloatArray:
    """Return the view through a window: sky over a distant ground. Seen from above, the pane shows the sky by its height."""
    up = rays[:, 2] / np.linalg.norm(rays, axis=1)
    rise = np.where(up > -0.45, up * 2.2 + 0.15, 0.75 - height)
    return _mixed(rise)


def _outdoors(view: View, rays: FloatArray) -> FloatArray:
    up = rays[:, 2] / np.linalg.norm(rays, axis=1)
    return _mixed(up * np.float32(2.2))


def _mixed(rise: FloatArray) -> FloatArray:
    """Return the ground below 0, a pale horizon at 0 and blue from 1 on."""
    share = np.clip(rise, 0, 1)[:, None].astype(np.float32)
    ground = np.clip(-rise * 12 + 0.5, 0, 1)[:, None].astype(np.float32)
    sky = _SKY_LOW + (_SKY_HIGH - _SKY_LOW) * share
    return np.asarray(sky + (_GROUND - sky) * ground, np.float32)
