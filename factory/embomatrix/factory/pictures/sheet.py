"""Many pictures in one: a sheet of plans without labels, oblique views side by side, and the robot's view."""

import math
from collections.abc import Sequence
from typing import Final

from PIL import Image, ImageDraw, ImageFont, ImageOps

from embomatrix.factory.pictures.scene import draw_thumbnail
from embomatrix.factory.pictures.tags import tagged
from embomatrix.sim.bullet.camera import photograph_around, photograph_oblique, render_oblique
from embomatrix.sim.bullet.photograph import Photo
from embomatrix.world.scene import Scene

_CAPTION_PX: Final = 16
_GAP_PX: Final = 3

_DIRECTIONS: Final = ("ahead", "to its left", "behind", "to its right")


def in_rows(
    pictures: Sequence[tuple[Image.Image, str]], columns: int, *, caption_px: int = 0, font_px: int = 10
) -> Image.Image:
    """Return pictures of one size in rows, each with its caption in a strip of ``caption_px`` below it."""
    width, height = pictures[0][0].width, pictures[0][0].height + caption_px
    sheet = Image.new("RGB", (columns * width, math.ceil(len(pictures) / columns) * height), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(font_px)
    for number, (picture, caption) in enumerate(pictures):
        x, y = number % columns * width, number // columns * height
        sheet.paste(picture, (x, y))
        draw.text((x + 4, y + picture.height), caption, fill="black", font=font, spacing=1)
    return sheet


def draw_sheet(scenes: Sequence[Scene], *, columns: int = 9, cell_px: int = 200) -> Image.Image:
    """Return an RGB image of plans in rows, each fitted into a square cell with its name below."""
    side_px = cell_px - 2 * _GAP_PX
    plans = (ImageOps.expand(draw_thumbnail(scene, side_px), _GAP_PX, "white") for scene in scenes)
    named = [(plan, scene.scene_id) for plan, scene in zip(plans, scenes, strict=True)]
    return in_rows(named, columns, caption_px=_CAPTION_PX)


def draw_oblique(scene: Scene, size_px: tuple[int, int]) -> Image.Image:
    """Return an oblique view. Raises EngineError without pybullet."""
    width, height = size_px
    return Image.fromarray(render_oblique(scene, width_px=width, height_px=height))


def draw_tagged_oblique(scene: Scene, size_px: tuple[int, int]) -> Image.Image:
    """Return an oblique view with the names of the visible objects. Raises EngineError without pybullet."""
    width, height = size_px
    return _tagged(photograph_oblique(scene, width_px=width, height_px=height))


def draw_views(scenes: Sequence[Scene], *, width_px: int = 560) -> Image.Image:
    """Return oblique views side by side, each ``width_px`` wide with aspect ratio 4:3. Raises EngineError without pybullet."""
    size_px = (width_px, width_px * 3 // 4)
    return in_rows([(draw_oblique(scene, size_px), "") for scene in scenes], len(scenes))


def draw_eyes(scene: Scene, *, width_px: int = 480) -> Image.Image:
    """Return the robot's view at its start in four directions, each ``width_px`` wide with aspect ratio 4:3.

    Raises EngineError without pybullet.
    """
    photos = photograph_around(scene, width_px=width_px, height_px=width_px * 3 // 4)
    return _around([Image.fromarray(photo.pixels) for photo in photos])


def draw_tagged_eyes(scene: Scene, *, width_px: int = 640) -> Image.Image:
    """Return the robot's view as `draw_eyes` does, with the names of the visible objects."""
    photos = photograph_around(scene, width_px=width_px, height_px=width_px * 3 // 4)
    return _around([_tagged(photo) for photo in photos])


def _around(pictures: Sequence[Image.Image]) -> Image.Image:
    return in_rows([*zip(pictures, _DIRECTIONS, strict=True)], 2, caption_px=_CAPTION_PX, font_px=12)


def _tagged(photo: Photo) -> Image.Image:
    return tagged(Image.fromarray(photo.pixels), photo.seen)
