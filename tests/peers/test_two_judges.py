"""E3: oracle plans and mutants of them before both judges, our simulator and EAI's graph.

The graph has no locations, so `move` calls are not compared. ``pytest -m eai -s`` prints the figures.
"""

import collections
import contextlib

import numpy as np
import pytest
from tests.fakes.eai_tasks import in_its_scene
from tests.fakes.two_judges import (
    ForeignObjectError,
    Mutant,
    cause,
    deeds_of,
    in_eai,
    mutants,
    names_of,
    with_ways,
)

from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.task_import.sources import read_eai
from embomatrix.reward.hierarchy import score
from embomatrix.sim.placing.pose_cache import PlacementLibrary
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import plan_from_json
from embomatrix.trainer.eai.environment import install
from embomatrix.trainer.eai.judge import NativeJudge
from embomatrix.world.bundle import decode_bundle

pytestmark = [pytest.mark.eai, pytest.mark.timeout(1800)]
TASKS = {
    "Rs_int": (
        "assembling_gift_baskets",
        "polishing_furniture",
        "re-shelving_library_books",
        "sorting_books",
    ),
    "Merom_1_int": ("locking_every_door",),
    "Benevolence_1_int": ("bringing_in_wood", "loading_the_dishwasher", "washing_dishes"),
    "Ihlen_1_int": ("collecting_aluminum_cans", "laying_tile_floors", "putting_leftovers_away"),
}
ROUNDS = 3
"""Rounds of mutants; each has one of every kind."""


def compared(imported, found, native, judge):
    """Return kind, both verdicts and the cause of disagreement of each plan."""
    record = found.record
    table, names = record.task.table, names_of(imported, native)
    deeds = deeds_of(plan_from_json(list(record.oracle), record.task.profile))
    rows = [row for row, name in enumerate(table) if name in names]
    rng = np.random.default_rng(0)
    plans = [Mutant("whole", deeds), *(each for _ in range(ROUNDS) for each in mutants(deeds, rows, rng))]
    with contextlib.closing(load_simulator(decode_bundle(found.bundle))) as simulator:
        for plan in plans:
            try:
                steps = in_eai(plan.deeds, table, names)
            except ForeignObjectError:
                continue
            trace = simulator.execute(record.task, with_ways(plan.deeds), 0)
            ours = score(record.task, trace.touched, simulator.facts).success
            verdict = judge.judge(native.demo, steps)
            assert verdict is not None
            differ = ours != verdict.exact
            yield plan.kind, ours, verdict.exact, cause(trace, verdict) if differ else "", trace, verdict


def test_judges_agree_or_the_disagreement_has_a_known_cause(capsys):
    library, rows = PlacementLibrary(), []
    with NativeJudge(install()) as judge:
        natives = {task.task: task for task in judge.tasks()}
        sources = {source.name: source for source in read_eai(install().package_root)}
        for scene, names in TASKS.items():
            base = build_base_scene(scene)
            for name in names:
                imported, found = in_its_scene(sources[name], base, library)
                rows += [(name, *row) for row in compared(imported, found, natives[name], judge)]
    differing = [row for row in rows if row[2] != row[3]]
    kinds = collections.Counter(row[1] for row in rows)
    with capsys.disabled():
        print(f"\nE3: {len(rows)} plans of {sum(map(len, TASKS.values()))} tasks: {dict(kinds)}")
        print(f"agree {len(rows) - len(differing)}, both succeed {sum(row[2] and row[3] for row in rows)}")
        for name, kind, ours, theirs, why, trace, verdict in differing:
            last = trace.steps[-1].message if trace.steps else ""
            print(f"  {name} {kind}: ours {ours}, theirs {theirs}: {why or '?'}; {last}; {verdict.errors}")
    assert len(rows) >= 80
    assert all(row[5] for row in differing), "a disagreement without a known cause"
    assert len(differing) <= 0.1 * len(rows)
