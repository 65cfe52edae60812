"""Days of simulated people: needs, scenes laid out for them, and the tasks in words."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import zlib
from collections import Counter
from pathlib import Path
from typing import Never

import numpy as np
import pytest
from tests.fakes.datasets import write_kitchen_dataset

from embomatrix.factory.admission import RefusalReason
from embomatrix.factory.days import maker as days_maker
from embomatrix.factory.days.drafts import _renamed, _without
from embomatrix.factory.days.laying import LaidOut, lay_out
from embomatrix.factory.days.maker import DAYS, DayMaker, days_with_proofs
from embomatrix.factory.days.planning import PlannedDay, need_weights, plan_day
from embomatrix.factory.days.proofs import DayProofs
from embomatrix.factory.language import clauses
from embomatrix.factory.language.kinds import is_held_out
from embomatrix.factory.pipeline.build import _SplitOrders, build_dataset, split_scenes
from embomatrix.factory.pipeline.settings import BuildSettings, WriterKind
from embomatrix.factory.pipeline.store import BuildStore, Rejection, VariantResult, VariantYield
from embomatrix.factory.pipeline.variants import VariantOrder
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.day import NeedOfDay, draw_needs, wish_of
from embomatrix.factory.social.household import draw_cast
from embomatrix.factory.social.knowledge import Need, events
from embomatrix.factory.social.values import Cast
from embomatrix.factory.social.wish import Condition, WishPredicate, problem_of
from embomatrix.factory.writer.tasks import Draft
from embomatrix.starter.archive import pack
from embomatrix.world.bddl import parse_problem, render_problem
from embomatrix.world.dataset import Dataset, DatasetError, write_dataset
from embomatrix.world.evaluate import ground_size
from embomatrix.world.scene import Scene
from embomatrix.world.task import TaskCategory

SCENES = ("Rs_int", "Pomaria_1_int", "restaurant_diner")
LONG = re.compile(r"\w+_\d+|\{|\}|  ")


@pytest.fixture(scope="module")
def bases() -> dict[str, Scene]:
    return {name: build_base_scene(name) for name in SCENES}


def people(base: Scene, split: str = "train") -> tuple[Cast, np.random.Generator]:
    rng = np.random.default_rng(zlib.crc32(base.base.encode()))
    return draw_cast(base.base, [room.name for room in base.rooms], rng, split, 0), rng


def drafts(base: Scene, split: str = "train") -> tuple[Draft, ...]:
    rooms = tuple(room.name for room in base.rooms)
    order = VariantOrder(split, 1, base.base, rooms, dict.fromkeys(TaskCategory, 1), frozenset())
    planned = plan_day(order, base, 0)
    assert isinstance(planned, PlannedDay)
    return planned.drafts


def needs_by_name() -> dict[str, Need]:
    return {need.name: need for event in events() for need in event.needs}


def test_most_needs_can_be_wished_for_in_some_scene(bases: dict[str, Scene]) -> None:
    views = [SceneView(base) for base in bases.values()]
    rng = np.random.default_rng(0)
    found = [
        need
        for need in needs_by_name().values()
        if any(wish_of(need, view, rng) for view in views for _ in range(4))
    ]
    assert len(found) > 0.8 * len(needs_by_name())


def test_the_wishes_of_a_day_are_a_bddl_problem_that_parses(bases: dict[str, Scene]) -> None:
    for base in bases.values():
        cast, rng = people(base)
        needs = draw_needs(SceneView(base), cast, 8, 3, rng, {})
        problem, members = problem_of("day", [need.wish for need in needs])
        assert parse_problem(render_problem(problem)) == problem
        assert len(members) == len(needs)
        for need, names in zip(needs, members, strict=True):
            assert {len(names[group.label]) == group.count for group in need.wish.objects} == {True}


def test_needs_come_from_the_people_of_the_place(bases: dict[str, Scene]) -> None:
    for base in bases.values():
        cast, rng = people(base)
        for need in draw_needs(SceneView(base), cast, 8, 3, rng, {}):
            person = cast.of(need.person.name)
            causes = {person.job, person.job.removeprefix("retired "), person.hobby}
            assert not need.event.of or causes & need.event.of
            assert need.event.ages[0] <= person.age <= need.event.ages[1]


def test_instructions_name_a_person_and_no_object_by_its_name_in_the_scene(bases: dict[str, Scene]) -> None:
    seen = 0
    for name in ("Pomaria_1_int", "restaurant_diner"):
        for draft in drafts(bases[name]):
            text = draft.task.instruction
            assert not LONG.search(text), text
            assert text[0].isupper()
            assert draft.task.goal_objects <= set(draft.task.table)
            assert 1 <= ground_size(draft.task.goal, draft.task.types) <= 40
            assert "## The people" in draft.transcript
            seen += 1
    assert seen >= 5


def test_a_thing_that_the_scene_lacks_is_laid_out_for_its_wish(bases: dict[str, Scene]) -> None:
    base = bases["Rs_int"]
    view = SceneView(base)
    rng = np.random.default_rng(4)
    cast, _ = people(base)
    need = next(need for event in events() if event.name == "a yoga class" for need in event.needs)
    wished = wish_of(need, view, rng)
    assert wished is not None
    event = next(event for event in events() if event.name == "a yoga class")
    asked = NeedOfDay(event, cast.people[0], "09:30", need, *wished)
    assert asked.time == "half past nine"
    day = lay_out("yoga", [asked.wish], base, rng)
    assert isinstance(day, LaidOut)
    mats = day.members[0]["mats"]
    assert len(mats) >= 3
    assert not any(name in base.by_name for name in mats)
    assert {day.scene.asset_of(name).category for name in mats} == {"rolled_yoga_mat"}


def test_training_has_no_need_and_no_goal_shape_of_the_held_out_split(bases: dict[str, Scene]) -> None:
    missing = dict.fromkeys(TaskCategory, 10)
    weights = need_weights("train", 0, missing)
    held_out = {name for name in weights if is_held_out(name, 0, 5)}
    assert held_out
    assert all(weights[name] == 0 for name in held_out)
    assert all(need_weights("heldout", 0, missing)[name] > 1 for name in held_out)


def test_days_of_training_have_no_need_of_the_held_out_split(bases: dict[str, Scene]) -> None:
    weights = need_weights("train", 0, dict.fromkeys(TaskCategory, 10))
    rare = dict.fromkeys(weights, 0.0) | {"a yoga class 1": 1.0}
    drawn: set[str] = set()
    for base in bases.values():
        view, cast = SceneView(base), people(base)[0]
        for seed in range(8):
            rng = np.random.default_rng(seed)
            drawn |= {asked.need.name for asked in draw_needs(view, cast, 12, 12, rng, weights)}
            assert {asked.need.name for asked in draw_needs(view, cast, 12, 12, rng, rare)} <= {
                "a yoga class 1"
            }
            assert draw_needs(view, cast, 12, 12, rng, dict.fromkeys(weights, 0.0)) == []
    assert len(drawn) > 20
    assert not {name for name in drawn if is_held_out(name, 0, 5)}


def test_labels_of_a_premise_are_renamed_with_those_of_its_condition() -> None:
    premise = Condition(predicate=WishPredicate.OPEN, things="fridge")
    condition = Condition(predicate=WishPredicate.TOGGLED_ON, things="lamp", provided=premise)
    renamed = _renamed(condition, {label: f"{label}_1" for label in condition.labels})
    assert renamed.labels == ("lamp_1", "fridge_1")
    assert _without(renamed, "_1") == condition


def test_a_build_tells_each_order_the_earlier_instructions_of_its_own_home(
    bases: dict[str, Scene], tmp_path: Path
) -> None:
    record = next(iter(Dataset.load(write_kitchen_dataset(tmp_path / "kitchen")).records))
    store = BuildStore(tmp_path / "build", {})
    names = [base.base for base in bases.values()]
    for number in range(6):
        task = dataclasses.replace(
            record.task, scene_id=f"{names[number % 3]}-train-{number:03d}", instruction=f"Wish {9 - number}."
        )
        found = dataclasses.replace(record, task=task, split="train", signature=str(number))
        store.add(VariantYield(VariantResult("train", number, (found,), ()), b"", {}))
    rooms = {base.base: tuple(room.name for room in base.rooms) for base in bases.values()}
    orders = _SplitOrders(store, list(bases.values()), rooms, "train", 40, DAYS)
    told = {order.base: order.told for order in orders.next_round()}
    assert told == {name: (f"Wish {9 - at}.", f"Wish {6 - at}.") for at, name in enumerate(names)}


def test_a_day_depends_only_on_settings_and_order() -> None:
    settings = BuildSettings(reachability=False, physical=False, writer=WriterKind.SOCIAL)
    rooms = tuple(room.name for room in build_base_scene("Pomaria_1_int").rooms)
    order = VariantOrder("train", 3, "Pomaria_1_int", rooms, dict.fromkeys(TaskCategory, 10), frozenset())
    first, second = DayMaker(settings), DayMaker(settings)
    try:
        one = first.make(order)
        assert one == second.make(order)
    finally:
        first.close()
        second.close()
    assert one.result.records
    for record in one.result.records:
        assert record.signature
        assert one.transcripts[record.task.task_id].startswith(f"# {record.task.instruction}")


def test_tasks_that_differ_only_in_words_keep_their_proofs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = BuildSettings(reachability=False, physical=False, writer=WriterKind.SOCIAL)
    base = build_base_scene("Pomaria_1_int")
    rooms = tuple(room.name for room in base.rooms)
    order = VariantOrder("train", 3, "Pomaria_1_int", rooms, dict.fromkeys(TaskCategory, 10), frozenset())
    with contextlib.closing(DayMaker(settings)) as maker:
        earlier = maker.make(order)
        records = earlier.result.records
        refused = Rejection(
            earlier.result.records[0].task.scene_id, "", "Once.", "", RefusalReason.SHORTCUT, "It has one."
        )
        result = dataclasses.replace(earlier.result, rejections=(*earlier.result.rejections, refused))
        store = BuildStore(tmp_path, dataclasses.asdict(settings))
        store.add(dataclasses.replace(earlier, result=result))
        write_dataset(tmp_path, records, {})
        words = dict(clauses._phrases())
        words["forms"] = {**words["forms"], "do": ["Be an angel and {do}."]}
        monkeypatch.setattr(clauses, "_phrases", lambda: words)
        anew = maker.make(order)

    def not_called(*_: object) -> Never:
        raise AssertionError("a task was proved again")

    monkeypatch.setattr(days_maker, "prove", not_called)
    with contextlib.closing(DayMaker(settings, proofs=tmp_path)) as maker:
        retold = maker.make(order)
    assert retold.result.records == anew.result.records
    assert retold.result.records != records
    assert any("Be an angel" in record.task.instruction for record in retold.result.records)
    assert (retold.bundle, retold.transcripts) == (anew.bundle, anew.transcripts)
    assert retold.result.rejections == (*anew.result.rejections, refused)
    assert retold.retold

    planned = plan_day(order, base, 0)
    assert isinstance(planned, PlannedDay)
    pack(Dataset.load(tmp_path), tmp_path / "packed.xz")
    proofs = DayProofs(tmp_path / "packed.xz")
    again = proofs.retold(planned, order)
    assert again is not None
    assert again.result.records == retold.result.records
    assert again.result.rejections == (), "a packed part has no refusals"
    moved = dataclasses.replace(planned.scene, seed=planned.scene.seed + 1)
    assert proofs.retold(dataclasses.replace(planned, scene=moved), order) is None, "another scene"
    assert proofs.retold(dataclasses.replace(planned, tasks=planned.tasks[1:]), order) is None
    other = dataclasses.replace(order, number=4)
    elsewhere = plan_day(other, base, 0)
    assert isinstance(elsewhere, PlannedDay)
    assert proofs.retold(elsewhere, other) is None, "a day without proofs"


def test_proofs_under_other_settings_are_refused(tmp_path: Path) -> None:
    settings = BuildSettings(reachability=False, physical=False, writer=WriterKind.SOCIAL)
    BuildStore(tmp_path, dataclasses.asdict(settings))
    write_dataset(tmp_path, [], {})
    with contextlib.closing(DayMaker(settings, proofs=tmp_path)):
        pass
    for name, found, expected in (
        ("physical", False, True),
        ("reachability", False, True),
        ("shortcut_plans", 16, 64),
    ):
        other = dataclasses.replace(settings, **{name: expected})
        for begin in (days_with_proofs, lambda path, wanted: DayMaker(wanted, proofs=path)):
            with pytest.raises(
                DatasetError, match=f"the setting {name} {found}, expected {expected}: name a"
            ):
                begin(tmp_path, other)
    pack(Dataset.load(tmp_path), tmp_path / "packed.xz")
    days_with_proofs(tmp_path / "packed.xz", BuildSettings(writer=WriterKind.SOCIAL))
    with pytest.raises(DatasetError, match="physical True, expected False"):
        days_with_proofs(tmp_path / "packed.xz", settings)
    (tmp_path / "build.jsonl").unlink()
    with pytest.raises(DatasetError, match="does not hold the settings of a build"):
        days_with_proofs(tmp_path, settings)


def test_held_out_scenes_are_others_than_those_of_training(bases: dict[str, Scene]) -> None:
    rooms = split_scenes(list(bases.values()), 0)
    used = {split: {base for base, names in found.items() if names} for split, found in rooms.items()}
    assert used["train"] | used["heldout"] == set(SCENES)
    assert not used["train"] & used["heldout"]
    assert used["heldout"]


def test_a_dataset_of_days_is_complete_and_resumes(tmp_path: Path) -> None:
    settings = BuildSettings(
        train=2,
        heldout=0,
        seed=1,
        scenes=("Pomaria_1_int",),
        writer=WriterKind.SOCIAL,
        reachability=False,
        physical=False,
    )
    build_dataset(tmp_path / "one", settings, making=DAYS)
    dataset = Dataset.load(tmp_path / "one")
    counts = Counter(record.task.category for record in dataset.train)
    assert (counts.total(), max(counts.values())) == (2, 1)  # a third of two tasks, rounded up
    log = (tmp_path / "one" / "build.jsonl").read_text(encoding="utf-8").splitlines(keepends=True)
    (tmp_path / "two" / "bundles").mkdir(parents=True)
    for file in (tmp_path / "one" / "bundles").iterdir():
        (tmp_path / "two" / "bundles" / file.name).write_bytes(file.read_bytes())
    (tmp_path / "two" / "build.jsonl").write_text("".join(log[:-1]), encoding="utf-8")
    build_dataset(tmp_path / "two", settings, making=DAYS)
    assert Dataset.load(tmp_path / "two").records == dataset.records
