"""Evaluations: diversity of tasks, aesthetics score of layouts, admission figures, and the page of figures."""

import asyncio
import dataclasses
import gzip
import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from embomatrix.factory.commands.app import app
from embomatrix.factory.evaluate.admissions import admitted_share, evaluate_admissions
from embomatrix.factory.evaluate.aesthetics import (
    CLUTTER,
    EDGES,
    PLACEMENT,
    PROPERTIES,
    Calibration,
    EvidenceTables,
    Property,
    RoomObservation,
    ScorePart,
    parts_of,
    score_room,
)
from embomatrix.factory.evaluate.aesthetics_fit import (
    SPOILT_PART,
    SpoiltRoom,
    auc,
    fit,
    half_added,
    held_out_scores,
)
from embomatrix.factory.evaluate.judges import DiversityScores, with_judge
from embomatrix.factory.evaluate.page import BEGIN, END, with_factory
from embomatrix.factory.evaluate.room_plans import FLOOR, RoomBox, RoomPlan, plan_of, read_rooms
from embomatrix.factory.evaluate.spoilers import SPOILERS
from embomatrix.factory.evaluate.tasks import (
    DraftFeatures,
    asked_in,
    evenness,
    panel,
    people_of,
    society_drafts,
)
from embomatrix.factory.metrics.figures import (
    EvaluationError,
    EvaluationFigures,
    evaluation_to_json,
    read_evaluation,
)
from embomatrix.factory.pipeline.corpus import training_scenes
from embomatrix.llm.values import Reply, Usage
from embomatrix.pages.figures import Better, Figure
from embomatrix.starter.recipes import PARTS
from embomatrix.world.catalog import Catalog
from embomatrix.world.dataset import DatasetError

BED = RoomBox("bed", (1.0, 0.8), (1.0, 0.8), 0.0, 0.0, 0.6, FLOOR)
DESK = RoomBox("desk", (3.7, 3.0), (0.3, 0.7), 0.0, 0.0, 0.75, FLOOR)
CHAIR = RoomBox("chair", (3.2, 3.0), (0.25, 0.25), 0.0, 0.0, 0.9, FLOOR)
BOOK = RoomBox("book", (3.7, 3.2), (0.1, 0.1), 0.0, 0.75, 0.8, "desk")
PILLOW = RoomBox("pillow", (0.4, 0.8), (0.2, 0.3), 0.0, 0.6, 0.7, "bed")
ROOM = RoomPlan(
    name="bedroom_0",
    family="bedroom_0",
    low_m=(0.0, 0.0),
    high_m=(4.0, 4.0),
    pieces=(BED, DESK, CHAIR),
    built_in=(),
    things=(BOOK, PILLOW),
    carried=((1,), (0,)),
    added_pieces=(0, 1, 2),
    added_things=(0, 1),
)


def test_every_property_has_edges_and_one_part_and_every_part_a_weight_and_spoilers():
    assert set(EDGES) == set(Property) - {Property.USUAL}
    assert sorted(name for names in PROPERTIES.values() for name in names) == sorted(Property)
    assert set(PROPERTIES) == {*CLUTTER, *PLACEMENT} == set(ScorePart) == set(SPOILT_PART)
    assert set.union(*map(set, SPOILT_PART.values())) == set(SPOILERS)


@pytest.mark.parametrize(
    ("part", "change"),
    [
        (ScorePart.FURNITURE_APART, {"pieces": (dataclasses.replace(BED, center_m=(3.0, 2.6)), DESK, CHAIR)}),
        (ScorePart.FURNITURE_APART, {"pieces": (dataclasses.replace(BED, center_m=(0.5, 0.8)), DESK, CHAIR)}),
        (ScorePart.FURNITURE_PLACED, {"pieces": (dataclasses.replace(BED, tilt_rad=0.3), DESK, CHAIR)}),
        (ScorePart.FURNITURE_PLACED, {"pieces": (dataclasses.replace(BED, center_m=(2.0, 1.8)), DESK, CHAIR)}),
        (ScorePart.FURNITURE_PLACED, {"pieces": (BED, DESK, dataclasses.replace(CHAIR, center_m=(0.5, 3.5)))}),
        (ScorePart.THINGS_APART, {"things": (BOOK, dataclasses.replace(BOOK, center_m=(3.75, 3.2)))}),
        (ScorePart.THINGS_APART, {"things": (dataclasses.replace(BOOK, center_m=(3.4, 3.2)), PILLOW)}),
        (ScorePart.THINGS_SQUARE, {"things": (dataclasses.replace(BOOK, tilt_rad=0.5), PILLOW)}),
        (ScorePart.HOSTS_USUAL, {
            "things": (dataclasses.replace(BOOK, host="bed"), dataclasses.replace(PILLOW, host="desk"))
        }),
    ],
)  # fmt: skip
def test_each_part_falls_with_its_flaw(part, change):
    calibration = Calibration.load()
    assert (
        parts_of(dataclasses.replace(ROOM, **change), calibration)[part] < parts_of(ROOM, calibration)[part]
    )


def test_room_without_added_objects_has_no_score():
    bare = dataclasses.replace(ROOM, added_pieces=(), added_things=())
    assert score_room(bare, Calibration.load()) is None


def test_only_added_objects_are_scored():
    book = dataclasses.replace(ROOM, added_pieces=(), added_things=(0,))
    crooked = dataclasses.replace(book, pieces=(dataclasses.replace(BED, tilt_rad=0.4), DESK, CHAIR))
    calibration = Calibration.load()
    assert score_room(crooked, calibration) == score_room(book, calibration)
    assert ScorePart.FURNITURE_PLACED not in parts_of(book, calibration)


def test_kind_that_no_hand_made_room_has_is_at_home_everywhere():
    tables = EvidenceTables(Calibration.load())
    assert {tables.host_fit("unicorn", host) for host in ("desk", "bed", "moon")} == {0.0}


@given(st.sampled_from(sorted(SPOILERS)), st.integers(0, 1000))
def test_scores_with_all_objects_present_lie_between_2_and_10(name, seed):
    spoilt = SPOILERS[name](ROOM, np.random.default_rng(seed))
    assert 2 <= score_room(spoilt, Calibration.load()) <= 10


@given(st.sampled_from(sorted(SPOILERS)), st.integers(0, 1000))
def test_corrupted_room_has_the_same_objects_elsewhere(name, seed):
    spoilt = SPOILERS[name](ROOM, np.random.default_rng(seed))
    kinds = [item.kind for item in (*spoilt.pieces, *spoilt.things)]
    assert kinds == ["bed", "desk", "chair", "book", "pillow"]
    if name in ("shifted", "dropped"):
        for thing, before, (bearer,) in zip(spoilt.things, ROOM.things, ROOM.carried, strict=True):
            moved = np.subtract(spoilt.pieces[bearer].center_m, ROOM.pieces[bearer].center_m)
            assert np.allclose(np.subtract(thing.center_m, before.center_m), moved)


@given(st.sampled_from(sorted(SPOILERS)), st.integers(0, 1000))
def test_corruption_leaves_objects_alone_that_were_not_added(name, seed):
    rng = np.random.default_rng(seed)
    room = half_added(ROOM, rng)
    spoilt = SPOILERS[name](room, rng)
    for at, piece in enumerate(room.pieces):
        assert at in room.added_pieces or spoilt.pieces[at] == piece
    for at, (thing, (bearer,)) in enumerate(zip(room.things, room.carried, strict=True)):
        assert at in room.added_things or bearer in room.added_pieces or spoilt.things[at] == thing


def test_auc_counts_ordered_pairs_and_half_of_ties():
    assert auc(np.array([3.0, 2.0]), np.array([1.0, 2.0])) == pytest.approx((2 + 1 + 0.5) / 4)


def _families(count):
    """Return rooms alike of different families, each with corrupted copies."""
    rng = np.random.default_rng(0)
    plans = [dataclasses.replace(ROOM, family=f"bedroom_{number}") for number in range(count)]
    return [SpoiltRoom.of(plan, rng) for plan in plans]


def test_fit_separates_corrupted_rooms_with_nonnegative_weights():
    calibration = fit(_families(8))
    assert min(weight for weights in calibration.weights.values() for weight in weights.values()) >= 0
    rng = np.random.default_rng(1)
    spoilt = [score_room(spoil(ROOM, rng), calibration) for spoil in SPOILERS.values() for _ in range(8)]
    assert score_room(ROOM, calibration) > np.mean(spoilt)


def test_held_out_scores_cover_every_room_and_interval_holds_the_auc():
    found = held_out_scores(_families(20), np.random.default_rng(0))
    low, high = found.interval("dropped", np.random.default_rng(0))
    assert np.all(found.real >= 2)
    assert low <= found.auc("dropped") <= high
    assert found.auc("dropped") > 0.9


def test_score_of_a_room_of_the_simulator_looks_at_the_named_objects(flat):
    room = next(room.name for room in flat.rooms if room.name == "kitchen_0")
    held = [item.name for item in flat.objects if item.room == room and item.host in flat.by_name]
    plan = plan_of(flat, room, held)
    assert len(plan.added_things) == len(held) > 0
    assert plan.added_pieces == ()
    hosts = [plan.bearers[hosts[0]].kind for hosts in plan.carried]
    assert hosts == [thing.host for thing in plan.things]
    assert len(RoomObservation.of(plan).chosen) == len(held)
    assert 2 <= score_room(plan, Calibration.load()) <= 10


def _rooms_file(path, rooms):
    path.write_bytes(gzip.compress(json.dumps({"rooms": rooms}).encode()))
    return path


def test_hand_made_rooms_are_read_with_furniture_and_small_objects(tmp_path):
    objects = [
        ["Floor", "", [0, 0, 0], 0.0, [0, -0.2, 0], [9, 0.4, 9], [], 1.0],
        ["TVStand", "a", [1, 0, 0], 91.0, [1, 0.3, 0], [0.4, 0.6, 1.2], ["Floor"], 9.0],
        ["Vase", "b", [1, 0.6, 0.2], 33.0, [1, 0.7, 0.2], [0.1, 0.2, 0.1], ["TVStand"], 1.0],
        ["Painting", "", [0, 1.5, 2], 0.0, [0, 1.5, 2], [1, 1, 0.1], [], 0],
    ]
    (room,) = read_rooms(_rooms_file(tmp_path / "rooms.json.gz", [{"kind": "bedrooms", "objects": objects}]))
    assert [(item.kind, item.host) for item in (*room.pieces, *room.things)] == [
        ("tv_stand", FLOOR),
        ("vase", "tv_stand"),
    ]
    assert room.carried == ((0,),)
    assert room.pieces[0].tilt_rad == pytest.approx(math.radians(1))
    assert room.high_m == (1.2, 2.05)


def test_file_without_rooms_is_reported_in_a_sentence(tmp_path):
    with pytest.raises(EvaluationError, match="not a table of hand-made rooms"):
        read_rooms(_rooms_file(tmp_path / "rooms.json.gz", [{"kind": "bedrooms", "objects": [["Bed"]]}]))
    whole = (tmp_path / "rooms.json.gz").read_bytes()
    for damaged in (
        whole[:-9],
        whole[:20] + b"\xff" * 9 + whole[29:],
        gzip.compress(b"3"),
        gzip.compress(b"{"),
    ):
        (tmp_path / "rooms.json.gz").write_bytes(damaged)
        with pytest.raises(EvaluationError, match="not a table of hand-made rooms"):
            read_rooms(tmp_path / "rooms.json.gz")


@given(st.lists(st.sampled_from("abc"), min_size=1, max_size=12))
def test_evenness_is_1_for_equal_frequencies(values):
    assert 0 <= evenness(values) <= 1 + 1e-9
    assert evenness(list("abc") * 4) == pytest.approx(1)


def test_both_writers_are_measured_and_one_has_goals():
    tasks = [
        DraftFeatures("Mia is cooking: put the mug in the oven.", "inside(mug,oven)", ("kitchen_0",), False),
        DraftFeatures("For Hugo, open a fridge.", "open(fridge)", ("kitchen_0", "bar_0"), True),
    ]
    figures = {figure.name: figure for figure in panel({"Rs_int": tasks}, {"Mia", "Hugo"})}
    assert figures["named_share"].value == 1
    assert figures["several_rooms_share"].value == figures["quantified_share"].value == 0.5
    assert figures["predicate_entropy"].value == 1
    assert figures["destination_entropy"].value == 0
    assert {name for name, figure in figures.items() if figure.goal is not None} == {
        "self_bleu4", "near_duplicate_rate", "named_share", "signature_entropy",
    }  # fmt: skip
    assert all(figure.goal is None for figure in panel({"Rs_int": tasks}, {"Mia", "Hugo"}, "plain"))


def test_goals_repeat_within_a_scene_only():
    asked = DraftFeatures("Mia needs the fridge open.", "open(fridge)", ("kitchen_0",), False)
    other = DraftFeatures("Mia wants to read: light, please.", "toggled_on(lamp)", ("kitchen_0",), False)
    figures = panel({"Rs_int": [asked, other, asked, asked], "Merom_0_int": [asked]}, {"Mia"})
    assert {figure.name: figure.value for figure in figures}["repeated_goal_rate"] == 2 / 5


def test_people_are_read_from_transcripts(tmp_path):
    (tmp_path / "t.md").write_text(
        "# x\n\n* **Mia**, 40, nurse, likes chess\n* **Hugo**, 9, pupil\n\n**Mia** (need): x\n"
    )
    assert people_of(tmp_path) == {"Mia", "Hugo"}


def test_drafts_of_a_scene_differ_and_depend_only_on_the_seed(flat):
    first = asked_in(flat, society_drafts, 6, 0)
    assert len({asked.instruction for asked in first}) == 6
    assert first == asked_in(flat, society_drafts, 6, 0)


def test_training_and_held_out_scenes_partition_all_scenes():
    assert len(training_scenes()) == 45
    assert {*training_scenes(), *PARTS[2].scenes} == {*Catalog.load().scene_ids}


EVALUATION = EvaluationFigures(
    "tasks",
    {"scenes": 45, "seed": 0},
    (
        Figure("self_bleu4", 0.3, "", Better.LOWER, 450, 0.35),
        Figure("words", 20.0, "words", Better.NEITHER, 450),
    ),
    ("A note.",),
)


def test_figures_are_read_back_equal(tmp_path):
    path = tmp_path / "tasks.json"
    path.write_text(json.dumps(evaluation_to_json(EVALUATION)))
    assert read_evaluation(path) == EVALUATION
    for damaged in ('{"part": "tasks"}', path.read_text().replace('"n": 450', '"n": 1e999'), "[" * 5_000):
        path.write_text(damaged)
        with pytest.raises(EvaluationError, match="contains no figures"):
            read_evaluation(path)


def test_page_keeps_everything_outside_the_factory_section():
    page = with_factory("# Benchmarks\n\nBy others.\n", [EVALUATION])
    assert page.startswith("# Benchmarks\n\nBy others.\n")
    assert "| self_bleu4 | 0.3 | ≤ 0.35 | reached | 450 |" in page
    worse = dataclasses.replace(EVALUATION.figures[0], value=0.4)
    again = with_factory(f"{page}\nAfter.\n", [dataclasses.replace(EVALUATION, figures=(worse,), notes=())])
    assert "| self_bleu4 | 0.4 | ≤ 0.35 | short | 450 |" in again
    assert "reached" not in again
    assert again.endswith("\nAfter.\n")
    assert again.count(BEGIN) == again.count(END) == 1


def test_unmeasured_parts_stay_on_the_page():
    rooms = dataclasses.replace(EVALUATION, part="aesthetics", notes=("Of rooms.",))
    page = with_factory("# Benchmarks\n", [EVALUATION, rooms])
    assert page.index("### Diversity of tasks") < page.index("### Aesthetics")
    worse = dataclasses.replace(EVALUATION.figures[0], value=0.4)
    again = with_factory(page, [dataclasses.replace(EVALUATION, figures=(worse, *EVALUATION.figures[1:]))])
    assert again == page.replace("| 0.3 | ≤ 0.35 | reached |", "| 0.4 | ≤ 0.35 | short |", 1)
    assert with_factory(page, [rooms]) == page


def test_files_of_one_part_are_combined_on_the_page():
    other = dataclasses.replace(
        EVALUATION, figures=(dataclasses.replace(EVALUATION.figures[0], name="distinct1"),)
    )
    page = with_factory("", [EVALUATION, other])
    assert page.count("### Diversity of tasks") == page.count("Measured:") == 1
    assert "| distinct1 | 0.3 | ≤ 0.35 | reached | 450 |" in page


def test_page_without_an_end_marker_is_rejected():
    with pytest.raises(EvaluationError, match="insert it at the end"):
        with_factory(f"# Benchmarks\n{BEGIN}\ntext\n", [EVALUATION])
    with pytest.raises(EvaluationError, match="is in two files"):
        with_factory("", [EVALUATION, EVALUATION])
    with pytest.raises(EvaluationError, match="unknown part 'x'"):
        with_factory("", [dataclasses.replace(EVALUATION, part="x")])


def test_ledger_gives_the_admitted_share(tmp_path):
    assert admitted_share(tmp_path) == ()
    ledger = tmp_path / "attempts.jsonl"
    draft = {"split": "train", "variant": 0, "scene": "Rs_int-train-000"}
    ledger.write_text(
        "".join(json.dumps({**draft, "outcome": outcome}) + "\n" for outcome in ("admitted", "no_plan") * 2)
    )
    (figure,) = admitted_share(tmp_path)
    assert (figure.value, figure.n, figure.is_reached) == (50.0, 4, False)
    for damaged in (b'{"outcome": "admitted"}', b'{"outc', b"\xff", b"[" * 5_000):
        ledger.write_bytes(json.dumps({**draft, "outcome": "admitted"}).encode() + b"\n" + damaged)
        with pytest.raises(EvaluationError, match="can't be read as a ledger"):
            admitted_share(tmp_path)


def a_build(folder, writer, times):
    """Write a build of two variants with three admitted tasks and one refused task, and its file of times."""
    settings = {"settings": {"writer": writer, "reachability": True, "physical": False}}
    drafts = [(0, "admitted"), (0, "admitted"), (0, "no_plan"), (1, "admitted")]
    lines = [
        {"split": "train", "variant": number, "scene": "Rs_int-train-000", "outcome": outcome}
        for number, outcome in drafts
    ]
    (folder / "build.jsonl").write_text(json.dumps(settings) + "\n")
    (folder / "attempts.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (folder / "times.jsonl").write_text("".join(json.dumps(line) + "\n" for line in times))


def test_admission_rate_uses_recorded_times_of_variants_and_base_scenes(tmp_path):
    known = [
        {"base_scenes": 1, "cpu_s": 2.0},
        {"split": "train", "variant": 0, "cpu_s": 5.0},
        {"base_scenes": 1, "cpu_s": 1.0},
    ]
    a_build(tmp_path, "social", known)
    with (tmp_path / "times.jsonl").open("ab") as file:
        file.write(b'{"cpu_s": NaN, "variant": 1}\n{"split": [], "variant": 2, "cpu_s": 1e400}\n\xff\n')
        file.write(b'{"split": "train", "vari')
    found = evaluate_admissions(tmp_path)
    assert found.figure("admitted_share").value == 75.0
    pace = found.figure("admitted_per_hour")
    assert (pace.value, pace.n, pace.is_reached) == (2 * 3600 * 2 / 8.0, 2, True)
    assert found.notes == ("Rejected drafts: no_plan 1.",)
    assert found.conditions["reachability"] == "yes"
    assert "| admitted_per_hour |" in with_factory("", [found])


def test_drafts_that_an_earlier_build_proved_are_no_part_of_admission(tmp_path):
    here = {"split": "train", "variant": 0, "cpu_s": 5.0}
    retold = {"split": "train", "variant": 1, "retold": True, "cpu_s": 0.1}
    a_build(tmp_path, "social", [here, retold])
    found = evaluate_admissions(tmp_path)
    assert (found.figure("admitted_share").value, found.figure("admitted_share").n) == (100 * 2 / 3, 3)
    assert found.figure("admitted_per_hour").value == 2 * 3600 * 2 / 5.0
    assert found.notes[1] == "1 drafts are left out, because an earlier build proved or refused them."
    assert [figure.n for figure in admitted_share(tmp_path)] == [3]
    a_build(tmp_path, "social", [retold, {**retold, "variant": 0}])
    assert admitted_share(tmp_path) == ()
    with pytest.raises(EvaluationError, match="an earlier build proved all tasks of"):
        evaluate_admissions(tmp_path)


def test_plain_writer_figures_have_no_goals_and_untimed_builds_no_rate(tmp_path):
    a_build(tmp_path, "plain", [])
    found = evaluate_admissions(tmp_path)
    assert [(figure.name, figure.goal) for figure in found.figures] == [("admitted_share plain", None)]


def test_folder_that_is_no_build_is_reported_in_a_sentence(tmp_path):
    answer = CliRunner().invoke(app, ["evaluate", "admission", "--dataset", str(tmp_path)])
    assert answer.exit_code == 2
    assert "has no ledger of drafts" in answer.output
    a_build(tmp_path, "social", [])
    (tmp_path / "build.jsonl").write_text("{}\n")
    with pytest.raises(DatasetError, match="does not hold the settings"):
        evaluate_admissions(tmp_path)


def test_judge_scores_from_0_to_10():
    with pytest.raises(ValueError, match="less than or equal to 10"):
        DiversityScores.model_validate({"variety": 8, "characters": 9, "overall": 11, "explanation": "x"})


class ScriptedJudge:
    """Judge that gives these answers and repeats the last one."""

    def __init__(self, *answers):
        self._answers = list(answers)

    async def complete(self, request):
        text = self._answers.pop(0) if len(self._answers) > 1 else self._answers[0]
        return Reply(text, "judge-1", Usage(), "stop", 0.0)


SCORES = '{"variety": 8, "characters": 6, "overall": 7, "explanation": "x"}'


def test_unusable_answers_of_a_judge_are_counted_and_cost_no_figure():
    groups = [["Open the fridge."], ["Close the fridge."]]
    asked = asyncio.run(with_judge(EVALUATION, ScriptedJudge(SCORES), groups, 0))
    assert (asked.figure("judge overall").value, asked.figure("judge overall").n) == (7.0, 2)
    assert asked.conditions == {**EVALUATION.conditions, "judge": "judge-1"}
    assert asked.figures[:2] == EVALUATION.figures
    once = asyncio.run(with_judge(EVALUATION, ScriptedJudge("no", "no", "no", SCORES), groups, 0))
    assert once.figure("judge variety").n in (1, 2)
    never = asyncio.run(with_judge(EVALUATION, ScriptedJudge("no"), groups, 0))
    assert never.figures == EVALUATION.figures
    assert never.notes == ("A note.", "2 scenes got no usable answer of the judge.")
    assert never.conditions["judge"] == "judge-1"


def test_command_reports_user_errors_in_a_sentence(tmp_path):
    found = CliRunner().invoke(app, ["evaluate", "tasks", "--dataset", str(tmp_path / "none")])
    assert found.exit_code == 2
    assert "none" in found.output
    found = CliRunner().invoke(app, ["evaluate", "aesthetics", "--rooms", str(tmp_path)])
    assert found.exit_code == 2
    assert "not a table of hand-made rooms" in found.output.replace("\n", " ")


def test_figures_of_a_build_and_of_a_file_reach_the_page(tmp_path):
    a_build(tmp_path, "plain", [])
    figures = tmp_path / "figures"
    measure = ["evaluate", "admission", "--dataset", str(tmp_path), "--out", str(figures)]
    assert CliRunner().invoke(app, measure).exit_code == 0
    page = tmp_path / "page.md"
    read = CliRunner().invoke(app, ["evaluate", str(figures / "admission.json"), "--page", str(page)])
    assert read.exit_code == 0, read.output
    assert "admitted_share plain" in read.output
    assert "| admitted_share plain |" in page.read_text()


def test_page_that_cannot_be_written_is_reported_before_anything_is_measured(tmp_path):
    a_build(tmp_path, "plain", [])
    measure = ["evaluate", "admission", "--dataset", str(tmp_path), "--page", str(tmp_path)]
    answer = CliRunner().invoke(app, measure)
    assert answer.exit_code == 2
    assert "can't be written (Is a directory)" in answer.output.replace("\n", " ")
    assert "admitted_share" not in answer.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["admision"], "unknown part 'admision'"),
        (["admission"], "give --dataset FOLDER"),
        (["scenes"], "give --sample FILE"),
        (["tasks", "--llm", "http://127.0.0.1:1"], "give --model"),
    ],
)
def test_missing_input_of_a_part_is_named(arguments, words):
    found = CliRunner().invoke(app, ["evaluate", *arguments])
    assert found.exit_code == 2
    assert words in " ".join(found.output.split())
