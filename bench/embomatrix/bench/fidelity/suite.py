"""`bench fidelity`: the same plans in both execution modes, and their agreement.

A folder holds the trials, a line for each result, and the disagreements. An interrupted suite resumes from it.
"""

import contextlib
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from embomatrix.bench.fidelity.pool import LOST, FidelityPool, Modes
from embomatrix.bench.report.figures import BenchError
from embomatrix.sim.fidelity.compare import (
    Comparison,
    FidelityTrial,
    PlanKind,
    comparison_from_json,
    disagreement_to_json,
    trial_from_json,
    trial_to_json,
)
from embomatrix.sim.fidelity.plans import SolvedTask, TrialRequest, write_trials
from embomatrix.sim.fidelity.sampler import SKILLS
from embomatrix.skills.parse import PlanError, plan_from_json
from embomatrix.skills.syntax import Skill
from embomatrix.world.dataset import Dataset, DatasetError, TaskRecord
from embomatrix.world.whole_file import write_whole

SHARES: Final[Mapping[PlanKind, float]] = {
    PlanKind.ORACLE: 0.20,
    PlanKind.VALID: 0.52,
    PlanKind.PERTURBED: 0.17,
    PlanKind.FAILING: 0.11,
}
"""Shares of the plans by kind."""
ROUNDS: Final = 6
"""Rounds of plans for skills that still lack calls."""
LIMIT_S: Final = 180.0
"""Limit for a process to load a scene and run a trial on a busy machine."""
SETTINGS_FILE: Final = "settings.json"
PLANS_FILE: Final = "plans.jsonl"
RESULTS_FILE: Final = "results.jsonl"
DISAGREEMENTS_FILE: Final = "disagreements.jsonl"


@dataclass(frozen=True, slots=True)
class FidelitySettings:
    """Settings of the trials: at least ``plans``, with at least ``calls`` of every skill if the scenes allow it."""

    plans: int = 1_000
    calls: int = 200
    seed: int = 0


@dataclass(frozen=True, slots=True)
class SuiteResult:
    """Result of a suite. ``lost`` has one sentence for each trial without a result."""

    comparisons: tuple[Comparison, ...]
    lost: tuple[str, ...]


def run_fidelity(
    dataset: Dataset,
    settings: FidelitySettings,
    folder: Path,
    processes: int,
    modes: Modes,
    on_step: Callable[[str], None],
) -> SuiteResult:
    """Write or read the trials, execute those without a result, and save the disagreements.

    Lost trials are repeated. Without processes nothing is executed, and the result covers the results so far.

    Raise BenchError if the folder holds a suite of other settings or can't be read; DatasetError and EngineError.
    """
    with _readable(folder):
        folder.mkdir(parents=True, exist_ok=True)
        trials = _trials(dataset, settings, folder, modes, on_step)
        path = folder / RESULTS_FILE
        done = {value["trial"]: value for value in _lines(path)}
        lost = {name for name, value in done.items() if LOST in value}
        jobs = _jobs(trial for trial in trials if trial.trial_id in lost or trial.trial_id not in done)
        if processes:
            with _appending(path, done.values()) as append:

                def keep(value: Mapping[str, Any]) -> None:
                    append(value)
                    done[value["trial"]] = dict(value)
                    on_step(f"{len(done)} of {len(trials)} plans in both modes")

                FidelityPool(dataset.folder, modes, processes, LIMIT_S).run(jobs, keep)
        if not done:
            raise BenchError(f"{folder} holds no result to sum up: run the suite with one process or more")
        return _outcome(trials, done, folder)


def examples_of(dataset: Dataset) -> dict[str, list[SolvedTask]]:
    """Tasks with their oracle plans, by bundle. Raise BenchError for an invalid plan."""
    found: dict[str, list[SolvedTask]] = {}
    for record in dataset.records:
        found.setdefault(record.bundle_digest, []).append(_example(record))
    if not found:
        raise BenchError(
            f"the dataset in {dataset.folder} has no tasks: get the shipped one with `embomatrix factory starter`"
        )
    return found


def write_all_trials(
    dataset: Dataset, settings: FidelitySettings, modes: Modes, on_step: Callable[[str], None]
) -> tuple[FidelityTrial, ...]:
    """Write trials over all bundles of the dataset; equal arguments give equal trials."""
    examples = examples_of(dataset)
    plans = {kind: math.ceil(settings.plans * share / len(examples)) for kind, share in SHARES.items()}
    trials: list[FidelityTrial] = []
    extra = 0
    wanted = dict.fromkeys(SKILLS, math.ceil(settings.calls / len(examples)))
    for turn in range(ROUNDS):
        for number, (digest, items) in enumerate(examples.items(), start=1):
            request = TrialRequest(plans, wanted, settings.seed + turn, extra, first=len(trials))
            with contextlib.closing(modes.cached(dataset.read_bundle(digest))) as simulator:
                trials += write_trials(simulator, digest, items, request)
            on_step(f"plans for {number} of {len(examples)} scenes")
        lacking = {skill: settings.calls - count for skill, count in _calls(trials).items()}
        if all(count <= 0 for count in lacking.values()):
            break
        # Some scenes can't use a skill, so the others get more than their share of its plans.
        wanted = {skill: math.ceil(2 * max(0, lacking[skill]) / len(examples)) for skill in SKILLS}
        plans, extra = {}, max(wanted.values())
    return tuple(trials)


def _calls(trials: Iterable[FidelityTrial]) -> dict[Skill, int]:
    """Calls of each skill in plans that should succeed."""
    sure = (PlanKind.ORACLE, PlanKind.VALID)
    counts = Counter(call.skill for trial in trials if trial.kind in sure for call in trial.plan)
    return {skill: counts[skill] for skill in SKILLS}


def _example(record: TaskRecord) -> SolvedTask:
    try:
        return SolvedTask(record.task, plan_from_json([*record.oracle], record.task.profile))
    except PlanError as error:
        raise BenchError(
            f"the oracle plan of task {record.task.task_id!r} is no plan: {error}; build the dataset anew"
        ) from error


def _trials(
    dataset: Dataset,
    settings: FidelitySettings,
    folder: Path,
    modes: Modes,
    on_step: Callable[[str], None],
) -> tuple[FidelityTrial, ...]:
    """Read the trials of the folder; write them first if it is empty."""
    bundles = sorted({record.bundle_digest for record in dataset.records})
    wanted = {**asdict(settings), "bundles": bundles}
    path = folder / SETTINGS_FILE
    if path.exists():
        if json.loads(path.read_text(encoding="utf-8")) != wanted:
            raise BenchError(
                f"{folder} holds a suite of other settings or another dataset: name another folder with --out"
            )
        return tuple(trial_from_json(value) for value in _lines(folder / PLANS_FILE))
    for name in (PLANS_FILE, RESULTS_FILE):
        if (folder / name).exists():
            raise BenchError(
                f"{folder / name} belongs to no suite: name another folder with --out, or move it away"
            )
    trials = write_all_trials(dataset, settings, modes, on_step)
    text = "".join(json.dumps(trial_to_json(trial)) + "\n" for trial in trials)
    write_whole(folder / PLANS_FILE, text.encode("utf-8"))
    write_whole(path, (json.dumps(wanted) + "\n").encode("utf-8"))
    return trials


def _jobs(trials: Iterable[FidelityTrial]) -> list[list[FidelityTrial]]:
    """Trials of each bundle, the longest job first, so that processes end at about the same time."""
    by_bundle: dict[str, list[FidelityTrial]] = {}
    for trial in trials:
        by_bundle.setdefault(trial.bundle_digest, []).append(trial)
    return sorted(by_bundle.values(), key=len, reverse=True)


def _outcome(
    trials: Sequence[FidelityTrial], done: Mapping[str, Mapping[str, Any]], folder: Path
) -> SuiteResult:
    values = [done[trial.trial_id] for trial in trials if trial.trial_id in done]
    comparisons = tuple(comparison_from_json(value) for value in values if LOST not in value)
    lines = [
        json.dumps(disagreement_to_json(item)) + "\n"
        for item in comparisons
        if item.first_difference is not None or item.atoms_of_either != item.equal_atoms
    ]
    write_whole(folder / DISAGREEMENTS_FILE, "".join(lines).encode("utf-8"))
    return SuiteResult(comparisons, tuple(f"{v['trial']}: {v[LOST]}" for v in values if LOST in v))


@contextlib.contextmanager
def _appending(
    path: Path, values: Iterable[Mapping[str, Any]]
) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """Append results to the file, after rewriting it without a truncated last line.

    Only an executing suite does so: summing up must not replace the file that another process writes.
    """
    write_whole(path, "".join(json.dumps(value) + "\n" for value in values).encode("utf-8"))
    with path.open("a", encoding="utf-8") as file:

        def append(value: Mapping[str, Any]) -> None:
            file.write(json.dumps(value) + "\n")
            file.flush()

        yield append


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    """JSON values of a file's lines; none without the file. A truncated last line is left out."""
    if not path.exists():
        return
    lines = path.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines):
        try:
            yield json.loads(line)
        except ValueError as error:
            if number != len(lines) - 1:
                raise BenchError(
                    f"{path}:{number + 1} is damaged: remove the folder and run again"
                ) from error


@contextlib.contextmanager
def _readable(folder: Path) -> Iterator[None]:
    try:
        yield
    except DatasetError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise BenchError(
            f"{folder} holds no suite that this version reads ({error}): name another with --out"
        ) from error
