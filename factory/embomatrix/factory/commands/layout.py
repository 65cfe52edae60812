"""``embomatrix factory lay``: run all layout agents on one task."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import typer

from embomatrix.factory.admission import TaskRefusal
from embomatrix.factory.commands.language_model import (
    MODEL_ERRORS,
    Forms,
    Key,
    Llm,
    Model,
    Tape,
    layout_agents,
    model_backed_agents,
)
from embomatrix.factory.commands.terminal import fail, say, user_errors
from embomatrix.factory.evaluate.scenes import LayoutMethod, PoseSource
from embomatrix.factory.layout.agent_interfaces import LAYOUT_AGENTS, AgentName
from embomatrix.factory.layout.generator import lay as lay_by_tree
from embomatrix.factory.layout.request import Layout, LayoutRecord, RequestedObject
from embomatrix.factory.pictures.marked_files import write_picture
from embomatrix.factory.pictures.scene import draw_plan
from embomatrix.factory.scenes.base_scenes import base_scenes
from embomatrix.factory.scenes.editor import SceneEditor
from embomatrix.factory.task_import.sources import read_activity, read_file
from embomatrix.factory.task_import.task import ImportOptions, import_problem
from embomatrix.host.own_files import PICTURE_MARK, Force, keep_foreign
from embomatrix.world.whole_file import write_whole

PLAN: Final = "plan.png"
Out = Annotated[
    Path | None, typer.Option(help="Folder for a picture of the plan and for the brief of each agent.")
]


def lay(
    scene: Annotated[str, typer.Option(help="Base scene, or a .json file of `scene build`.")],
    bddl: Annotated[Path | None, typer.Option(help="A BDDL problem file.")] = None,
    activity: Annotated[str, typer.Option(help="An activity of the bddl package.")] = "",
    method: Annotated[LayoutMethod, typer.Option(help="Layout method.")] = LayoutMethod.TREE,
    forms: Forms = None,
    seed: Annotated[int, typer.Option(min=0, help="Random seed. Equal seeds give equal scenes.")] = 0,
    out: Out = None,
    llm: Llm = "",
    model: Model = "",
    key: Key = "",
    cassette: Tape = None,
    force: Force = False,
) -> None:
    """Lay the objects of one task out in a base scene and print the layout trees. Nothing is executed."""
    names = model_backed_agents(forms)
    if (bddl is None) is (not activity):
        fail("expected exactly one of --bddl FILE and --activity NAME")
    poses = PoseSource(cassette, llm, model, key) if method is LayoutMethod.POSES else PoseSource()
    with (
        user_errors(more=MODEL_ERRORS),
        layout_agents(names, llm, model, key, cassette) as agents,
        poses.methods() as methods,
    ):
        base = base_scenes([scene]).only(scene)
        source = read_file(bddl) if bddl is not None else read_activity(activity)
        layouts: list[Layout] = []

        def lay_and_keep(editor: SceneEditor, items: Sequence[RequestedObject], seed: int) -> Layout:
            if method is LayoutMethod.TREE:
                layouts.append(lay_by_tree(editor, items, seed, agents))
            else:
                layouts.append(methods[method](editor, items, seed))
            return layouts[-1]

        imported = import_problem(source, base, seed=seed, options=ImportOptions(lay=lay_and_keep))
        for layout in layouts:
            _show(layout)
        if out is not None:
            keep_foreign("", [out / PLAN], PICTURE_MARK, force=force)
            out.mkdir(parents=True, exist_ok=True)
            for layout in layouts:
                _write_briefs(out, layout.record, force=force)
        if isinstance(imported, TaskRefusal):
            fail(f"{source.name} is refused ({imported.reason}): {imported.sentence}")
        if out is not None:
            write_picture(out / PLAN, draw_plan(imported.scene))
            say(f"pictures and briefs: {out}")


def _show(layout: Layout) -> None:
    labels = {scene_name: name for name, scene_name in layout.names.items()}
    for tree in layout.trees.values():
        say(tree.drawn(labels))
    for failure in layout.failures:
        say(
            f"not placed: {failure.object_name} {failure.relation} {failure.host}: {failure.reason}, {failure.detail}"
        )


def _write_briefs(out: Path, record: LayoutRecord, *, force: bool) -> None:
    """Write every brief as a file that ``factory agent NAME --in`` reads."""
    briefs: list[tuple[AgentName, object]] = [
        *([(AgentName.DISTRIBUTOR, record.distribution[0])] if record.distribution else []),
        *((AgentName.ORGANIZER, brief) for brief, _ in record.rooms),
        *((AgentName.PLANNER, brief) for brief, _ in record.constraints),
        *((AgentName.SOLVER, brief) for brief, _ in record.planes),
    ]
    files = {
        out / f"{number:02d}-{name.value}.json": LAYOUT_AGENTS[name].brief.dump_json(brief, indent=1)
        for number, (name, brief) in enumerate(briefs)
    }
    for path, text in files.items():
        # The first line and the first key are those of every brief of the agent.
        keep_foreign("", [path], text[: text.find(b":")], force=force)
    for path, text in files.items():
        write_whole(path, text)
