"""Evaluation from answers to tables: stored, resumed, judged by the engine, and reproduced from the stored answers."""

import functools
import json
from dataclasses import replace

import numpy as np
import pytest
from tests.fakes.chat_server import ChatServer, completion
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.executors import HereExecutor

from embomatrix.llm.endpoint import Endpoint, EndpointLimits
from embomatrix.skills.parse import plan_to_json
from embomatrix.skills.prompt import Codec
from embomatrix.starter.shipped import freeze
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.evaluation.answer_sources import ask_endpoint, ask_script, questions_digest
from embomatrix.trainer.evaluation.answers import Answer, AnswerSheet, EvaluationSetup, read_answers
from embomatrix.trainer.evaluation.baselines import PLANNERS, BaselineName, fitted_scripts
from embomatrix.trainer.evaluation.benchmark import find_benchmark
from embomatrix.trainer.evaluation.exam import WorldExam, success_by_level
from embomatrix.trainer.evaluation.intervals import paired_difference
from embomatrix.trainer.evaluation.judging import judge_answers
from embomatrix.trainer.evaluation.page import evaluation_page
from embomatrix.trainer.evaluation.scoreboard import Scoreboard
from embomatrix.trainer.evaluation.table import difference_row, rates_of, read_row, report_of, text_report
from embomatrix.worker.slots.rollout_pool import RolloutPool
from embomatrix.world.dataset import Dataset
from embomatrix.world.difficulty import Difficulty
from embomatrix.world.task import Profile

APPLE = "apple_to_counter"
SOLVED = "move 10; pick_up 10; move 0; place 0 ontop"


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return find_benchmark(str(write_kitchen_dataset(tmp_path_factory.mktemp("kitchen"))), "all")


def setup_of(bench, samples=2, codec="lines", **changes):
    setup = EvaluationSetup(
        bench.name, bench.digest, bench.split, len(bench.records), "me", codec, 60, samples, 1.0, 64, 0
    )
    return replace(setup, **changes)


def judged(bench, answers, setup=None):
    executor = HereExecutor(bench.folder)
    found = judge_answers(bench, setup or setup_of(bench), executor, answers)
    return found, executor


def report(bench, answers, setup=None):
    setup = setup or setup_of(bench)
    result = WorldExam(bench, HereExecutor(bench.folder)).judge(setup, answers, lambda *_: None)
    value = report_of(setup, result)
    return value, evaluation_page(value, result.pictures)


def questions(bench, codec=Codec.LINES, rows=60):
    return WorldExam(bench, HereExecutor(bench.folder)).questions(codec, rows)


def categories(bench):
    return {record.task.task_id: record.task.category for record in bench.records}


def written(bench, name):
    plan = PLANNERS[name]
    return functools.partial(
        ask_script, lambda task_id, rng: json.dumps(plan_to_json(plan(bench.tasks[task_id], rng)))
    )


def asked(bench, name, samples=1):
    return [
        Answer(
            task_id,
            sample,
            json.dumps(plan_to_json(PLANNERS[name](task, np.random.default_rng((sample, 7))))),
        )
        for task_id, task in bench.tasks.items()
        for sample in range(samples)
    ]


def test_oracle_succeeds_everywhere_and_random_plans_parse(bench):
    oracle, _ = judged(bench, asked(bench, BaselineName.ORACLE))
    assert all(verdict.success and verdict.partial == 1.0 for verdict in oracle.verdicts)
    drawn, _ = judged(bench, asked(bench, BaselineName.RANDOM, 5))
    assert len(drawn.plans) == 5 * len(bench.records)
    assert not all(verdict.success for verdict in drawn.verdicts)


def test_greedy_baseline_solves_tasks_without_dependencies(bench):
    found, _ = judged(bench, asked(bench, BaselineName.GREEDY))
    assert {verdict.task_id: verdict.success for verdict in found.verdicts}[APPLE]


def test_measured_difficulty_splits_the_success_and_leaves_the_digest(bench):
    measured = [
        replace(record, difficulty=Difficulty(True, at % 2 == 0, True, len(record.oracle)))
        for at, record in enumerate(bench.records)
    ]
    other = replace(bench, records=tuple(measured))
    assert other.digest == bench.digest
    found, _ = judged(bench, asked(bench, BaselineName.ORACLE))
    board = Scoreboard.of(categories(bench), found.verdicts)
    by_level = success_by_level(measured, board)
    assert list(by_level) == ["success on easy tasks (2)", "success on medium tasks (2)"]
    assert [estimate.interval.value for estimate in by_level.values()] == [1.0, 1.0]
    assert success_by_level(bench.records, board) == {}


@pytest.mark.parametrize("name", [BaselineName.TEMPLATE, BaselineName.NEAREST])
def test_scripts_write_executable_plans_for_tasks_that_they_never_saw(bench, name):
    scripts = fitted_scripts(name, Dataset.load(bench.folder))
    answers = [
        Answer(task_id, 0, json.dumps(plan_to_json(scripts.plan(task_id, task.situation))))
        for task_id, task in bench.tasks.items()
    ]
    found, _ = judged(bench, answers)
    assert len(found.plans) == len(bench.records)
    assert not any(verdict.lost for verdict in found.verdicts)


def test_frozen_tasks_are_found_by_name_once_they_ship(tmp_path, monkeypatch):
    folder = write_kitchen_dataset(tmp_path / "kitchen")
    records = Dataset.load(folder).records
    file = tmp_path / "frozen.json"
    module = "embomatrix.starter.shipped"
    monkeypatch.setattr(f"{module}.frozen_file", lambda _: file)
    monkeypatch.setattr(f"{module}.unpacked_tasks", lambda *_: folder)
    with pytest.raises(TrainerError, match="does not ship with this version: pass a dataset folder"):
        find_benchmark("search")
    frozen = freeze(records[:2], file)
    found = find_benchmark("search", "train")
    assert tuple(record.task.task_id for record in found.records) == frozen.tasks
    assert found.training.records == records
    with pytest.raises(TrainerError, match="search has no tasks in the split 'heldout': it has train"):
        find_benchmark("search", "heldout")
    other = replace(records[0].task, instruction="Do something else.")
    freeze([replace(records[0], task=other), *records[1:]], file)
    with pytest.raises(
        TrainerError, match=r"have the digest sha256:.*, expected sha256:.*: remove the folder"
    ):
        find_benchmark("internal-verified-2")


def test_scripts_need_training_tasks(bench):
    heldout = Dataset(bench.folder, Dataset.load(bench.folder).heldout)
    with pytest.raises(TrainerError, match="pass a dataset that has some with --training"):
        fitted_scripts(BaselineName.NEAREST, heldout)


def test_each_kind_of_answer_gets_its_verdict(bench):
    texts = [SOLVED.replace("; ", "\n"), "I would rather not.", "dance 3", "pick_up 10", "move 99", "move 10"]
    found, _ = judged(bench, [Answer(APPLE, at, text) for at, text in enumerate(texts)])
    assert [verdict.success for verdict in found.verdicts] == [True, *[False] * 5]
    assert [str(verdict.cause or "") for verdict in found.verdicts] == [
        "",
        "unparsable",
        "hallucinated_skill",
        "missing_step",
        "hallucinated_object",
        "goal_not_met",
    ]


def test_equal_plans_of_a_task_are_executed_once(bench):
    answers = [
        Answer(APPLE, at, text)
        for at, text in enumerate(
            ["move 10", "move 10\n", '[{"action": "move", "object_index": 10}]', "move 0"]
        )
    ]
    found, executor = judged(bench, answers)
    assert executor.executed == 2
    assert len(found.verdicts) == 4


def test_process_pool_gives_the_same_outcomes_as_one_process(bench):
    answers = asked(bench, BaselineName.RANDOM, 2)
    here, _ = judged(bench, answers)
    assert judge_answers(bench, setup_of(bench), RolloutPool(bench.folder, 2), answers) == here


def test_report_from_stored_answers_is_bit_identical(bench, tmp_path):
    setup = setup_of(bench, codec="json")
    with AnswerSheet(tmp_path / "answers.jsonl", setup) as sheet:
        written(bench, BaselineName.RANDOM)(questions(bench), sheet, lambda *_: None)
        first = report(bench, sheet.ordered(bench.tasks), setup)
    kept, answers = read_answers(tmp_path / "answers.jsonl")
    again = report(
        bench,
        [answers[key] for key in sorted(answers, key=lambda key: (list(bench.tasks).index(key[0]), key[1]))],
        kept,
    )
    assert json.dumps(again[0]) == json.dumps(first[0])
    assert again[1] == first[1]
    assert text_report(again[0]) == text_report(first[0])


def test_report_does_not_depend_on_the_order_of_answers(bench):
    answers = asked(bench, BaselineName.RANDOM, 2)
    assert report(bench, answers[::-1]) == report(bench, answers)


def test_report_on_other_tasks_is_rejected_as_a_row(bench, tmp_path):
    value, _ = report(bench, asked(bench, BaselineName.ORACLE))
    path = tmp_path / "report.json"
    path.write_text(json.dumps(value))
    row = read_row(path, bench.digest)
    assert "me" in text_report(value, [replace(row, label="another")])
    with pytest.raises(TrainerError, match="reports on other tasks"):
        read_row(path, "sha256:0")
    value["overall"]["success"]["value"] = 10**400
    path.write_text(json.dumps(value))
    with pytest.raises(TrainerError, match="is not an evaluation report"):
        read_row(path, bench.digest)


def test_difference_to_another_report_is_paired_by_task(bench, tmp_path):
    good, _ = report(bench, asked(bench, BaselineName.ORACLE))
    bad, _ = report(bench, asked(bench, BaselineName.RANDOM, 2))
    path = tmp_path / "report.json"
    path.write_text(json.dumps(bad))
    other = read_row(path, bench.digest)
    change = paired_difference(rates_of(bad), rates_of(good))
    cells = difference_row(good, other)
    assert cells[1] == f"{100 * change.value:+.1f} [{100 * change.low:.1f}, {100 * change.high:.1f}]"
    assert change.value == good["overall"]["success"]["value"] - bad["overall"]["success"]["value"] > 0
    text = text_report(good, [other])
    assert "success minus that of others on the same tasks, points" in text
    assert cells[1] in text
    assert "minus that of others" not in text_report(good)
    del bad["verdicts"][0]["samples"][0]["success"]
    path.write_text(json.dumps(bad))
    with pytest.raises(TrainerError, match="is not an evaluation report"):
        read_row(path, bench.digest)


def test_lost_plans_count_in_no_figure(bench):
    found, _ = judged(bench, asked(bench, BaselineName.ORACLE))
    lost = [replace(found.verdicts[0], sample=7, success=False, lost=True), *found.verdicts]
    board = Scoreboard.of(categories(bench), lost)
    assert board.lost == 1
    assert board.success().interval.value == 1.0


def test_inexpressible_tasks_count_as_failed_in_the_success_over_all(bench):
    found, _ = judged(bench, asked(bench, BaselineName.ORACLE))
    board = Scoreboard.of(categories(bench), found.verdicts, by_rule=4)
    assert board.success().interval.value == 1.0
    assert board.success_over_all().interval.value == 0.5


def test_page_escapes_texts_of_models_and_tasks(bench):
    setup = setup_of(bench, model="<script>alert(1)</script>")
    _, page = report(bench, asked(bench, BaselineName.ORACLE), setup)
    assert "<script" not in page
    assert "<svg" in page


def test_each_figure_of_an_exam_has_its_own_line_on_the_page(bench):
    value, _ = report(bench, asked(bench, BaselineName.ORACLE))
    half = {"value": 0.5, "low": 0.4, "high": 0.6}
    page = evaluation_page({**value, "others": {"exact": half, "executed": half}}, ())
    assert (
        "<section class='lines'>exact, %: 50.0 [40.0, 60.0]\nexecuted, %: 50.0 [40.0, 60.0]</section>" in page
    )
    assert ".lines { white-space: pre-line; }" in page


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda text: text.replace('"answers": 1', '"answers": 99'), "has another version"),
        (lambda text: text.replace('"sample": 0', '"sample": "x"'), "line 2, is damaged: found sample 'x'"),
        (lambda text: "", "contains no answers"),
        (lambda text: "{}\n" + text, "is not an answer file"),
        (lambda text: text.replace('"samples": 2', '"samples": 1000000000'), "found samples 1000000000"),
        (
            lambda text: text.replace('"seed": 0', '"seed": -1'),
            "found seed -1, expected: Input should be greater",
        ),
        (lambda text: text.replace('"temperature": 1.0', '"temperature": NaN'), "found temperature nan"),
        (
            lambda text: text.replace('"codec": "lines"', '"codec": "verse"'),
            "found codec 'verse', expected: String should match pattern .*eai",
        ),
        (lambda text: text + "[" * 100_000 + "\n", "line 3, is damaged"),
        (lambda text: text + "nonsense\n", "is damaged"),
    ],
)
def test_damaged_answer_files_are_rejected(bench, tmp_path, damage, words):
    path = tmp_path / "answers.jsonl"
    with AnswerSheet(path, setup_of(bench)) as sheet:
        sheet.add([Answer(APPLE, 0, "move 1")])
    path.write_text(damage(path.read_text()))
    with pytest.raises(TrainerError, match=words):
        read_answers(path)


def test_answer_file_of_other_questions_is_rejected(bench, tmp_path):
    path = tmp_path / "answers.jsonl"
    with AnswerSheet(path, setup_of(bench)) as sheet:
        sheet.add([Answer(APPLE, 0, "move 1")])
    with (
        pytest.raises(TrainerError, match=r"temperature 1\.0, now 0\.5"),
        AnswerSheet(path, setup_of(bench, temperature=0.5)),
    ):
        pass


def test_truncated_line_is_asked_again(bench, tmp_path):
    path = tmp_path / "answers.jsonl"
    with AnswerSheet(path, setup_of(bench)) as sheet:
        sheet.add([Answer(APPLE, 0, "move 1"), Answer(APPLE, 1, "móve \ud800 2")])
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])
    with AnswerSheet(path, setup_of(bench)) as sheet:
        assert (APPLE, 0) in sheet
        assert (APPLE, 1) not in sheet
        sheet.add([Answer(APPLE, 1, "móve \ud800 2")])
    assert path.read_bytes() == whole


def endpoint_asker(url, tmp_path, attempts=1):
    limits = EndpointLimits(attempts=attempts, first_wait_s=0.01, concurrent=3)
    return functools.partial(
        ask_endpoint, lambda: Endpoint(url, "scripted", limits=limits), tmp_path / "ledger.jsonl"
    )


def test_endpoint_is_asked_once_per_sample_and_usage_is_recorded(bench, tmp_path):
    server = ChatServer("move 10")
    with server.serving() as url, AnswerSheet(tmp_path / "answers.jsonl", setup_of(bench)) as sheet:
        endpoint_asker(url, tmp_path)(questions(bench), sheet, lambda *_: None)
        endpoint_asker(url, tmp_path)(questions(bench), sheet, lambda *_: None)
        assert len(sheet) == len(server.requests) == 2 * len(bench.records)
    assert server.most_at_once <= 3
    assert len({request["seed"] for request in server.requests}) == len(server.requests)
    assert len((tmp_path / "ledger.jsonl").read_text().splitlines()) == len(server.requests)


def test_failing_endpoint_loses_no_earlier_answer(bench, tmp_path):
    good = (200, {}, json.dumps(completion("move 10")), 0.0)
    server = ChatServer(good, good, good, (500, {}, "out of order", 0.0))
    path = tmp_path / "answers.jsonl"
    with server.serving() as url, AnswerSheet(path, setup_of(bench)) as sheet:
        with pytest.raises(TrainerError, match=r"answered 500.*; [123] of 8 answers are kept in"):
            endpoint_asker(url, tmp_path)(questions(bench), sheet, lambda *_: None)
        kept = len(sheet)
    again = ChatServer("move 10")
    with again.serving() as url, AnswerSheet(path, setup_of(bench)) as sheet:
        endpoint_asker(url, tmp_path)(questions(bench), sheet, lambda *_: None)
        assert len(sheet) == 8
    assert len(again.requests) == 8 - kept


def test_questions_digest_depends_on_the_prompts(bench):
    digests = {questions_digest(questions(bench, codec, rows)) for codec in Codec for rows in (5, 60)}
    assert len(digests) == 6


def test_task_without_a_bundle_is_rejected(bench, tmp_path):
    path = tmp_path / "tasks.json"
    path.write_bytes((bench.folder / "tasks.jsonl").read_bytes())
    with pytest.raises(TrainerError, match="is in the unknown scene 'flat_kitchen'"):
        find_benchmark(str(path))


@pytest.mark.parametrize(
    ("named", "split", "words"),
    [
        ("nowhere", "", "no benchmark at nowhere: pass a dataset folder"),
        ("KITCHEN", "test", "no tasks in the split 'test': it has heldout, train"),
    ],
)
def test_missing_benchmark_is_reported(bench, named, split, words):
    with pytest.raises(TrainerError, match=words):
        find_benchmark(named.replace("KITCHEN", str(bench.folder)), split)


def test_held_out_tasks_are_the_default_split(bench):
    assert find_benchmark(str(bench.folder)).split == "heldout"
    assert find_benchmark(str(bench.folder), "all", 2).digest != bench.digest


def test_rejected_imports_and_goals_beyond_the_profile_fail_by_rule(bench, tmp_path):
    folder = write_kitchen_dataset(tmp_path)
    lines = [json.loads(line) for line in (folder / "tasks.jsonl").read_text().splitlines()]
    lines[0]["task"]["profile"] = "household"
    (folder / "tasks.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    outcomes = [{"name": "mopping", "reason": "inexpressible"}, {"name": "tidy_up", "reason": ""}]
    (folder / "import.json").write_text(json.dumps({"outcomes": outcomes}))
    paper, household = (find_benchmark(str(folder), "all", profile=profile) for profile in Profile)
    assert (len(paper.records), paper.failed_by_rule) == (3, {"mopping", lines[0]["task"]["task_id"]})
    assert (len(household.records), household.failed_by_rule) == (4, {"mopping"})
    (folder / "import.json").write_text("[]")
    with pytest.raises(TrainerError, match="is not an import report"):
        find_benchmark(str(folder), "all")
