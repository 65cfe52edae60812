"""Films of a plan: the robot's room, its camera view, and the plan as text, drawn in separate processes."""

import importlib.util
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from embomatrix.sim.bullet.camera import furnish_cutaway, furnish_whole, shoot_egocentric, shoot_oblique
from embomatrix.sim.bullet.robot import tucked
from embomatrix.sim.bullet.visual_scene import VisualScene
from embomatrix.sim.film import FRAMES_PER_S, Film, FilmFrame
from embomatrix.sim.film_stage import FilmStage
from embomatrix.sim.process_pool import process_pool
from embomatrix.world.scene import Room, Scene

ROOM_PX: Final = (640, 480)
EYE_PX: Final = (256, 192)
LINE_PX: Final = 17
LINES: Final = 15
"""Lines of the plan beside the picture."""
LINE_CHARACTERS: Final = 38
COLORS: Final = 128
"""Size of a frame's palette: flat shading needs no more."""
CLOSE_M: Final = 0.2
"""Floor to each side of the robot in close pictures."""
CHUNK: Final = 6
"""Frames that a process draws per request."""
HOLD_MS: Final = 1500
"""Duration of the last frame."""
MP4: Final = ".mp4"
SUFFIXES: Final = (".gif", ".webp", ".png", MP4)
QUALITY: Final = "23"
"""Constant rate factor of H.264, its usual value. Lower values give better pictures and larger files."""


class FilmError(ValueError):
    """Film that can't be drawn. The message says what was found and what was expected."""


@dataclass(frozen=True, slots=True)
class Caption:
    """Line of the plan: the call in words, and its success; None for a call that was not executed."""

    text: str
    ok: bool | None


def draw_film(
    film: Film,
    captions: Sequence[Caption],
    *,
    processes: int = 2,
    close: bool = False,
    on_frame: Callable[[int, int], None] = lambda done, count: None,
) -> list[Image.Image]:
    """Pictures of all frames, RGB, 896 x 480 pixels: the room on the left, the robot's view and ``captions`` on the right.

    There is a caption for each call of the plan. Frames are drawn by processes that share nothing with this one.
    If ``close``, the left picture shows the surroundings of the robot rather than whole rooms. ``on_frame`` is called with the
    number of drawn frames and of all frames.
    """
    rooms = _surroundings(film) if close else _rooms_seen(film)
    chunks = [film.frames[start : start + CHUNK] for start in range(0, len(film.frames), CHUNK)]
    pictures: list[Image.Image] = []
    with process_pool(processes, _open_stage, film.scene, rooms) as pool:
        for chunk, drawn in zip(chunks, pool.map(_draw, chunks), strict=True):
            for frame, (room, eye) in zip(chunk, drawn, strict=True):
                pictures.append(_page(room, eye, captions, frame.step))
            on_frame(len(pictures), len(film.frames))
    return pictures


def write_film(path: Path, pictures: Sequence[Image.Image]) -> None:
    """Write an animation as GIF, WebP, PNG or MP4, by the file's suffix. Raises FilmError for another suffix."""
    check_suffix(path)
    if path.suffix == MP4:
        _write_mp4(path, pictures)
        return
    frames = [picture.quantize(COLORS) for picture in pictures] if path.suffix == ".gif" else [*pictures]
    durations = [round(1000 / FRAMES_PER_S)] * (len(frames) - 1) + [HOLD_MS]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations, loop=0)


def _write_mp4(path: Path, pictures: Sequence[Image.Image]) -> None:
    """Write H.264 that browsers and players show. The last picture stays for ``HOLD_MS``."""
    import av  # PyAV, of the extra `film`

    held = [pictures[-1]] * (HOLD_MS * FRAMES_PER_S // 1000)
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=FRAMES_PER_S, options={"crf": QUALITY})
        stream.width, stream.height = pictures[0].size
        stream.pix_fmt = "yuv420p"
        for picture in (*pictures, *held):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.asarray(picture), format="rgb24")))
        container.mux(stream.encode())


def check_suffix(path: Path) -> None:
    """Raise FilmError if the file's suffix is not that of a film, or needs a package that is missing."""
    if path.suffix == MP4 and importlib.util.find_spec("av") is None:
        raise FilmError(
            f"{path.name!r} needs the package av: install it with `pip install embomatrix[film]`, or name a .gif file"
        )
    if path.suffix not in SUFFIXES:
        raise FilmError(
            f"a film can't be written as {path.name!r}: expected a name that ends in {', '.join(SUFFIXES)}"
        )


class _FrameRenderer:
    """Stages of one process, updated from frame to frame: one with low walls to look into, one with full walls."""

    def __init__(self, scene: Scene, rooms: Mapping[int, tuple[Room, ...]]) -> None:
        self._open, self._whole = FilmStage(VisualScene(scene)), FilmStage(VisualScene(scene))
        furnish_cutaway(self._open.stage)
        furnish_whole(self._whole.stage)
        self._rooms = rooms
        self._robot = self._open.stage.add_robot()

    def shoot(self, frame: FilmFrame) -> tuple[Image.Image, Image.Image]:
        """Return an oblique view of the rooms of the frame's step, and the robot's camera view."""
        self._open.show(frame)
        self._whole.show(frame)
        self._robot.stand(frame.posture or tucked(frame.robot))
        room = shoot_oblique(self._open.stage, self._rooms[frame.step], *ROOM_PX)
        eye = shoot_egocentric(self._whole.stage, frame.robot, *EYE_PX)
        return Image.fromarray(np.asarray(room)), Image.fromarray(np.asarray(eye))


_renderer: _FrameRenderer | None = None


def _open_stage(scene: Scene, rooms: Mapping[int, tuple[Room, ...]]) -> None:
    global _renderer  # a pool's initializer has no other way to pass state to its tasks
    _renderer = _FrameRenderer(scene, rooms)


def _draw(frames: Sequence[FilmFrame]) -> list[tuple[Image.Image, Image.Image]]:
    assert _renderer is not None
    return [_renderer.shoot(frame) for frame in frames]


def _rooms_seen(film: Film) -> dict[int, tuple[Room, ...]]:
    """Return for each step the rooms that the robot visits; all rooms if it is in none."""
    names: dict[int, set[str]] = {}
    for frame in film.frames:
        names.setdefault(frame.step, set()).add(film.scene.room_at((frame.robot.x_m, frame.robot.y_m)))
    rooms = film.scene.rooms
    return {step: tuple(room for room in rooms if room.name in seen) or rooms for step, seen in names.items()}


def _surroundings(film: Film) -> dict[int, tuple[Room, ...]]:
    """Return for each step a part of the floor around the places of the robot, as a room."""
    found: dict[int, tuple[Room, ...]] = {}
    for step in {frame.step for frame in film.frames}:
        robots = [frame.robot for frame in film.frames if frame.step == step]
        xs, ys = [robot.x_m for robot in robots], [robot.y_m for robot in robots]
        low = (min(xs) - CLOSE_M, min(ys) - CLOSE_M)
        high = (max(xs) + CLOSE_M, max(ys) + CLOSE_M)
        found[step] = (replace(film.scene.rooms[0], low_m=low, high_m=high),)
    return found


def _page(room: Image.Image, eye: Image.Image, captions: Sequence[Caption], step: int) -> Image.Image:
    """Compose one frame: the room, the robot's view, and the plan with the current step."""
    whole = Image.new("RGB", (ROOM_PX[0] + EYE_PX[0], ROOM_PX[1]), "white")
    whole.paste(room, (0, 0))
    whole.paste(eye, (ROOM_PX[0], 0))
    pen, font = ImageDraw.Draw(whole), ImageFont.load_default(13)
    first = max(0, min(step - LINES // 2, len(captions) - LINES))
    for line, caption in enumerate(captions[first : first + LINES]):
        number = first + line + 1
        words = textwrap.shorten(f"{number}  {caption.text}", LINE_CHARACTERS, placeholder=" …")
        at = (ROOM_PX[0] + 10, EYE_PX[1] + 10 + line * LINE_PX)
        if number == step:
            pen.rectangle((ROOM_PX[0] + 4, at[1] - 1, whole.width - 4, at[1] + LINE_PX - 2), fill="#eef2f6")
        pen.text(at, words, fill=_color(caption, number, step), font=font)
    return whole


def _color(caption: Caption, number: int, step: int) -> str:
    """Return the colour of a call: grey for later, dark for current, green for finished, red for failed calls."""
    if number > step or caption.ok is None:
        return "#a0a7b0"
    if not caption.ok:
        return "#b42318"
    return "#1f2933" if number == step else "#1a7f37"
