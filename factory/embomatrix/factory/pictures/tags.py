"""Names of the visible objects, written into a rendered picture."""

from collections.abc import Sequence
from typing import Final

from PIL import Image, ImageDraw, ImageFont

from embomatrix.sim.bullet.photograph import SeenObject

Box = tuple[int, int, int, int]
"""Left, top, right and bottom in pixels, y down."""
LEAST_PIXELS: Final = 60
"""Objects with fewer pixels get no name: nobody would find them."""
FONT_PX: Final = 11
_GAPS_PX: Final = (0, 8, 16, 26, 38)
"""Distances of a name from its object, in the order tried."""
_LARGE: Final = 2.5
"""Large objects cover more pixels than their names by this factor."""
_INSET_PX: Final = 2
_INK: Final = "#15202b"
_PAPER: Final = (255, 255, 255, 205)
_LINE: Final = (21, 32, 43, 200)


def tagged(picture: Image.Image, seen: Sequence[SeenObject]) -> Image.Image:
    """Return the picture with the name of each object on it or beside it, larger objects first.

    Names never overlap: an object without a free place nearby gets none.
    """
    sheet = Image.new("RGBA", picture.size, (0, 0, 0, 0))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(FONT_PX)
    boxes: list[tuple[SeenObject, Box]] = []
    for each in seen:
        if each.pixels >= LEAST_PIXELS:
            left, top, right, bottom = map(int, pen.textbbox((0, 0), each.name, font))
            size = (right - left + 2 * _INSET_PX, bottom - top + 2 * _INSET_PX)
            box = _free_box(each, size, picture.size, [box for _, box in boxes])
            if box is not None:
                boxes.append((each, box))
    for each, (left, top, right, bottom) in boxes:
        pen.line(((left + right) // 2, (top + bottom) // 2, each.column, each.row), fill=_LINE)
    for each, box in boxes:
        pen.rectangle(box, fill=_PAPER)
        pen.text((box[0] + _INSET_PX, box[1] + _INSET_PX), each.name, _INK, font, "lt")
    return Image.alpha_composite(picture.convert("RGBA"), sheet).convert("RGB")


def _free_box(
    each: SeenObject, size: tuple[int, int], whole: tuple[int, int], taken: Sequence[Box]
) -> Box | None:
    """Return a box of a size in the picture, near the object and clear of taken boxes; None if there is none.

    The name of a large object is on it, that of a small one beside it.
    """
    width, height = size
    small = each.pixels < _LARGE * width * height
    for gap in _GAPS_PX[1:] if small else _GAPS_PX:
        for dx, dy in ((0, -1), (0, 1), (1, 0), (-1, 0), (1, -1), (-1, -1), (1, 1), (-1, 1)):
            x = each.column - width // 2 + dx * (gap + (width // 2 if gap else 0))
            y = each.row - height // 2 + dy * (gap + (height // 2 if gap else 0))
            box = (x, y, x + width, y + height)
            inside = x >= 0 and y >= 0 and box[2] <= whole[0] and box[3] <= whole[1]
            if inside and not any(_meet(box, other) for other in taken):
                return box
    return None


def _meet(one: Box, other: Box) -> bool:
    return one[0] <= other[2] and one[2] >= other[0] and one[1] <= other[3] and one[3] >= other[1]
