"""Picture of one fixed task, laid out by every method of the scene evaluation, side by side."""

import textwrap
from collections.abc import Sequence
from typing import Final

from PIL import Image, ImageDraw, ImageFont

from embomatrix.factory.admission import TaskRefusal
from embomatrix.factory.evaluate.scenes import METHODS
from embomatrix.factory.metrics.figures import EvaluationError
from embomatrix.factory.pictures.scene import draw_plan
from embomatrix.factory.pictures.sights import alone
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.task_import.sources import SourceText
from embomatrix.factory.task_import.task import ImportOptions, import_problem

CAPTION_PX: Final = 26
LEAST_PX: Final = 420
"""Width of a panel for a method without a layout."""
WIDTH: Final = 48
"""Characters per line of the reason in such a panel."""


def named(tasks: Sequence[SourceText], name: str) -> SourceText:
    """Return the fixed task of this name. Raises EvaluationError."""
    for task in tasks:
        if task.name == name:
            return task
    raise EvaluationError(
        f"{name!r} is not a fixed task: expected one of {len(tasks)}, such as {tasks[0].name!r}"
    )


def draw_side_by_side(task: SourceText, seed: int) -> Image.Image:
    """Return an RGB image with a panel for each method: the plan of the goal's first room, or the reason against a layout."""
    base = build_base_scene(task.scene)
    panels = []
    for method, lay in METHODS.items():
        imported = import_problem(task, base, seed=seed, options=ImportOptions(lay=lay))
        if isinstance(imported, TaskRefusal):
            panels.append(_reason(method, imported))
        else:
            panels.append(_captioned(method, draw_plan(alone(imported.scene, imported.rooms[0]))))
    whole = Image.new(
        "RGB", (sum(each.width for each in panels), max(each.height for each in panels)), "white"
    )
    x = 0
    for panel in panels:
        whole.paste(panel, (x, 0))
        x += panel.width
    return whole


def _captioned(words: str, picture: Image.Image) -> Image.Image:
    panel = Image.new("RGB", (picture.width, picture.height + CAPTION_PX), "white")
    panel.paste(picture, (0, CAPTION_PX))
    ImageDraw.Draw(panel).text((8, 4), words, fill="black", font=ImageFont.load_default(16))
    return panel


def _reason(method: str, refusal: TaskRefusal) -> Image.Image:
    panel = Image.new("RGB", (LEAST_PX, LEAST_PX), "white")
    words = "\n".join(textwrap.wrap(f"{refusal.reason}: {refusal.sentence}", WIDTH))
    ImageDraw.Draw(panel).text((8, CAPTION_PX), words, fill="#b03030", font=ImageFont.load_default(14))
    return _captioned(method, panel)
