"""Draw films: frames as pictures, in processes of their own, with the plan's steps below, as an animated file."""

from __future__ import annotations

import multiprocessing
import textwrap
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from embomatrix.sim.bullet.camera import furnish_cutaway, shoot_egocentric, shoot_oblique
from embomatrix.sim.bullet.stage import Stage
from embomatrix.sim.film import FRAMES_PER_S
from embomatrix.sim.physical_stage import tucked

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from embomatrix.sim.film import Film, Frame
    from embomatrix.world.scene import Room, Scene

WIDTH_PX: Final = 640
HEIGHT_PX: Final = 480
INSET_PX: Final = (200, 150)
CAPTION_PX: Final = 62
LINE_CHARACTERS: Final = 82
COLORS: Final = 128
"""Of a frame's palette: flat shading needs no more."""
CHUNK: Final = 6
"""Frames that a process draws for one request."""
HOLD_MS: Final = 1500
"""How long the last frame stays."""
SUFFIXES: Final = (".gif", ".webp", ".png")


class FilmError(ValueError):
    """A film can't be drawn. The message tells what was found and what was expected."""


@dataclass(frozen=True, slots=True)
class Caption:
    """What stands below a frame: the call, whether it succeeded (None before it ends), and how far the plan is."""

    text: str
    ok: bool | None
    progress: str


def draw_film(
    film: Film,
    captions: Sequence[Caption],
    *,
    processes: int = 2,
    on_frame: Callable[[int, int], None] = lambda done, count: None,
) -> list[Image.Image]:
    """Pictures of all frames with their captions, ``captions[frame.step]`` below each. RGB, 640 x 524 pixels.

    Drawn by processes that share nothing with this one. ``on_frame`` hears how many of how many are done.
    """
    rooms = _rooms_seen(film)
    chunks = [film.frames[start : start + CHUNK] for start in range(0, len(film.frames), CHUNK)]
    pictures: list[Image.Image] = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, _open_stage, (film.scene, rooms)) as pool:
        for chunk, drawn in zip(chunks, pool.map(_draw, chunks), strict=True):
            for frame, pixels in zip(chunk, drawn, strict=True):
                pictures.append(_captioned(pixels, captions[frame.step]))
            on_frame(len(pictures), len(film.frames))
    return pictures


def write_film(path: Path, pictures: Sequence[Image.Image]) -> None:
    """Write an animation, its kind chosen by the suffix: GIF, WebP or animated PNG. Raises FilmError for another suffix."""
    check_suffix(path)
    frames = [picture.quantize(COLORS) for picture in pictures] if path.suffix == ".gif" else [*pictures]
    durations = [round(1000 / FRAMES_PER_S)] * (len(frames) - 1) + [HOLD_MS]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0)


def check_suffix(path: Path) -> None:
    """Raise FilmError when no film can be written to a file of this name."""
    if path.suffix not in SUFFIXES:
        raise FilmError(
            f"a film can't be written as {path.name!r}: expected a name that ends in {', '.join(SUFFIXES)}"
        )


class _Cutter:
    """One process's stage, brought from frame to frame."""

    def __init__(self, scene: Scene, rooms: tuple[Room, ...]) -> None:
        self._stage = Stage(scene)
        furnish_cutaway(self._stage)
        self._rooms = rooms
        self._robot = self._stage.add_robot()
        self._changed: set[str] = set()

    def shoot(self, frame: Frame) -> Image.Image:
        """The rooms from above and aside, with the robot's own view in the corner."""
        changed = {*frame.poses, *frame.joints, *frame.hidden}
        for name in sorted(changed | self._changed):
            self._show(frame, name)
        self._changed = changed
        self._robot.stand(frame.posture or tucked(frame.robot))
        wide = Image.fromarray(np.asarray(shoot_oblique(self._stage, self._rooms, WIDTH_PX, HEIGHT_PX)))
        self._robot.leave()
        inset = Image.fromarray(np.asarray(shoot_egocentric(self._stage, frame.robot, *INSET_PX)))
        wide.paste(inset, (WIDTH_PX - INSET_PX[0] - 6, 6))
        return wide

    def _show(self, frame: Frame, name: str) -> None:
        item = self._stage.scene.by_name[name]
        if name in frame.hidden or (item.absent and name not in frame.poses):
            self._stage.hide(name)
            return
        pose = frame.poses.get(name, item.pose_world_asset)
        self._stage.put(name, pose, frame.joints.get(name, item.joints))


_cutter: _Cutter | None = None


def _open_stage(scene: Scene, rooms: tuple[Room, ...]) -> None:
    global _cutter  # a pool's initializer has no other way to leave something for its tasks
    _cutter = _Cutter(scene, rooms)


def _draw(frames: Sequence[Frame]) -> list[Image.Image]:
    assert _cutter is not None
    return [_cutter.shoot(frame) for frame in frames]


def _rooms_seen(film: Film) -> tuple[Room, ...]:
    """The rooms that the robot is in at any moment; all of them where it is in none."""
    names = {film.scene.room_at((frame.robot.x_m, frame.robot.y_m)) for frame in film.frames}
    return tuple(room for room in film.scene.rooms if room.name in names) or film.scene.rooms


def _captioned(picture: Image.Image, caption: Caption) -> Image.Image:
    width, height = picture.size
    whole = Image.new("RGB", (width, height + CAPTION_PX), "white")
    whole.paste(picture, (0, 0))
    pen = ImageDraw.Draw(whole)
    color = {None: "#444444", True: "#1a7f37", False: "#b42318"}[caption.ok]
    pen.text((8, height + 3), caption.progress, fill="#888888", font=ImageFont.load_default(12))
    lines = textwrap.wrap(caption.text, LINE_CHARACTERS, max_lines=2, placeholder=" …")
    pen.multiline_text((8, height + 19), "\n".join(lines), fill=color, font=ImageFont.load_default(15))
    return whole
