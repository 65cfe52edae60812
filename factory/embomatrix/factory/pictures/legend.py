"""Legend beside a plan: meaning of colours, numbers of objects, and contents of furniture."""

import math
import textwrap
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import Final

from PIL import Image, ImageDraw, ImageFont

_SIZE: Final = 12
_LINE_PX: Final = 16
_COLUMN_PX: Final = 360
_COLUMN_CHARACTERS: Final = 52
_MARGIN_PX: Final = 16


def draw_legend(colors: Sequence[tuple[str, str]], lines: Iterable[str], height_px: int) -> Image.Image:
    """Draw colours with their meaning, then wrapped ``lines``, in as many columns as the height requires."""
    rows = [
        row
        for line in lines
        for row in textwrap.wrap(line, _COLUMN_CHARACTERS, subsequent_indent="      ") or [""]
    ]
    in_column = max(1, (height_px - 2 * _MARGIN_PX) // _LINE_PX)
    columns = math.ceil((len(colors) + len(rows)) / in_column)
    legend = Image.new("RGB", (columns * _COLUMN_PX, height_px), "white")
    draw = ImageDraw.Draw(legend)
    font = ImageFont.load_default(_SIZE)
    for number, (color, words) in enumerate([*colors, *(("", row) for row in rows)]):
        x = _MARGIN_PX // 2 + _COLUMN_PX * (number // in_column)
        y = _MARGIN_PX + _LINE_PX * (number % in_column)
        if color:
            draw.rectangle((x, y + 2, x + 16, y + 13), fill=color, outline="#555555")
        draw.text((x + 24 if color else x, y), words, "black", font)
    return legend


def counted(names: Iterable[str]) -> str:
    """Abbreviate names of objects: ``book_1, book_2, book_3, cup_1`` becomes ``book_1-3, cup_1``."""
    numbers: Mapping[str, list[int]] = defaultdict(list)
    for name in names:
        kind, number = in_order(name)
        numbers[kind].append(number)
    return ", ".join(_runs(kind, sorted(found)) for kind, found in numbers.items())


def in_order(name: str) -> tuple[str, int]:
    """Return a name's kind and number as a sort key; -1 for a name without a number."""
    kind, _, number = name.rpartition("_")
    return (kind, int(number)) if number.isdecimal() else (name, -1)


def _runs(kind: str, numbers: Sequence[int]) -> str:
    """Return ``book_1-3, 7`` for 1, 2, 3 and 7; only the kind if it has no numbers."""
    if numbers[0] < 0:
        return kind
    runs = [
        [number for _, number in run]
        for _, run in groupby(enumerate(numbers), key=lambda pair: pair[1] - pair[0])
    ]
    return f"{kind}_" + ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)
