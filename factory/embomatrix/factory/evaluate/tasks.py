"""Diversity of tasks in words and goals, with and without social simulation."""

from __future__ import annotations

import math
import re
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from embomatrix.factory.admission import TaskRefusal
from embomatrix.factory.days.planning import plan_day
from embomatrix.factory.metrics.diversity import diversity, normalised_entropy
from embomatrix.factory.metrics.figures import EvaluationFigures
from embomatrix.factory.pipeline.variants import VariantOrder, uniqueness_key
from embomatrix.factory.scenes.build import base_scene_of, build_base_scene
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.knowledge import people_table
from embomatrix.factory.writer.tasks import Draft, DraftOrder, PlainWriter
from embomatrix.factory.writer.variant import build_variant
from embomatrix.pages.figures import Better, Figure
from embomatrix.world.dataset import TaskRecord
from embomatrix.world.scene import Scene
from embomatrix.world.task import TaskCategory

GOALS: Final[Mapping[str, tuple[Better, float]]] = {
    "self_bleu4": (Better.LOWER, 0.25),
    "near_duplicate_rate": (Better.LOWER, 0.01),
    "named_share": (Better.HIGHER, 0.9),
    "signature_entropy": (Better.HIGHER, 0.95),
}
"""Goals of the figures for tasks with social simulation."""
_SIGN: Final = re.compile(r"([\w ]+)\(([^()]*)\)")
_PERSON: Final = re.compile(r"^\* \*\*(.+?)\*\*, \d+,", re.MULTILINE)


def panel(
    groups: Mapping[str, Sequence[DraftFeatures]], names: Collection[str], label: str = ""
) -> tuple[Figure, ...]:
    """Return the figures of tasks, grouped by base scene.

    ``names`` are people's names. A ``label`` distinguishes the figures of another writer, which have no goals.
    """
    tasks = [asked for group in groups.values() for asked in group]
    values = diversity(
        {base: [asked.instruction for asked in group] for base, group in groups.items()},
        [asked.signature for asked in tasks],
        names,
    )
    n = len(tasks)
    signs = [sign for asked in tasks for sign in _SIGN.findall(asked.signature)]
    things = [arguments.split(",") for _, arguments in signs]
    values |= {
        "repeated_goal_rate": _share([again for group in groups.values() for again in _repeats(group)]),
        "predicate_entropy": evenness([predicate.strip() for predicate, _ in signs]),
        "object_entropy": evenness([each[0] for each in things]),
        "destination_entropy": evenness([each[1] for each in things if len(each) > 1]),
        "several_rooms_share": _share([len(asked.rooms) > 1 for asked in tasks]),
        "quantified_share": _share([asked.quantified for asked in tasks]),
    }
    return tuple(_figure(name, value, n, label) for name, value in values.items())


def _repeats(group: Sequence[DraftFeatures]) -> list[bool]:
    """Tell of each task of a scene whether an earlier one asks for the same of the same kinds of things."""
    signatures = [asked.signature for asked in group]
    return [signature in signatures[:number] for number, signature in enumerate(signatures)]


def evenness(values: Sequence[str]) -> float:
    """Return the Shannon entropy as a share of that of a uniform choice among the distinct values; 0 for fewer than two."""
    kinds = len(set(values))
    if kinds < 2:
        return 0.0
    # Values repeat: the number of distinct values bounds the entropy, not the number of uses.
    return normalised_entropy(values) * math.log(len(values)) / math.log(kinds)


def people_of(folder: Path) -> frozenset[str]:
    """Return the names of all people in a dataset's transcripts; empty without transcripts."""
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


ROOMS: Final = 3
"""Rooms of a variant that get small objects, as in a build."""
EACH_VARIANT: Final = 5
TRIES: Final = 6
"""Attempts for each task that a variant should give."""
MOST_VARIANTS: Final = 12
"""Upper limit for the variants of a scene: some rooms offer no tasks."""


@dataclass(frozen=True, slots=True)
class DraftFeatures:
    """Measured features of a task: instruction, kind of goal, rooms, and whether the goal quantifies over objects."""

    instruction: str
    signature: str
    rooms: tuple[str, ...]
    quantified: bool


WriteDrafts = Callable[[Scene, int, int, Mapping[str, int]], Iterator[Draft]]
"""Writer of unproved drafts for the n-th variant or day of a base scene, with a seed and the tasks of each kind of goal."""


def asked_in(base: Scene, write: WriteDrafts, count: int, seed: int) -> list[DraftFeatures]:
    """Return up to ``count`` different tasks over variants or days of a base scene."""
    found: dict[str, DraftFeatures] = {}
    for number in range(MOST_VARIANTS):
        alike = Counter(each.signature for each in found.values())
        for draft in write(base, number, seed, alike):
            found.setdefault(uniqueness_key(draft.signature, draft.task.instruction), _features(draft))
            if len(found) == count:
                return list(found.values())
    return list(found.values())


def plain_drafts(base: Scene, number: int, seed: int, _alike: Mapping[str, int]) -> Iterator[Draft]:
    """Yield drafts of the plain writer about small objects, cycling through the task categories."""
    sequence = np.random.SeedSequence((seed, zlib.crc32(base.base.encode()), number))
    rng = np.random.default_rng(sequence)
    rooms = [str(name) for name in rng.permutation([room.name for room in base.rooms])[:ROOMS]]
    variant = build_variant(base, rooms, f"{base.base}-drafts-{number:02d}", rng)
    view, categories, given, writer = SceneView(variant.scene), [*TaskCategory], 0, PlainWriter()
    for attempt in range(TRIES * EACH_VARIANT):
        category = categories[(number + attempt) % len(categories)]
        draft = writer.write(
            variant, view, DraftOrder(category, f"{variant.scene.scene_id}-{attempt:02d}", rng)
        )
        if isinstance(draft, Draft):
            yield draft
            given += 1
        if given == EACH_VARIANT:
            return


def society_drafts(base: Scene, number: int, seed: int, alike: Mapping[str, int]) -> Iterator[Draft]:
    """Yield the drafts of one day of the people of a base scene."""
    rooms = tuple(room.name for room in base.rooms)
    missing = dict.fromkeys(TaskCategory, 1)
    order = VariantOrder("heldout", number, base.base, rooms, missing, frozenset(), alike)
    planned = plan_day(order, base, seed)
    if not isinstance(planned, TaskRefusal):
        yield from planned.drafts


def _features(item: Draft | TaskRecord) -> DraftFeatures:
    return DraftFeatures(item.task.instruction, item.signature, item.rooms, bool(item.task.types))


def asked_of(records: Sequence[TaskRecord], count: int) -> dict[str, list[DraftFeatures]]:
    """Return the first ``count`` tasks of each base scene in a dataset; scenes with fewer tasks are left out."""
    groups: dict[str, list[DraftFeatures]] = {}
    for record in records:
        base = base_scene_of(record.task.scene_id)
        groups.setdefault(base, []).append(_features(record))
    return {base: group[:count] for base, group in groups.items() if len(group) >= count}


PLAIN: Final = "plain"
NAMES: Final = frozenset(name for names in people_table()["names"].values() for name in names)
"""Names of people that the society draws from."""


def society_margin(figures: Sequence[Figure]) -> Figure:
    """Return the signature entropy of the society less that of the plain writer."""
    values = {figure.name: figure for figure in figures}
    entropy, plain = values["signature_entropy"], values[f"signature_entropy {PLAIN}"]
    return Figure("society_entropy_margin", entropy.value - plain.value, "", Better.HIGHER, entropy.n, 0.0)


def evaluate_tasks(
    scene_ids: Sequence[str], each: int, seed: int, progress: Callable[[int], None] = lambda _done: None
) -> tuple[Mapping[str, Sequence[DraftFeatures]], EvaluationFigures]:
    """Draft ``each`` tasks per base scene with both writers; return those of the social writer, and the figures of both.

    Scenes with fewer tasks are named in a note. Raises CatalogError for an unknown scene.
    """
    writers = (society_drafts, plain_drafts)
    social: dict[str, list[DraftFeatures]] = {}
    plain: dict[str, list[DraftFeatures]] = {}
    for done, scene_id in enumerate(scene_ids, start=1):
        base = build_base_scene(scene_id, seed=seed)
        social[base.base], plain[base.base] = (asked_in(base, writer, each, seed) for writer in writers)
        progress(done)
    short = [base for base, group in social.items() if len(group) < each]
    figures = (*panel(social, NAMES), *panel(plain, NAMES, PLAIN))
    figures = (*figures, society_margin(figures))
    notes = (f"Fewer than {each} tasks were found in {', '.join(short)}.",) if short else ()
    conditions = {"scenes": len(social), "tasks a scene": each, "seed": seed}
    return social, EvaluationFigures("tasks", conditions, figures, notes)
