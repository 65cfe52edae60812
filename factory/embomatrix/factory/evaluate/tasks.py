"""The panel of diversity: what tasks of a scene have in common in words and goals, with and without social simulation."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import TYPE_CHECKING, Final

from embomatrix.factory.metrics.diversity import diversity, normalised_entropy
from embomatrix.pages.figures import Better, Figure

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence
    from pathlib import Path

    from embomatrix.factory.evaluate.drafts import DraftFeatures

GOALS: Final[Mapping[str, tuple[Better, float]]] = {
    "self_bleu4": (Better.LOWER, 0.35),
    "near_duplicate_rate": (Better.LOWER, 0.01),
    "named_share": (Better.HIGHER, 0.9),
    "signature_entropy": (Better.HIGHER, 0.9),
}
"""For tasks with social simulation."""
_SIGN: Final = re.compile(r"([\w ]+)\(([^()]*)\)")
_PERSON: Final = re.compile(r"^\* \*\*(.+?)\*\*, \d+,", re.MULTILINE)


def panel(
    groups: Mapping[str, Sequence[DraftFeatures]], names: Collection[str], label: str = ""
) -> tuple[Figure, ...]:
    """Figures of tasks by base scene. ``names`` are those of the people; ``label`` tells writers apart, and has no goals."""
    tasks = [asked for group in groups.values() for asked in group]
    measured = diversity(
        {base: [asked.instruction for asked in group] for base, group in groups.items()},
        [asked.signature for asked in tasks],
        names,
    )
    values = dataclasses.asdict(measured)
    n = len(tasks)
    del values["groups"], values["group"]
    signs = [sign for asked in tasks for sign in _SIGN.findall(asked.signature)]
    things = [arguments.split(",") for _, arguments in signs]
    values |= {
        "predicate_entropy": evenness([predicate.strip() for predicate, _ in signs]),
        "object_entropy": evenness([each[0] for each in things]),
        "destination_entropy": evenness([each[1] for each in things if len(each) > 1]),
        "several_rooms_share": _share([len(asked.rooms) > 1 for asked in tasks]),
        "quantified_share": _share([asked.quantified for asked in tasks]),
    }
    return tuple(_figure(name, value, n, label) for name, value in values.items())


def evenness(values: Sequence[str]) -> float:
    """Shannon entropy over that of a uniform choice among the values that come up; 0 for fewer than two."""
    kinds = len(set(values))
    if kinds < 2:
        return 0.0
    # Words come up many times over: their number, not that of all uses, bounds the entropy.
    return normalised_entropy(values) * math.log(len(values)) / math.log(kinds)


def people_of(folder: Path) -> frozenset[str]:
    """Names of everybody in a dataset's transcripts; none where it has no transcripts."""
    return frozenset(
        name
        for path in sorted(folder.glob("*.md"))
        for name in _PERSON.findall(path.read_text(encoding="utf-8"))
    )


def _figure(name: str, value: float, n: int, label: str) -> Figure:
    better, goal = GOALS.get(name, (Better.NEITHER, 0.0))
    unit = "words" if name == "words" else ""
    shown = f"{name} {label}".strip()
    return Figure(shown, value, unit, better, n, goal if better and not label else None)


def _share(held: Sequence[bool]) -> float:
    return sum(held) / len(held) if held else 0.0
