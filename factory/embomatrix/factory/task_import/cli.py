"""``embomatrix factory import``: bind others' problems to base scenes, verify them, and report what can't be bound and why."""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from embomatrix.factory.evaluate.figures import evaluation_to_json
from embomatrix.factory.pipeline.settings import scene_ids
from embomatrix.factory.refusal import Refusal
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.task_import.batch import Verified, bind_first, verify_first
from embomatrix.factory.task_import.dialects import read_problem
from embomatrix.factory.task_import.reach import unreachable_atoms
from embomatrix.factory.task_import.report import (
    Outcome,
    evaluation_of,
    outcome_of,
    report_to_json,
    report_to_markdown,
    solved_of,
)
from embomatrix.factory.task_import.sources import (
    SourceError,
    SourceText,
    activity_names,
    read_activity,
    read_eai,
    read_file,
    read_jsonl,
)
from embomatrix.factory.task_import.task import Manner
from embomatrix.factory.terminal import fail, mended, progress
from embomatrix.sim.physical.survey import Foresight
from embomatrix.sim.pose_cache import PlacementLibrary
from embomatrix.world.bddl import BddlError
from embomatrix.world.dataset import TASKS_FILE, write_dataset
from embomatrix.world.task import Profile
from embomatrix.world.whole_file import check_writable, write_whole

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.factory.evaluate.figures import Evaluation
    from embomatrix.factory.task_import.task import Imported
    from embomatrix.world.scene import Scene

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
EVERY_ACTIVITY = "all"


class Depth(StrEnum):
    """How far an import goes."""

    VERIFY = "verify"  # bound, and solved by the oracle in the simulator
    BIND = "bind"  # bound to a scene, the goal within the skills' reach
    INSTANTIATE = "instantiate"  # bound to a scene, whatever the skills can do


Report = Annotated[
    Path | None, typer.Option(help="File for what became of each problem, in JSON; beside it in Markdown.")
]
Rates = Annotated[Path | None, typer.Option("--json", help="File for the import rates.")]
ReachedBy = Annotated[
    Profile | None, typer.Option(help="Leave out problems with goals that no skill of this profile reaches.")
]
Scenes = Annotated[
    list[str] | None,
    typer.Option("--scenes", "--scene", help="Base scene, or 'all'; give it again for more."),
]


@app.command("import")
def import_(
    bddl: Annotated[Path | None, typer.Option(help="A BDDL problem file.")] = None,
    activity: Annotated[str, typer.Option(help="An activity of the bddl package, or 'all'.")] = "",
    jsonl: Annotated[Path | None, typer.Option(help="Records with 'name' and 'bddl'.")] = None,
    eai: Annotated[
        Path | None, typer.Option(help="Folder of the unpacked wheel of eai-eval: its 100 tasks.")
    ] = None,
    scenes: Scenes = None,
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds give equal datasets.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Folder for the admitted tasks.")] = None,
    bind_only: Annotated[bool, typer.Option("--bind-only", help="Leave out the verification.")] = False,
    instantiate: Annotated[
        bool, typer.Option("--instantiate", help="Bind goals as well that no skill reaches; no verification.")
    ] = False,
    reached_by: ReachedBy = None,
    look_ahead: Annotated[
        bool, typer.Option(help="Find out what the robot's arm can do in each scene.")
    ] = True,
    report: Report = None,
    json_file: Rates = None,
) -> None:
    """Bind BDDL problems to base scenes and verify them, or say why not."""
    console = Console()
    depth = Depth.INSTANTIATE if instantiate else Depth.BIND if bind_only else Depth.VERIFY
    with mended(out):
        for file in filter(None, (report, json_file)):
            check_writable(file)
        if out is not None:
            _check_free(out, depth)
        sources = [_parsed(source) for source in _sources(bddl, activity, jsonl, eai)]
        if reached_by is not None:
            sources = _reached(sources, reached_by)
        bases = [build_base_scene(scene_id) for scene_id in scene_ids(scenes)]
        judged = _judged(console, sources, bases, seed, depth, Foresight() if look_ahead else None)
        verified = [item for item in judged if isinstance(item, Verified)]
        if out is not None and verified:
            write_dataset(
                out,
                [item.record for item in verified],
                {item.record.bundle_digest: item.bundle for item in verified},
            )
        outcomes = [outcome_of(source, item) for source, item in zip(sources, judged, strict=True)]
        evaluation = (solved_of if depth is Depth.VERIFY else evaluation_of)(outcomes, seed)
        _write(outcomes, evaluation, report, json_file)
    if len(sources) == 1:
        _print_one(console, sources[0], judged[0])
        return
    _print_outcomes(console, judged)
    if out is not None and not verified:
        fail(f"no problem was admitted, so {out} was not written: `--bind-only` shows which could be bound")


def _reached(sources: Sequence[SourceText], profile: Profile) -> list[SourceText]:
    """Those with goals that the profile's skills reach. Raises SourceError where there is none."""
    found = [source for source in sources if not unreachable_atoms(read_problem(source)[0], profile)]
    if not found:
        raise SourceError(
            f"no goal of {len(sources)} problems is reached by the profile {profile.value!r}: leave out --reached-by"
        )
    return found


def _write(
    outcomes: Sequence[Outcome], evaluation: Evaluation, report: Path | None, json_file: Path | None
) -> None:
    if report is not None:
        write_whole(report, (json.dumps(report_to_json(outcomes), indent=1) + "\n").encode("ascii"))
        write_whole(report.with_suffix(".md"), report_to_markdown(outcomes).encode("utf-8"))
    if json_file is not None:
        write_whole(json_file, (json.dumps(evaluation_to_json(evaluation), indent=1) + "\n").encode("ascii"))


def _check_free(out: Path, depth: Depth) -> None:
    """Nothing that is already there is overwritten, and nothing that could not be written is begun."""
    if depth is not Depth.VERIFY:
        raise SourceError(
            f"to {depth.value} admits no task that could be written: leave out --out, or --bind-only and --instantiate"
        )
    if (out / TASKS_FILE).exists():
        raise SourceError(f"{out} holds a dataset already: name another folder with --out")
    out.mkdir(parents=True, exist_ok=True)


def _parsed(source: SourceText) -> SourceText:
    """The source, whose text is BDDL: what is not shall be told before scenes are built."""
    try:
        read_problem(source)
    except BddlError as error:
        raise SourceError(f"{source.name}: {error}") from error
    return source


def _sources(bddl: Path | None, activity: str, jsonl: Path | None, eai: Path | None) -> Iterator[SourceText]:
    given = sum(map(bool, (bddl, activity, jsonl, eai)))
    if given != 1:
        raise SourceError(
            f"found {given} sources: expected exactly one of --bddl FILE, --activity NAME, --jsonl FILE and --eai FOLDER"
        )
    if bddl is not None:
        yield read_file(bddl)
    elif jsonl is not None:
        yield from read_jsonl(jsonl)
    elif eai is not None:
        yield from read_eai(eai)
    elif activity == EVERY_ACTIVITY:
        yield from map(read_activity, activity_names())
    else:
        yield read_activity(activity)


def _judged(
    console: Console,
    sources: Sequence[SourceText],
    bases: Sequence[Scene],
    seed: int,
    depth: Depth,
    foresight: Foresight | None,
) -> list[Imported | Verified | Refusal]:
    outcomes: list[Imported | Verified | Refusal] = []
    with progress(console) as bars, contextlib.closing(PlacementLibrary()) as library:
        bar = bars.add_task("problems", total=len(sources))
        for source in sources:
            match depth:
                case Depth.INSTANTIATE:
                    outcomes.append(bind_first(source, bases, seed=seed, manner=Manner(reachable=False)))
                case Depth.BIND:
                    outcomes.append(bind_first(source, bases, seed=seed))
                case Depth.VERIFY:
                    outcomes.append(verify_first(source, bases, library, foresight, seed=seed))
            bars.advance(bar)
    return outcomes


def _print_one(console: Console, source: SourceText, outcome: Imported | Verified | Refusal) -> None:
    if isinstance(outcome, Refusal):
        fail(f"{source.name} is refused ({outcome.reason}): {outcome.sentence}")
    if not isinstance(outcome, Verified):
        for note in outcome.notes:
            console.print(note, highlight=False, markup=False)
    task = outcome.record.task if isinstance(outcome, Verified) else outcome.task
    console.print(
        f"{task.task_id}: {task.instruction}\n  goal: {task.goal_bddl}", highlight=False, markup=False
    )
    if isinstance(outcome, Verified):
        for call in outcome.record.oracle:
            console.print("  " + " ".join(map(str, call.values())), highlight=False, markup=False)


def _print_outcomes(console: Console, outcomes: list[Imported | Verified | Refusal]) -> None:
    counts = Counter(
        f"refused: {item.reason}" if isinstance(item, Refusal) else type(item).__name__.lower()
        for item in outcomes
    )
    table = Table("outcome", "problems")
    for outcome, count in counts.most_common():
        table.add_row(outcome, str(count))
    console.print(table)
