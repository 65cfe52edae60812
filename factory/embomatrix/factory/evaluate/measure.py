"""Evaluations from what is given to figures: which scenes, which writers, which rooms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.evaluate.aesthetics import Calibration, auc, fit, score_room
from embomatrix.factory.evaluate.drafts import asked_in
from embomatrix.factory.evaluate.rooms import read_rooms
from embomatrix.factory.evaluate.spoiling import SPOILERS
from embomatrix.factory.evaluate.tasks import panel
from embomatrix.factory.metrics.figures import EvaluationError, EvaluationFigures
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.social.casting import NAMES
from embomatrix.factory.social.writer import SocialWriter
from embomatrix.factory.writer.tasks import PlainWriter
from embomatrix.pages.figures import Better, Figure

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from embomatrix.factory.evaluate.drafts import DraftFeatures
    from embomatrix.factory.evaluate.rooms import RoomPlan

SOCIAL: Final = ""
PLAIN: Final = "plain"
FEWEST_PIECES: Final = 3
"""Furniture of a hand-made room from which a layout can be told."""
AUC_GOAL: Final = 0.8
SPLITS: Final = 10
"""Halvings of the rooms that the held-out AUC is a mean over: one alone depends on luck."""


@dataclass(frozen=True, slots=True)
class WrittenTasks:
    """Tasks by base scene, as each writer made them for the same scenes."""

    social: Mapping[str, Sequence[DraftFeatures]]
    plain: Mapping[str, Sequence[DraftFeatures]]


def written_for(
    scene_ids: Sequence[str], each: int, seed: int, progress: Callable[[int], None] = lambda _done: None
) -> WrittenTasks:
    """So many tasks of each writer for each base scene. Raises CatalogError for an unknown scene."""
    social, plain = SocialWriter(seed), PlainWriter()
    asked: dict[str, tuple[list[DraftFeatures], list[DraftFeatures]]] = {}
    for done, scene_id in enumerate(scene_ids, start=1):
        base = build_base_scene(scene_id, seed=seed)
        asked[base.base] = (asked_in(base, social, each, seed), asked_in(base, plain, each, seed))
        progress(done)
    return WrittenTasks(
        {base: social for base, (social, _) in asked.items()},
        {base: plain for base, (_, plain) in asked.items()},
    )


def evaluate_tasks(written: WrittenTasks, each: int, seed: int) -> EvaluationFigures:
    """The panel of both writers. Scenes that gave fewer tasks than asked for are named, and count with what they gave."""
    short = [base for base, group in written.social.items() if len(group) < each]
    figures = (*panel(written.social, NAMES), *panel(written.plain, NAMES, PLAIN))
    notes = (f"Fewer than {each} tasks were found in {', '.join(short)}.",) if short else ()
    conditions = {"scenes": len(written.social), "tasks a scene": each, "seed": seed}
    return EvaluationFigures("tasks", conditions, figures, notes)


def evaluate_aesthetics(rooms_file: Path, seed: int) -> tuple[EvaluationFigures, Calibration]:
    """How well fitted scores tell rooms that the fit did not see, and the calibration of all rooms. Raises EvaluationError."""
    rooms = [room for room in read_rooms(rooms_file) if len(room.pieces) >= FEWEST_PIECES]
    if len(rooms) < 4:
        raise EvaluationError(f"{rooms_file} holds {len(rooms)} rooms with furniture: expected 4 or more")
    rng = np.random.default_rng(seed)
    found: dict[str, list[float]] = {name: [] for name in ("auc", *SPOILERS)}
    good, bad = [], []
    for _ in range(SPLITS):
        order = [rooms[int(at)] for at in rng.permutation(len(rooms))]
        half = len(order) // 2
        calibration = fit(order[:half], _spoilt(order[:half], rng))
        real = _totals(order[half:], calibration)
        spoilt = {
            name: _totals([spoil(room, rng) for room in order[half:]], calibration)
            for name, spoil in SPOILERS.items()
        }
        for name, totals in spoilt.items():
            found[name].append(auc(real, totals))
        everything = np.concatenate([*spoilt.values()])
        found["auc"].append(auc(real, everything))
        good.append(real.mean())
        bad.append(everything.mean())
    n = SPLITS * (len(rooms) - len(rooms) // 2)
    figures = (
        Figure("aesthetics_auc", float(np.mean(found["auc"])), "", Better.HIGHER, n, AUC_GOAL),
        *(
            Figure(f"aesthetics_auc {name}", float(np.mean(found[name])), "", Better.NEITHER, n)
            for name in SPOILERS
        ),
        Figure("aesthetics hand-made", float(np.mean(good)), "of 10", Better.NEITHER, n),
        Figure("aesthetics spoilt", float(np.mean(bad)), "of 10", Better.NEITHER, 3 * n),
    )
    conditions = {"rooms": len(rooms), "halvings": SPLITS, "seed": seed}
    return EvaluationFigures("aesthetics", conditions, figures), fit(rooms, _spoilt(rooms, rng))


def _spoilt(rooms: Sequence[RoomPlan], rng: np.random.Generator) -> list[RoomPlan]:
    return [spoil(room, rng) for spoil in SPOILERS.values() for room in rooms]


def _totals(
    rooms: Sequence[RoomPlan], calibration: Calibration
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array([score_room(room, calibration).total for room in rooms])
