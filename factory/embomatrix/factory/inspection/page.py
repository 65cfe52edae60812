"""HTML page of one task: instruction, transcript, layout, objects, and the oracle's plan step by step.

The page needs no other file. All text of a dataset is untrusted: it is escaped in HTML, and the script's JSON can't
close its element.
"""

import base64
import io
import json
import re
from html import escape
from importlib import resources
from string import Template
from typing import Any, Final

import numpy as np

from embomatrix.factory.inspection.plan_view import inspection_view
from embomatrix.factory.inspection.playing import OraclePlayback, PlayMoment
from embomatrix.factory.pictures.sheet import draw_oblique
from embomatrix.factory.scenes.view import SceneView
from embomatrix.pages.head import page_head
from embomatrix.pages.plan_view import PlanView
from embomatrix.world.dataset import TaskRecord
from embomatrix.world.evaluate import objects_of
from embomatrix.world.scene import Scene

TEMPLATE: Final = "page.html"
PICTURE_PX: Final = (960, 720)
_STRONG: Final = re.compile(r"\*\*(.+?)\*\*")


def task_page(
    record: TaskRecord,
    scene: Scene,
    show: OraclePlayback,
    transcript: str = "",
    tree: object = None,
    picture: str = "",
) -> str:
    """Return the page. ``transcript`` is Markdown, ``tree`` a nested layout tree, ``picture`` the HTML of `scene_picture`."""
    task = record.task
    about = objects_of(task.goal, task.types)
    things = list(show.moments[0].things_m)
    rooms = {scene.by_name[name].room for name in task.table if name in scene.by_name} | {
        scene.room_at(moment.robot_m) for moment in show.moments
    }
    view = PlanView(scene, rooms)
    template = Template(
        (resources.files("embomatrix.factory.inspection") / TEMPLATE).read_text(encoding="utf-8")
    )
    verdict = "reaches the goal" if show.success else "does not reach the goal"
    return template.substitute(
        head=page_head(f"{task.task_id} · EmboMatrix task"),
        instruction=escape(task.instruction),
        facts=_facts(record),
        goal=escape(task.goal_bddl),
        plan=inspection_view(scene, view, about, things),
        moments=_script_json([_moment_json(moment, view) for moment in show.moments]),
        steps=_steps(show),
        verdict=escape(f"The plan {verdict} and earns {show.reward:.2f}."),
        final=_list([escape(words) for words in show.final]),
        transcript=_section("Transcript", transcript_html(transcript)) if transcript else "",
        tree=_section("Layout tree", _tree(tree)) if tree else "",
        objects=_object_rows(record, scene, about),
        picture=_section("Picture", picture) if picture else "",
    )


def transcript_html(text: str) -> str:
    """Convert a transcript's Markdown to HTML: headings, lists, paragraphs and bold words. Other markup stays text."""
    lines: list[str] = []
    for block in re.split(r"\n\s*\n", text.strip()):
        if block.startswith("# "):
            continue  # the instruction is already the page's heading
        if block.startswith("## "):
            lines.append(f"<h3>{_inline(block[3:])}</h3>")
        elif block.startswith("* "):
            lines.append(_list([_inline(item[2:]) for item in block.splitlines()]))
        else:
            lines.append(f"<p>{_inline(block)}</p>")
    return "".join(lines)


def _inline(text: str) -> str:
    return _STRONG.sub(r"<strong>\1</strong>", escape(text))


def _list(items: list[str]) -> str:
    return f"<ul>{''.join(f'<li>{item}</li>' for item in items)}</ul>"


def _section(heading: str, body: str) -> str:
    return f'<section id="{heading.lower().replace(" ", "-")}"><h2>{escape(heading)}</h2>{body}</section>'


def _facts(record: TaskRecord) -> str:
    task = record.task
    found = {
        "scene": task.scene_id,
        "category": task.category.words,
        "split": record.split,
        "source": task.source,
        "profile": task.profile.value,
        "rooms": ", ".join(record.rooms),
        "kind of goal": record.signature,
    }
    return "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in found.items()
    )


def _steps(show: OraclePlayback) -> str:
    rows = [("start", "")] + [(moment.call, moment.said) for moment in show.moments[1:]]
    return "".join(
        f'<li><button type="button" data-step="{number}"><b>{escape(call)}</b><span>{escape(said)}</span></button></li>'
        for number, (call, said) in enumerate(rows)
    )


def _object_rows(record: TaskRecord, scene: Scene, about: frozenset[str]) -> str:
    rows, view = [], SceneView(scene)
    for number, name in enumerate(record.task.table):
        item, asset = scene.by_name[name], scene.asset_of(name)
        size = " × ".join(f"{extent:.2f}" for extent in asset.size_m)
        states = ", ".join(sorted(state.value for state in item.states))
        if any(share > 0 for share in item.joints):
            states = ", ".join(filter(None, (states, "open")))
        cells = (str(number), name, item.room, view.whereabouts(name), size, f"{asset.mass_kg:.1f}", states)
        row = "".join(f"<td>{escape(cell)}</td>" for cell in cells)
        rows.append(f'<tr class="{"goal" if name in about else ""}">{row}</tr>')
    return "".join(rows)


def _tree(node: object) -> str:
    """Convert nested mappings and lists to nested HTML lists."""
    if isinstance(node, dict):
        return _list([f"{escape(str(name))}{_tree(inner)}" for name, inner in node.items()])
    if isinstance(node, list):
        return _list([_tree(inner) for inner in node])
    return escape(str(node)) if node not in ("", None) else ""


def scene_jpeg(scene: Scene, size_px: tuple[int, int] = PICTURE_PX) -> bytes:
    """Return an oblique view as JPEG."""
    data = io.BytesIO()
    draw_oblique(scene, size_px).save(data, "JPEG", quality=82)
    return data.getvalue()


def scene_picture(scene: Scene) -> str:
    """Return the view as an HTML element with embedded data."""
    encoded = base64.b64encode(scene_jpeg(scene)).decode("ascii")
    return f'<img alt="the scene from above, at an angle" src="data:image/jpeg;base64,{encoded}">'


def _moment_json(moment: PlayMoment, view: PlanView) -> dict[str, Any]:
    return {
        "robot": [*view.at(*moment.robot_m), round(-np.degrees(moment.yaw))],
        "held": list(moment.held),
        "things": {name: view.at(*place) for name, place in moment.things_m.items()},
        "active": list(moment.open_or_on),
        "goal": [[words, holds] for words, holds in moment.goal],
    }


def _script_json(value: object) -> str:
    """Return JSON for a script element. No character of it can close the element or open a comment."""
    return json.dumps(value).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
