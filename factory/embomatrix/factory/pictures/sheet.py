"""Many scenes in one picture without labels: a sheet of plans, and oblique views side by side."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from embomatrix.factory.pictures.labels import Box
from embomatrix.factory.pictures.scene import FILL, draw_building, is_overhead, kind_of
from embomatrix.sim.bullet.camera import render_egocentric, render_oblique
from embomatrix.world.scene import Scene

_MARGIN_M: Final = 0.3
_CAPTION_PX: Final = 16

_DIRECTIONS: Final = ("ahead", "to its left", "behind", "to its right")


def draw_sheet(scenes: Sequence[Scene], *, columns: int = 9, cell_px: int = 200) -> Image.Image:
    """Return an RGB image of plans in rows, each fitted into a square cell with its name below."""
    rows = math.ceil(len(scenes) / columns)
    sheet = Image.new("RGB", (columns * cell_px, rows * (cell_px + _CAPTION_PX)), "white")
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(10)
    for number, scene in enumerate(scenes):
        x, y = number % columns * cell_px, number // columns * (cell_px + _CAPTION_PX)
        sheet.paste(draw_thumbnail(scene, cell_px - 6), (x + 3, y + 3))
        draw.text((x + 4, y + cell_px), scene.scene_id, fill="black", font=font)
    return sheet


def draw_views(scenes: Sequence[Scene], *, width_px: int = 560) -> Image.Image:
    """Return oblique views side by side, each ``width_px`` wide with aspect ratio 4:3. Raises EngineError without pybullet."""
    height_px = width_px * 3 // 4
    row = Image.new("RGB", (len(scenes) * width_px, height_px), "white")
    for number, scene in enumerate(scenes):
        # Rendered at twice the size: Bullet's renderer does no antialiasing.
        view = render_oblique(scene, width_px=2 * width_px, height_px=2 * height_px)
        smooth = Image.fromarray(np.asarray(view)).resize((width_px, height_px), Image.Resampling.LANCZOS)
        row.paste(smooth, (number * width_px, 0))
    return row


def draw_eyes(scene: Scene, *, width_px: int = 480) -> Image.Image:
    """Return the robot's view at its start in four directions, each ``width_px`` wide with aspect ratio 4:3.

    Raises EngineError without pybullet.
    """
    height_px = width_px * 3 // 4
    sheet = Image.new("RGB", (2 * width_px, 2 * (height_px + _CAPTION_PX)), "white")
    draw = ImageDraw.Draw(sheet)
    views = render_egocentric(scene, width_px=width_px, height_px=height_px)
    for number, (words, view) in enumerate(zip(_DIRECTIONS, views, strict=True)):
        x, y = number % 2 * width_px, number // 2 * (height_px + _CAPTION_PX)
        sheet.paste(Image.fromarray(view), (x, y))
        draw.text((x + 4, y + height_px), words, fill="black", font=ImageFont.load_default(12))
    return sheet


def draw_thumbnail(scene: Scene, side_px: int) -> Image.Image:
    """Return a plan, north up, centred in a square: rooms, walls, windows, doorways and furniture by kind."""
    low = np.min([room.low_m for room in scene.rooms], axis=0) - _MARGIN_M
    high = np.max([room.high_m for room in scene.rooms], axis=0) + _MARGIN_M
    scale = side_px / float(max(high - low))
    shift = (side_px - (high - low) * scale) / 2
    image = Image.new("RGB", (side_px, side_px), "white")
    draw = ImageDraw.Draw(image)

    def box(x0: float, y0: float, x1: float, y1: float) -> Box:
        left, right = shift[0] + (x0 - low[0]) * scale, shift[0] + (x1 - low[0]) * scale
        top, bottom = shift[1] + (high[1] - y1) * scale, shift[1] + (high[1] - y0) * scale
        return (round(left), round(top), max(round(left), round(right)), max(round(top), round(bottom)))

    draw_building(draw, scene, box)
    boxes = {item.name: scene.box_of(item.name) for item in scene.objects}
    kinds = {item.name: kind_of(scene, item, boxes[item.name]) for item in scene.objects}
    # Plants first: a tree's crown would hide furniture below it.
    for item in sorted(scene.objects, key=lambda o: kinds[o.name] != "plant"):
        around = boxes[item.name]
        if not is_overhead(around) and kinds[item.name] != "hung":
            outline = None if item.host else "#8a8a8a"
            fill = FILL[kinds[item.name]]
            draw.rectangle(box(*around.low_m[:2], *around.high_m[:2]), fill=fill, outline=outline)
    return image
