"""Textures of materials, drawn by code into one atlas: a tile for each pattern at halved resolutions, looked up at once."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.looks.materials import Pattern

FloatArray = NDArray[np.float32]
IntArray = NDArray[np.signedinteger[Any]]

SIDE_PX: Final = 256
"""Side of a tile at full resolution."""
LEVELS: Final = 9
"""Resolutions of a tile, from 256 to 1 pixel."""
UNIT: Final = 100.0
"""Stored value of a factor of one."""
TILE_M: Final[dict[Pattern, float]] = {
    Pattern.GRAIN: 0.8,
    Pattern.PLANKS: 1.28,
    Pattern.TILES: 0.6,
    Pattern.CARPET: 0.4,
    Pattern.WEAVE: 0.12,
    Pattern.RUG: 0.8,
    Pattern.BRUSHED: 0.6,
    Pattern.STONE: 0.5,
    Pattern.PLASTER: 1.6,
    Pattern.LEAVES: 0.35,
    Pattern.GRASS: 0.8,
    Pattern.SKIN: 0.12,
    Pattern.CRUMB: 0.10,
}
"""Side of a tile on a surface. Patterns without a size fill each face of a part once."""


@dataclass(frozen=True, slots=True)
class Atlas:
    """Tiles of all patterns: ``texels`` holds factors of red, green and blue, and the share of white over them, in bytes.

    ``starts[pattern, level]`` is the index of a tile's first texel. ``tile_m[pattern]`` is 0 where a tile fills a face.
    """

    texels: NDArray[np.uint8]
    starts: IntArray
    tile_m: FloatArray

    def look_up(
        self, pattern: IntArray, u: FloatArray, v: FloatArray, texel_share: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the factors, shape (n, 3), and the shares of white, shape (n, 1), at positions in units of tiles.

        ``texel_share`` is the size of a picture's pixel on the tile; it chooses the resolution.
        """
        level = np.log2(np.clip(texel_share * SIDE_PX, 1.0, SIDE_PX)).astype(np.intp)  # (n,)
        side = SIDE_PX >> level
        column = (np.mod(u, 1.0) * side).astype(np.intp)
        row = (np.mod(v, 1.0) * side).astype(np.intp)
        np.minimum(column, side - 1, out=column)
        np.minimum(row, side - 1, out=row)
        found = self.texels[self.starts[pattern, level] + row * side + column]  # (n, 4)
        return found[:, :3] * np.float32(1 / UNIT), found[:, 3:] * np.float32(1 / 255.0)


@functools.cache
def atlas() -> Atlas:
    """Return the atlas. The first call draws it, in about 0.3 s."""
    texels: list[NDArray[np.uint8]] = []
    starts = np.zeros((len(Pattern), LEVELS), np.intp)
    filled = 0
    for number, pattern in enumerate(Pattern):
        tile = _TILES[pattern]()
        for level in range(LEVELS):
            starts[number, level] = filled
            scaled = tile * np.array([UNIT, UNIT, UNIT, 255.0])
            texels.append(np.clip(np.rint(scaled), 0, 255).astype(np.uint8).reshape(-1, 4))
            filled += len(texels[-1])
            half = max(1, tile.shape[0] // 2)
            if tile.shape[0] > 1:
                tile = tile.reshape(half, 2, half, 2, 4).mean(axis=(1, 3))
    sizes = np.array([TILE_M.get(pattern, 0.0) for pattern in Pattern], np.float32)
    return Atlas(np.concatenate(texels), starts, sizes)


Tile = NDArray[np.float64]
_ROWS, _COLUMNS = np.mgrid[0:SIDE_PX, 0:SIDE_PX] / SIDE_PX


def _noise(seed: int, across: float, along: float) -> Tile:
    """Smooth periodic noise with mean 0 and deviation 1; the numbers are its waves per tile down and across."""
    white = np.random.default_rng(seed).standard_normal((SIDE_PX, SIDE_PX))
    waves = np.fft.fftfreq(SIDE_PX, 1 / SIDE_PX)
    damping = np.exp(-((waves[:, None] / across) ** 2) - (waves[None, :] / along) ** 2)
    smooth = np.fft.ifft2(np.fft.fft2(white) * damping).real
    return np.asarray((smooth - smooth.mean()) / smooth.std())


def _tile(
    factor: Tile, white: Tile | float = 0.0, tint: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Tile:
    """Return a tile of equal factors; ``tint`` colours deviations from one."""
    channels = [1.0 + (factor - 1.0) * (1.0 + share) for share in tint]
    return np.stack([*channels, np.broadcast_to(white, factor.shape)], axis=-1)


def _plain() -> Tile:
    return _tile(np.ones((SIDE_PX, SIDE_PX)))


def _grain() -> Tile:
    fibres, clouds = _noise(1, 60, 2), _noise(2, 6, 1.5)
    rings = np.sin(2 * math.pi * (5 * _ROWS + 0.35 * clouds))
    return _tile(1.0 + 0.045 * fibres + 0.05 * clouds + 0.05 * rings, tint=(-0.2, 0.0, 0.25))


def _planks() -> Tile:
    count = 8
    row = np.floor(_ROWS * count).astype(int)
    tones = np.random.default_rng(3).uniform(-0.12, 0.10, (count, 2))
    shift = (row * 0.37) % 1.0
    along = (_COLUMNS + shift) % 1.0
    tone = tones[row, (along > 0.5).astype(int)]
    seam = (np.abs((_ROWS * count) % 1.0 - 0.5) > 0.47) | (np.abs((along * 2) % 1.0 - 0.5) > 0.494)
    return _tile(1.0 + tone + 0.03 * _noise(4, 40, 3) - 0.28 * seam, tint=(-0.2, 0.0, 0.25))


def _tiles() -> Tile:
    row, column = (_ROWS * 2) % 1.0, (_COLUMNS * 2) % 1.0
    joint = (np.minimum(row, 1 - row) < 0.02) | (np.minimum(column, 1 - column) < 0.02)
    tones = np.random.default_rng(5).uniform(-0.05, 0.05, (2, 2))
    tone = tones[(_ROWS * 2).astype(int), (_COLUMNS * 2).astype(int)]
    return _tile(1.0 + tone + 0.01 * _noise(6, 6, 6) - 0.25 * joint)


def _carpet() -> Tile:
    return _tile(1.0 + 0.09 * _noise(7, 90, 90) + 0.03 * _noise(8, 6, 6))


def _weave() -> Tile:
    threads = 24
    over = np.sin(2 * math.pi * threads * _ROWS) * np.sin(2 * math.pi * threads * _COLUMNS)
    return _tile(1.0 + 0.10 * over + 0.05 * _noise(9, 20, 20))


def _rug() -> Tile:
    u, v = np.abs(_ROWS - 0.5), np.abs(_COLUMNS - 0.5)
    diamond = np.floor((u + v) * 10).astype(int) % 3
    factor = np.choose(diamond, [0.80, 1.0, 1.12]) + 0.05 * _noise(10, 90, 90)
    return _tile(factor, np.where((diamond == 2) & (u + v < 0.3), 0.35, 0.0))


def _brushed() -> Tile:
    return _tile(1.0 + 0.02 * _noise(11, 60, 2))


def _stone() -> Tile:
    specks = _noise(12, 60, 60)
    return _tile(1.0 + 0.08 * _noise(13, 8, 8) + 0.30 * (specks > 1.4) - 0.22 * (specks < -1.3))


def _plaster() -> Tile:
    return _tile(1.0 + 0.015 * _noise(14, 4, 4))


def _leaves() -> Tile:
    return _tile(1.0 + 0.22 * _noise(16, 26, 26) + 0.10 * _noise(17, 8, 8), tint=(0.5, 0.0, 0.2))


def _grass() -> Tile:
    return _tile(1.0 + 0.14 * _noise(18, 90, 40) + 0.08 * _noise(19, 5, 5), tint=(0.4, 0.0, 0.2))


def _skin() -> Tile:
    return _tile(1.0 + 0.06 * _noise(20, 6, 6) + 0.03 * _noise(21, 40, 40), tint=(-0.3, 0.3, 0.0))


def _crumb() -> Tile:
    return _tile(1.0 + 0.09 * _noise(22, 8, 8) + 0.08 * _noise(23, 60, 60), tint=(-0.2, 0.1, 0.2))


def _label() -> Tile:
    """A pale band with lines of print across the middle of each side."""
    band = (_ROWS > 0.30) & (_ROWS < 0.72)
    print_ = band & (((_ROWS * 22) % 1.0) > 0.55) & (np.abs(_COLUMNS - 0.5) < 0.36) & (_ROWS > 0.45)
    return _tile(np.where(print_, 0.55, 1.0), np.where(band & ~print_, 0.75, 0.0))


def _panel() -> Tile:
    """A door's frame around its panel, with a shaded edge."""
    edge = np.minimum(np.minimum(_ROWS, 1 - _ROWS), np.minimum(_COLUMNS, 1 - _COLUMNS))
    groove = np.exp(-(((edge - 0.13) / 0.012) ** 2))
    rim = np.exp(-((edge / 0.012) ** 2))
    return _tile(1.0 - 0.22 * groove - 0.30 * rim + 0.02 * _noise(24, 4, 60))


def _picture() -> Tile:
    """A landscape behind a mat: sky, hills, a sun."""
    edge = np.minimum(np.minimum(_ROWS, 1 - _ROWS), np.minimum(_COLUMNS, 1 - _COLUMNS))
    hill = 0.55 + 0.10 * np.sin(7 * _COLUMNS + 1) + 0.04 * np.sin(19 * _COLUMNS)
    sky = np.stack([0.75 + 0.3 * _ROWS, 0.95 + 0.1 * _ROWS, 1.25 - 0.2 * _ROWS], axis=-1)
    land = np.stack([0.45 + 0.2 * _ROWS, 0.62 - 0.1 * _ROWS, 0.38 + 0.0 * _ROWS], axis=-1)
    color = np.where((hill < _ROWS)[..., None], land, sky)
    sun = (_ROWS - 0.34) ** 2 + (_COLUMNS - 0.66) ** 2 < 0.006
    color[sun] = (1.35, 1.15, 0.6)
    frame, mat = edge < 0.05, edge < 0.12
    color[mat] = 1.0
    color[frame] = (0.32, 0.22, 0.16)
    return np.concatenate([color, np.where(mat & ~frame, 0.7, 0.0)[..., None]], axis=-1)


def _screen() -> Tile:
    """A dark screen in a black bezel, with a pale reflection across it."""
    edge = np.minimum(np.minimum(_ROWS, 1 - _ROWS), np.minimum(_COLUMNS, 1 - _COLUMNS))
    glare = 0.5 + 0.5 * np.tanh(8 * (0.9 - _ROWS - 0.7 * _COLUMNS))
    inside = edge > 0.045
    return _tile(np.where(inside, 1.0 + 0.8 * glare, 0.45), np.where(inside, 0.07 * glare, 0.0))


_TILES: Final[dict[Pattern, Callable[[], Tile]]] = {
    Pattern.PLAIN: _plain,
    Pattern.GRAIN: _grain,
    Pattern.PLANKS: _planks,
    Pattern.TILES: _tiles,
    Pattern.CARPET: _carpet,
    Pattern.WEAVE: _weave,
    Pattern.RUG: _rug,
    Pattern.BRUSHED: _brushed,
    Pattern.STONE: _stone,
    Pattern.PLASTER: _plaster,
    Pattern.LEAVES: _leaves,
    Pattern.GRASS: _grass,
    Pattern.SKIN: _skin,
    Pattern.CRUMB: _crumb,
    Pattern.LABEL: _label,
    Pattern.PANEL: _panel,
    Pattern.PICTURE: _picture,
    Pattern.SCREEN: _screen,
}
