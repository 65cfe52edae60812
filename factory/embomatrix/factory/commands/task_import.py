"""``embomatrix factory import``: bind BDDL problems to base scenes, verify them, and report refusals."""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.admission import TaskRefusal
from embomatrix.factory.commands.options import ArmReachability, Jobs, Scenes, Seed, processes
from embomatrix.factory.commands.terminal import counter, fail, say, show_table, user_errors
from embomatrix.factory.metrics.figures import EvaluationFigures, write_evaluation
from embomatrix.factory.pipeline.settings import DEFAULT_SCENES
from embomatrix.factory.pipeline.store import ResumableLog
from embomatrix.factory.scenes.base_scenes import base_scenes, check_scenes_free, keep_scenes
from embomatrix.factory.scenes.build import base_scene_of
from embomatrix.factory.task_import.batch import Imported, Verified
from embomatrix.factory.task_import.dialects import read_problem
from embomatrix.factory.task_import.importer import Depth, ImportSettings, importing
from embomatrix.factory.task_import.reach import unreachable_atoms
from embomatrix.factory.task_import.report import (
    REPORT_MARK,
    ImportScope,
    ProblemOutcome,
    changed_problems,
    evaluation_of,
    outcome_from_json,
    report_to_json,
    report_to_markdown,
    solved_of,
)
from embomatrix.factory.task_import.sources import (
    ProblemSourceError,
    SourceText,
    activity_names,
    read_activity,
    read_eai,
    read_file,
    read_jsonl,
)
from embomatrix.host.own_files import Force, keep_foreign, prepare_output
from embomatrix.world.bddl import BddlError, BddlProblem
from embomatrix.world.dataset import TASKS_FILE, DatasetError, write_dataset
from embomatrix.world.scene import Scene
from embomatrix.world.substances import is_substance
from embomatrix.world.task import Profile
from embomatrix.world.whole_file import write_whole

EVERY_ACTIVITY = "all"


Report = Annotated[
    Path | None,
    typer.Option(help="File for the outcome of each problem as JSON. Markdown is written beside it."),
]
Eai = Annotated[Path | None, typer.Option(help="Folder of the unpacked eai-eval wheel with its 100 tasks.")]
Instantiate = Annotated[
    bool,
    typer.Option("--instantiate", help="Bind also goals that no skill reaches. Skips the verification."),
]
Rates = Annotated[Path | None, typer.Option("--json", help="File for the import rates.")]
Kept = Annotated[
    Path | None,
    typer.Option(
        "--outcomes",
        help="JSON lines file that each outcome is appended to. An interrupted import resumes from it.",
    ),
]
ReachedBy = Annotated[
    Profile | None, typer.Option(help="Skip problems with goals that no skill of this profile reaches.")
]
Solids = Annotated[bool, typer.Option("--solids", help="Skip problems that name a liquid or a powder.")]


def import_(
    bddl: Annotated[Path | None, typer.Option(help="A BDDL problem file.")] = None,
    activity: Annotated[str, typer.Option(help="An activity of the bddl package, or 'all'.")] = "",
    jsonl: Annotated[
        Path | None, typer.Option(help="JSON lines file of records with 'name' and 'bddl'.")
    ] = None,
    eai: Eai = None,
    scenes: Scenes = None,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option(help="Folder for the admitted tasks.")] = None,
    bind_only: Annotated[bool, typer.Option("--bind-only", help="Skip the verification.")] = False,
    instantiate: Instantiate = False,
    reached_by: ReachedBy = None,
    solids: Solids = False,
    reachability: ArmReachability = True,
    report: Report = None,
    json_file: Rates = None,
    outcomes: Kept = None,
    jobs: Jobs = None,
    force: Force = False,
) -> None:
    """Bind BDDL problems to base scenes and verify them. Refusals are reported with a reason."""
    depth = Depth.INSTANTIATE if instantiate else Depth.BIND if bind_only else Depth.VERIFY
    kept = (
        "; finished outcomes are kept; run the same command again to resume" if outcomes is not None else ""
    )
    prepare_output("factory import", report, json_file, outcomes)
    if report is not None:
        keep_foreign("", {report.with_suffix(".md")} - {report}, REPORT_MARK, force=force)
    with user_errors(out or outcomes, kept):
        if out is not None:
            _check_free(out, depth, outcomes)
        sources = _selected(_sources(bddl, activity, jsonl, eai), reached_by, solids=solids)
        settings = ImportSettings(base_scenes(scenes or DEFAULT_SCENES), seed, depth, reachability)
        if out is not None:
            check_scenes_free(out, settings.scenes.own.values())
        log = _resumed_log(outcomes, sources, settings)
        made = _import_all(sources[len(log.outcomes) :], settings, processes(jobs), log)
        admitted = out is None or _written(out, made, settings.scenes.own)
        all_outcomes = log.outcomes
        verified = depth is Depth.VERIFY
        scope = ImportScope(depth.value, tuple(settings.scenes.names), reached_by, solids)
        evaluation = (solved_of if verified else evaluation_of)(all_outcomes, seed, scope)
        _write(all_outcomes, evaluation, report, json_file)
    if len(sources) == len(made) == 1:
        _print_one(sources[0], made[0])
        return
    _print_outcomes(all_outcomes, depth)
    if not admitted:
        fail(
            f"no problem was admitted, so {out} was not written: use --bind-only to see which problems can be bound"
        )


def _written(out: Path, made: Sequence[Imported], own: Mapping[str, Scene]) -> bool:
    """Write the admitted tasks as a dataset, with their scenes of files. Return False if there are none."""
    # a problem that is given twice makes one task
    verified = list({item.record.task.task_id: item for item in made if isinstance(item, Verified)}.values())
    if verified:
        used = dict.fromkeys(base_scene_of(item.record.task.scene_id) for item in verified)
        keep_scenes(out, [own[name] for name in used if name in own])
        bundles = {item.record.bundle_digest: item.bundle for item in verified}
        write_dataset(out, [item.record for item in verified], bundles)
    return bool(verified)


def _resumed_log(
    path: Path | None,
    sources: Sequence[SourceText],
    settings: ImportSettings,
) -> ResumableLog[ProblemOutcome]:
    """Return the log of the problems done so far. Raise DatasetError if the file is about other problems."""
    log = ResumableLog[ProblemOutcome](path)
    decisive_settings = {
        "seed": settings.seed,
        "depth": settings.depth,
        "scenes": [*map(settings.scenes.key, settings.scenes.names)],
        "reachability": settings.reachability,
    }
    log.resume(decisive_settings, outcome_from_json)
    known = [outcome.name for outcome in log.outcomes]
    if known != [source.name for source in sources[: len(known)]]:
        raise DatasetError(f"{path} is about other problems than this import: name another file")
    return log


def _selected(
    sources: Sequence[SourceText], profile: Profile | None, *, solids: bool
) -> Sequence[SourceText]:
    """Return the problems that pass the filters. Raise ProblemSourceError if none does."""
    chosen = sources
    if profile is not None:
        chosen = [
            source for source in chosen if _passes(source, lambda read: not unreachable_atoms(read, profile))
        ]
        if not chosen:
            raise ProblemSourceError(
                f"no goal of {len(sources)} problems is reached by the profile {profile.value!r}: leave out --reached-by"
            )
    if solids:
        chosen = [
            source
            for source in chosen
            if _passes(source, lambda read: not any(map(is_substance, read.objects.values())))
        ]
        if not chosen:
            raise ProblemSourceError("each of the problems names a liquid or a powder: leave out --solids")
    return chosen


def _passes(source: SourceText, condition: Callable[[BddlProblem], bool]) -> bool:
    """True if the problem meets the condition, or can't be parsed: then the import refuses it with the reason."""
    try:
        return condition(read_problem(source)[0])
    except BddlError:
        return True


def _write(
    outcomes: Sequence[ProblemOutcome],
    evaluation: EvaluationFigures,
    report: Path | None,
    json_file: Path | None,
) -> None:
    if report is not None:
        write_whole(report, (json.dumps(report_to_json(outcomes), indent=1) + "\n").encode("ascii"))
        write_whole(report.with_suffix(".md"), report_to_markdown(outcomes).encode("utf-8"))
    if json_file is not None:
        write_evaluation(json_file, evaluation)


def _check_free(out: Path, depth: Depth, outcomes: Path | None) -> None:
    """Raise ProblemSourceError if the options exclude a dataset, or if the folder already holds one."""
    if depth is not Depth.VERIFY:
        raise ProblemSourceError(
            f"the depth {depth.value!r} admits no task, so --out stays empty: leave out --out, or --bind-only and --instantiate"
        )
    if outcomes is not None:
        raise ProblemSourceError("an import into a dataset can't be resumed: leave out --out, or --outcomes")
    if (out / TASKS_FILE).exists():
        raise ProblemSourceError(f"{out} holds a dataset already: name another folder with --out")
    out.mkdir(parents=True, exist_ok=True)


def _sources(bddl: Path | None, activity: str, jsonl: Path | None, eai: Path | None) -> list[SourceText]:
    """Return the given problems. Raise ProblemSourceError if a single one is invalid BDDL; many are refused one by one."""
    sources = list(_given(bddl, activity, jsonl, eai))
    if len(sources) == 1:
        try:
            read_problem(sources[0])
        except BddlError as error:
            raise ProblemSourceError(f"{sources[0].name}: {error}") from error
    return sources


def _given(bddl: Path | None, activity: str, jsonl: Path | None, eai: Path | None) -> Iterator[SourceText]:
    given = sum(map(bool, (bddl, activity, jsonl, eai)))
    if given != 1:
        raise ProblemSourceError(
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


def _import_all(
    sources: Sequence[SourceText],
    settings: ImportSettings,
    jobs: int,
    log: ResumableLog[ProblemOutcome],
) -> list[Imported]:
    """Import the problems and append each outcome to the log.

    Return the imported tasks and refusals. Tasks that another process only bound are left out.
    """
    made: list[Imported] = []
    done = len(log.outcomes)
    with (
        counter("problems", done + len(sources)) as count,
        importing(settings, min(jobs, len(sources) or 1)) as import_many,
    ):
        count(done)
        for outcome, item in import_many(sources):
            log.add(outcome)
            if item is not None:
                made.append(item)
            count(len(log.outcomes))
    return made


def _print_one(source: SourceText, outcome: Imported) -> None:
    if isinstance(outcome, TaskRefusal):
        fail(f"{source.name} is refused ({outcome.reason}): {outcome.sentence}")
    for note in outcome.notes:
        say(note)
    task = outcome.record.task if isinstance(outcome, Verified) else outcome.task
    say(f"{task.task_id}: {task.instruction}\n  goal: {task.goal_bddl}")
    if isinstance(outcome, Verified):
        for call in outcome.record.oracle:
            say("  " + " ".join(map(str, call.values())))


def _print_outcomes(outcomes: Sequence[ProblemOutcome], depth: Depth) -> None:
    done = "verified" if depth is Depth.VERIFY else "imported"
    counts = Counter(f"refused: {each.reason}" if each.reason else done for each in outcomes)
    show_table(("outcome", "problems"), counts.most_common())
    right = [each for each in outcomes if each.has_right_scene]
    changed = ", ".join(f"{count} {change}" for change, count in changed_problems(outcomes)) or "none"
    say(
        f"bound without any change: {sum(each.is_faithful for each in right)} of {len(right)} with a right scene; "
        f"changes: {changed}"
    )
