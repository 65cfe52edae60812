"""``embomatrix factory lay``: all layout agents on one task, and which of them are a language model."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
from rich.console import Console

from embomatrix.factory.admission import TaskRefusal
from embomatrix.factory.commands.asked_model import Key, Tape, model_asked
from embomatrix.factory.layout.agent_interfaces import LAYOUT_AGENTS, MODEL_BACKED, AgentName, BriefError
from embomatrix.factory.layout.baselines import lay_at_random, lay_by_poses
from embomatrix.factory.layout.distribution import DistributionError
from embomatrix.factory.layout.generator import lay as lay_by_tree
from embomatrix.factory.layout.model_agents import ModelLayoutAgents
from embomatrix.factory.layout.request import LayoutAgents
from embomatrix.factory.pictures.scene import draw_plan
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.task_import.sources import ProblemSourceError, read_activity, read_file
from embomatrix.factory.task_import.task import ImportOptions, import_problem
from embomatrix.llm.values import LlmError
from embomatrix.world.bddl import BddlError
from embomatrix.world.catalog import CatalogError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.factory.layout.request import Layout, LayoutRecord, RequestedObject
    from embomatrix.factory.scenes.editor import SceneEditor
    from embomatrix.llm.patience import FailureLimit

METHODS = ("tree", "random", "poses")
Forms = Annotated[
    list[str] | None,
    typer.Option("--agent", help="Layout agent, NAME=llm or NAME=rules; give it again for more."),
]
Llm = Annotated[
    str, typer.Option(help="Base URL of an OpenAI-compatible endpoint for agents that are models.")
]
Model = Annotated[str, typer.Option(help="Name of the model there.")]
MethodName = Annotated[str, typer.Option(help="tree, or one that it is compared with: random, poses.")]
Told = Annotated[
    Path | None, typer.Option(help="Folder for the plan's picture and for what each agent was told.")
]


def lay(
    scene: Annotated[str, typer.Option(help="Base scene.")],
    bddl: Annotated[Path | None, typer.Option(help="A BDDL problem file.")] = None,
    activity: Annotated[str, typer.Option(help="An activity of the bddl package.")] = "",
    method: MethodName = "tree",
    forms: Forms = None,
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds give equal scenes.")] = 0,
    out: Told = None,
    llm: Llm = "",
    model: Model = "",
    key: Key = "",
    cassette: Tape = None,
) -> None:
    """Lay one task out in a base scene and show its trees; nothing is executed."""
    names = modelled_names(forms or [])
    if method not in METHODS:
        _fail(f"there is no method {method!r}: expected one of {', '.join(METHODS)}")
    if (bddl is None) is (not activity):
        _fail("expected exactly one of --bddl FILE and --activity NAME")
    with mended_layout(), contextlib.ExitStack() as stack:
        source = read_file(bddl) if bddl is not None else read_activity(activity)
        agents = LayoutAgents()
        if names:
            agents = stack.enter_context(modelled_agents(llm, model, key, cassette)).agents(names)
        kept: list[Layout] = []

        def laying(editor: SceneEditor, items: Sequence[RequestedObject], seed: int) -> Layout:
            by_name = {"random": lay_at_random, "poses": lay_by_poses}
            other = by_name.get(method)
            kept.append(other(editor, items, seed) if other else lay_by_tree(editor, items, seed, agents))
            return kept[-1]

        imported = import_problem(source, build_base_scene(scene), seed=seed, manner=ImportOptions(laying))
        _hand_out(kept, out)
        if isinstance(imported, TaskRefusal):
            _fail(f"{source.name} is refused ({imported.reason}): {imported.sentence}")
        if out is not None:
            draw_plan(imported.scene).save(out / "plan.png")
            Console().print(f"pictures and briefs: {out}", highlight=False)


def _hand_out(layouts: Sequence[Layout], out: Path | None) -> None:
    """The trees on the screen, and in the folder what each agent was told."""
    for layout in layouts:
        _show(layout)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        for layout in layouts:
            _write_briefs(out, layout.record)


def _show(layout: Layout) -> None:
    labels = {there: name for name, there in layout.names.items()}
    for tree in layout.trees.values():
        typer.echo(tree.drawn(labels))
    for failure in layout.failures:
        typer.echo(
            f"left out: {failure.object_name} {failure.relation} {failure.host}: {failure.reason}, {failure.detail}"
        )


def _write_briefs(out: Path, record: LayoutRecord) -> None:
    """Every brief as the file that ``factory agent NAME --in`` takes."""
    told = [(AgentName.DISTRIBUTOR, record.distribution[0])] if record.distribution else []
    briefs: list[tuple[AgentName, object]] = [
        *told,
        *((AgentName.ORGANIZER, brief) for brief, _ in record.rooms),
        *((AgentName.PLANNER, brief) for brief, _ in record.constraints),
        *((AgentName.SOLVER, brief) for brief, _ in record.planes),
    ]
    for number, (name, brief) in enumerate(briefs):
        path = out / f"{number:02d}-{name.value}.json"
        path.write_bytes(LAYOUT_AGENTS[name].brief.dump_json(brief, indent=1))


def modelled_names(forms: list[str]) -> frozenset[AgentName]:
    """Agents that are to be a language model, of NAME=llm and NAME=rules."""
    found = set()
    for form in forms:
        name, _, kind = form.partition("=")
        if name not in set(AgentName) or kind not in ("llm", "rules"):
            _fail(f"--agent {form!r}: expected NAME=llm or NAME=rules, NAME one of {', '.join(AgentName)}")
        if kind == "llm":
            if AgentName(name) not in MODEL_BACKED:
                _fail(f"{name} has no form with a language model: {', '.join(sorted(MODEL_BACKED))} have one")
            found.add(AgentName(name))
    return frozenset(found)


@contextlib.contextmanager
def modelled_agents(
    url: str, model: str, key: str, cassette: Path | None, patience: FailureLimit | None = None
) -> Iterator[ModelLayoutAgents]:
    """Agents on an endpoint, on a recording, or on both. Raises LlmError."""
    asked, endpoint = model_asked(url, model, key, cassette)
    with ModelLayoutAgents(asked, endpoint, patience=patience) as agents:
        yield agents


@contextlib.contextmanager
def mended_layout() -> Iterator[None]:
    """What a person can mend is one sentence and exit status 2."""
    try:
        yield
    except (BddlError, BriefError, CatalogError, DistributionError, LlmError, ProblemSourceError) as error:
        _fail(str(error))
    except OSError as error:
        _fail(f"{error.filename}: {error.strerror}: name a file or folder that can be used")


def _fail(sentence: str) -> NoReturn:
    Console(stderr=True).print(
        f"embomatrix factory: {sentence}", highlight=False, markup=False, soft_wrap=True
    )
    raise typer.Exit(2) from None
