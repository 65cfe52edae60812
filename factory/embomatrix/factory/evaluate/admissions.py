"""Admission figures from a build's ledger: share of admitted drafts, reasons against the others, tasks per hour."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from embomatrix.factory.metrics.figures import EvaluationError, EvaluationFigures
from embomatrix.factory.pipeline.settings import WriterKind
from embomatrix.factory.pipeline.store import ATTEMPTS_FILE, RETOLD, TIMES_FILE, build_settings
from embomatrix.factory.scenes.build import base_scene_of
from embomatrix.pages.figures import Better, Figure
from embomatrix.world.json_text import parse_json

GOAL_PERCENT: Final = 90.0
GOAL_PER_HOUR: Final = 1000.0
CORES: Final = 2
"""Number of otherwise idle cores that the goal refers to."""
ADMITTED: Final = "admitted"
LONGEST_S: Final = 1e9
"""CPU time of one variant beyond which a record is damaged."""


def admitted_share(folder: Path, label: str = "") -> tuple[Figure, ...]:
    """Return the admitted share in percent of drafts; empty without a ledger. Raises EvaluationError for a damaged one.

    Drafts of variants that an earlier build proved are left out.
    """
    attempts = _proved_here(folder, _attempts(folder))
    if not attempts:
        return ()
    share = 100 * sum(each["outcome"] == ADMITTED for each in attempts) / len(attempts)
    return (_figure("admitted_share", label, share, "%", len(attempts), GOAL_PERCENT),)


def evaluate_admissions(folder: Path) -> EvaluationFigures:
    """Return share and rate of a build's admitted drafts, and the reasons against the others.

    Raises EvaluationError or DatasetError.
    """
    attempts = _attempts(folder)
    if not attempts:
        raise EvaluationError(
            f"{folder} has no ledger of drafts: expected {ATTEMPTS_FILE}, which `factory build`, `generate` and `corpus` write"
        )
    everything, attempts = attempts, _proved_here(folder, attempts)
    if not attempts:
        raise EvaluationError(
            f"an earlier build proved all tasks of {folder}: name the folder of a build without proofs with --dataset"
        )
    settings = build_settings(folder)
    label = WriterKind.PLAIN.value if settings.get("writer") == WriterKind.PLAIN else ""
    figures = (*admitted_share(folder, label), *_per_hour(folder, attempts, label))
    reasons = Counter(each["outcome"] for each in attempts if each["outcome"] != ADMITTED)
    counts = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common()) or "nothing"
    conditions = {
        "dataset": folder.name,
        "scenes": len({base_scene_of(each["scene"]) for each in attempts}),
        "reachability": "yes" if settings.get("reachability") else "no",
        "in physics": "yes" if settings.get("physical") else "no",
    }
    notes = [f"Rejected drafts{f' of {label}' if label else ''}: {counts}."]
    if len(attempts) < len(everything):
        notes.append(
            f"{len(everything) - len(attempts)} drafts are left out, because an earlier build proved or refused them."
        )
    return EvaluationFigures("admission", conditions, figures, tuple(notes))


def _per_hour(folder: Path, attempts: Sequence[dict[str, Any]], label: str) -> tuple[Figure, ...]:
    """Return the admitted tasks per hour on two cores, by CPU time. Variants without a recorded time are left out."""
    lines = [line for line in _times(folder / TIMES_FILE) if not line.get(RETOLD)]
    timed = {
        (str(line.get("split")), line["variant"]) for line in lines if isinstance(line.get("variant"), int)
    }
    spent_s = sum(line["cpu_s"] for line in lines)
    admitted = sum(
        each["outcome"] == ADMITTED and (each["split"], each["variant"]) in timed for each in attempts
    )
    if not spent_s or not timed:
        return ()
    pace = CORES * 3600 * admitted / spent_s
    return (_figure("admitted_per_hour", label, pace, "tasks", admitted, GOAL_PER_HOUR),)


def _proved_here(folder: Path, attempts: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the drafts without those of variants that an earlier build proved."""
    retold = {
        (str(line.get("split")), line.get("variant"))
        for line in _times(folder / TIMES_FILE)
        if line.get(RETOLD) and isinstance(line.get("variant"), int)
    }
    return [each for each in attempts if (each["split"], each["variant"]) not in retold]


def _times(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the records of CPU time. A truncated line is skipped: its work was repeated."""
    if not path.is_file():
        return
    for line in path.read_bytes().splitlines():
        try:
            value = parse_json(line)
        except ValueError:
            continue
        if (
            isinstance(value, dict)
            and isinstance(value.get("cpu_s"), float)
            and 0 <= value["cpu_s"] < LONGEST_S
        ):
            yield value


def _attempts(folder: Path) -> list[dict[str, Any]]:
    path = folder / ATTEMPTS_FILE
    if not path.is_file():
        return []
    try:
        return [_attempt(parse_json(line)) for line in path.read_bytes().splitlines()]
    except (OSError, ValueError, LookupError, TypeError, OverflowError) as error:
        raise EvaluationError(
            f"{path} can't be read as a ledger ({error}): run the build again to rewrite it"
        ) from error


def _attempt(line: Any) -> dict[str, Any]:
    texts = {name: str(line[name]) for name in ("split", "scene", "outcome")}
    return {**texts, "variant": int(line["variant"])}


def _figure(name: str, label: str, value: float, unit: str, n: int, goal: float) -> Figure:
    """Return a figure. Only builds without a label have goals."""
    return Figure(f"{name} {label}".strip(), value, unit, Better.HIGHER, n, None if label else goal)
