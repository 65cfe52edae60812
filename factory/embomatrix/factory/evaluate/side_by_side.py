"""Picture of one fixed task, laid out by every method of the scene evaluation, side by side."""

import textwrap
from collections.abc import Sequence
from typing import Final

from PIL import Image, ImageDraw, ImageFont, ImageOps

from embomatrix.factory.admission import TaskRefusal
from embomatrix.factory.evaluate.scenes import METHODS, LayoutMethod
from embomatrix.factory.metrics.figures import EvaluationError
from embomatrix.factory.pictures.scene import draw_plan
from embomatrix.factory.pictures.sights import alone
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.task_import.sources import SourceText
from embomatrix.factory.task_import.task import ImportedTask, ImportOptions, import_problem

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
    panels = [
        _panel(method, import_problem(task, base, seed=seed, options=ImportOptions(lay=lay)))
        for method, lay in METHODS.items()
    ]
    whole = Image.new(
        "RGB", (sum(each.width for each in panels), max(each.height for each in panels)), "white"
    )
    x = 0
    for panel in panels:
        whole.paste(panel, (x, 0))
        x += panel.width
    return whole


def _panel(method: LayoutMethod, imported: ImportedTask | TaskRefusal) -> Image.Image:
    """Return a picture below the name of its method."""
    if isinstance(imported, TaskRefusal):
        picture = Image.new("RGB", (LEAST_PX, LEAST_PX), "white")
        words = textwrap.fill(f"{imported.reason}: {imported.sentence}", WIDTH)
        ImageDraw.Draw(picture).text((8, CAPTION_PX), words, fill="#b03030", font=ImageFont.load_default(14))
    else:
        picture = draw_plan(alone(imported.scene, imported.rooms[0]))
    panel = ImageOps.expand(picture, (0, CAPTION_PX, 0, 0), fill="white")
    ImageDraw.Draw(panel).text((8, 4), method, fill="black", font=ImageFont.load_default(16))
    return panel
