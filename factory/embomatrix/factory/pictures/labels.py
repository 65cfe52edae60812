"""Placement of text on a picture: legible and without overlaps."""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont

Box = tuple[int, int, int, int]
"""Left, top, right and bottom in pixels, y down."""
Boxes = np.ndarray[tuple[int, ...], np.dtype[np.int64]]
"""Boxes in rows, (n, 4)."""

SIZES: Final = (13, 12, 11, 10)
"""Font sizes in pixels, in the order tried; smaller ones are illegible."""
_HALO_PX: Final = 1
_INSET_PX: Final = 2
_PLACES: Final = (0.5, 0.25, 0.75, 0.0, 1.0)
"""Positions of text in a box, as shares of the free space; the centre first."""
_NUMBER_SIZE: Final = 11
_GAPS_PX: Final = (4, 10, 18)
"""Distances of a number from its point, in the order tried."""
_LINES: Final = 3
GAP: Final = "  "
"""Separator between a name and its details."""


@dataclass(frozen=True, slots=True)
class _TextLayout:
    """Text broken into lines, with font size, orientation, and extent in pixels."""

    words: str
    size: int
    upright: bool
    width: int
    height: int


class Labels:
    """Text on one picture. New text never covers earlier text."""

    def __init__(self, image: Image.Image) -> None:
        self._image = image
        self._kept = boxes(())

    def inside(self, name: str, box: Box, color: str, clear_of: Boxes) -> bool:
        """Write a name within a box, broken at underscores if necessary, and outside ``clear_of`` if possible.

        Return False if no legible size fits.
        """
        for marks in (np.vstack([self._kept, clear_of]), self._kept):
            for setting in _settings(name, box):
                for at in _places(setting, box):
                    if not _meets(_taken(setting, at), marks):
                        self._write(setting, at, color)
                        return True
        return False

    def beside(self, words: str, at: tuple[int, int], color: str, clear_of: Boxes) -> None:
        """Write a few characters next to a point, on its first free side; above it to the right if none is free."""
        width, height = _measured(words, _NUMBER_SIZE)
        setting = _TextLayout(words, _NUMBER_SIZE, False, width, height)
        corners = [
            (at[0] + dx, at[1] + dy)
            for gap in _GAPS_PX
            for dx in (gap, -width - gap, -width // 2)
            for dy in (-height - gap + 4, gap - 4)
        ]
        free = (
            corner
            for marks in (np.vstack([self._kept, clear_of]), self._kept)
            for corner in corners
            if not _meets(_taken(setting, corner), marks)
        )
        self._write(setting, next(free, corners[0]), color)

    def _write(self, setting: _TextLayout, at: tuple[int, int], color: str) -> None:
        font = ImageFont.load_default(setting.size)
        flat = (setting.height, setting.width) if setting.upright else (setting.width, setting.height)
        for tint, halo in (("white", _HALO_PX), (color, 0)):
            tag = Image.new("L", flat, 0)
            middle = (flat[0] / 2, flat[1] / 2)
            ImageDraw.Draw(tag).multiline_text(
                middle, setting.words, 255, font, "mm", spacing=1, align="center", stroke_width=halo
            )
            tag = tag.rotate(90, expand=True) if setting.upright else tag
            self._image.paste(tint, at, tag)
        self._kept = np.vstack([self._kept, boxes([_taken(setting, at)])])


def boxes(rows: Iterable[Box]) -> Boxes:
    """Return boxes as rows, (n, 4)."""
    return np.array([*rows], dtype=np.int64).reshape(-1, 4)


def _taken(setting: _TextLayout, at: tuple[int, int]) -> Box:
    return (*at, at[0] + setting.width, at[1] + setting.height)


def _settings(name: str, box: Box) -> Iterator[_TextLayout]:
    """Yield layouts of a name that fit the box: large first, then on one line first, then horizontal first."""
    width, height = box[2] - box[0] - 2 * _INSET_PX, box[3] - box[1] - 2 * _INSET_PX
    one, *more = _broken(name)
    for size in SIZES:
        for ways, upright in itertools.product(((one,), more), (False, True)):
            for words in ways:
                long, high = _measured(words, size)
                w, h = (high, long) if upright else (long, high)
                if w <= width and h <= height:
                    yield _TextLayout(words, size, upright, w, h)


def _places(setting: _TextLayout, box: Box) -> Iterator[tuple[int, int]]:
    """Yield upper left corners for which the text lies within the box."""
    left, top = box[0] + _INSET_PX, box[1] + _INSET_PX
    spare_x = box[2] - _INSET_PX - left - setting.width
    spare_y = box[3] - _INSET_PX - top - setting.height
    for y, x in itertools.product(_PLACES, _PLACES):
        yield left + int(spare_x * x), top + int(spare_y * y)


@lru_cache(maxsize=4096)
def _broken(words: str) -> tuple[str, ...]:
    """Return the text on one line, and broken at underscores into two and three even lines; details get a separate line."""
    name, gap, rest = words.partition(GAP)
    if gap:
        return (words, *(f"{lines}\n{rest}" for lines in _broken(name)))
    parts = [f"{part}_" for part in name.split("_")]
    parts[-1] = parts[-1][:-1]
    ways = [name]
    for lines in range(2, min(_LINES, len(parts)) + 1):
        cuts = (
            [0, *middle, len(parts)] for middle in itertools.combinations(range(1, len(parts)), lines - 1)
        )
        broken = (["".join(parts[a:b]) for a, b in itertools.pairwise(cut)] for cut in cuts)
        ways.append("\n".join(min(broken, key=lambda rows: max(map(len, rows)))))
    return tuple(ways)


@lru_cache(maxsize=4096)
def _measured(words: str, size: int) -> tuple[int, int]:
    """Return width and height of lines with their halo in pixels."""
    font = ImageFont.load_default(size)
    pen = ImageDraw.Draw(Image.new("L", (1, 1)))
    left, top, right, bottom = pen.multiline_textbbox((0, 0), words, font, spacing=1, stroke_width=_HALO_PX)
    return int(right - left) + 2, int(bottom - top) + 2


def _meets(box: Box, others: Boxes) -> bool:
    """True if a box overlaps one of the others."""
    left, top, right, bottom = box
    return bool(
        np.any(
            (others[:, 0] < right) & (others[:, 2] > left) & (others[:, 1] < bottom) & (others[:, 3] > top)
        )
    )
