"""Evaluation in episodes: played call by call, kept at once, and judged again from the answers alone."""

import functools
import json
from dataclasses import replace

import pytest
from tests.fakes.chat_server import ChatServer, completion
from tests.fakes.datasets import write_kitchen_dataset
from tests.integration.cli.test_evaluate import run_evaluation

from embomatrix.envs.turns import LocalSimulation
from embomatrix.llm.endpoint import Endpoint, EndpointLimits
from embomatrix.scripts.searching import PlacePriors
from embomatrix.skills.parse import parse_plan
from embomatrix.skills.prompt import Codec
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import read_settings
from embomatrix.trainer.data.tasks import load_tasks
from embomatrix.trainer.evaluation.answers import Answer, AnswerSheet, EvaluationSetup
from embomatrix.trainer.evaluation.benchmark import find_benchmark
from embomatrix.trainer.evaluation.episodes import (
    EpisodeExam,
    EpisodeRunner,
    SearchingAgent,
    ask_endpoint_in_episodes,
    play_episodes,
)
from embomatrix.trainer.evaluation.page import evaluation_page
from embomatrix.trainer.evaluation.policy_agent import converse_in_episodes
from embomatrix.trainer.evaluation.replanning import ReplanningAgent, WrittenPlan
from embomatrix.trainer.evaluation.table import report_of, text_report
from embomatrix.trainer.evaluation.taxonomy import Cause
from embomatrix.trainer.lifecycle.checkpoint import CHECKPOINTS, CheckpointStore, TrainingProgress
from embomatrix.trainer.policy.decoder import DecoderShape
from embomatrix.trainer.policy.loading import new_policy, word_level_shape
from embomatrix.trainer.policy.tiny import TinyPolicy
from embomatrix.trainer.policy.vocabulary import END

APPLE = "apple_to_counter"
SOLVED = ("move 10", "pick_up 10", "move 0", "place 0 ontop", "done")


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    return find_benchmark(str(write_kitchen_dataset(tmp_path_factory.mktemp("kitchen"))), "all")


@pytest.fixture
def apple(bench):
    """Benchmark of one task."""
    return replace(bench, records=tuple(record for record in bench.records if record.task.task_id == APPLE))


def setup_of(bench, visibility="full", samples=1, calls_factor=2.0, calls_more=12):
    return EvaluationSetup(
        bench.name,
        bench.digest,
        bench.split,
        len(bench.records),
        "me",
        "lines",
        60,
        samples,
        1.0,
        64,
        0,
        visibility=visibility,
        calls_factor=calls_factor,
        calls_more=calls_more,
    )


def exam_of(bench):
    return EpisodeExam(bench, EpisodeRunner(bench, functools.partial(LocalSimulation, bench.dataset)))


def judged(bench, answers, setup):
    result = exam_of(bench).judge(setup, answers, lambda *_: None)
    value = report_of(setup, result)
    return value, evaluation_page(value, result.pictures)


class Talker(ChatServer):
    """Model that says the next of its lines, however often it is asked.

    It fails after ``most`` answers, and its context has room for ``room`` answers of a conversation.
    """

    def __init__(self, lines, most=99, room=99):
        super().__init__("")
        self.lines = lines
        self.most = most
        self.room = room

    def next_answer(self, request):
        self.requests.append(request)
        if len(self.requests) > self.most:
            return (500, {}, "out of order", 0.0)
        if len(request["messages"]) >= 2 * (self.room + 1):
            return (400, {}, "maximum context length is 64 tokens", 0.0)
        turn = sum(message["role"] == "assistant" for message in request["messages"])
        return (200, {}, json.dumps(completion(self.lines[turn])), 0.0)


def ask(server, exam, folder, setup):
    limits = EndpointLimits(attempts=1, first_wait_s=0.01, concurrent=3)
    path = folder / "answers.jsonl"
    with server.serving() as url, AnswerSheet(path, setup) as sheet:
        ask_endpoint_in_episodes(
            lambda: Endpoint(url, "scripted", limits=limits),
            folder,
            exam.stage,
            exam.questions(Codec.LINES, 60),
            sheet,
            lambda *_: None,
        )
        return sheet.ordered(exam.task_ids)


def test_model_is_told_what_happened_after_each_answer(apple, tmp_path):
    server, setup = Talker(SOLVED), setup_of(apple)
    answers = ask(server, exam_of(apple), tmp_path, setup)
    last = server.requests[-1]["messages"]
    assert [message["role"] for message in last] == ["system", *["user", "assistant"] * 4, "user"]
    assert "step by step" in last[0]["content"]
    assert "Task: " in last[1]["content"]
    assert last[-1]["content"].startswith("place 0 ontop: put apple 10 on top of countertop 0\n")
    assert (len(server.requests), answers[0].completion_tokens) == (5, 10)
    value, page = judged(apple, answers, setup)
    assert value["overall"]["success"]["value"] == 1.0
    assert "in episodes of at most 2 times the oracle's calls and 12 (visibility full)" in text_report(value)
    assert (value, page) == judged(apple, answers, setup)


def test_no_answer_is_bought_twice(apple, tmp_path):
    failing, setup = Talker(SOLVED, most=2), setup_of(apple)
    with pytest.raises(TrainerError, match=r"answered 500.*; 0 of 1 episodes are kept in .*the same command"):
        ask(failing, exam_of(apple), tmp_path, setup)
    with (tmp_path / "turns.jsonl").open("ab") as file:
        file.write(b'{"question": "cut off')
    again = Talker(SOLVED)
    answers = ask(again, exam_of(apple), tmp_path, setup)
    assert len(again.requests) == 3
    assert judged(apple, answers, setup)[0]["overall"]["success"]["value"] == 1.0


def test_conversation_that_outgrows_the_context_ends_its_episode_alone(bench, tmp_path):
    server, setup = Talker(("move 0", "move 1", "move 0", "move 1"), room=3), setup_of(bench)
    answers = ask(server, exam_of(bench), tmp_path, setup)
    assert [len(json.loads(answer.text)) for answer in answers] == [3] * len(bench.records)
    result = exam_of(bench).judge(setup, answers, lambda *_: None)
    assert {verdict.reason for task in result.board.tasks for verdict in task.verdicts} == {"tokens"}


def test_endpoint_that_refuses_the_first_question_is_told(apple, tmp_path):
    with pytest.raises(TrainerError, match="answered 400"):
        ask(Talker(SOLVED, room=0), exam_of(apple), tmp_path, setup_of(apple))


def test_searching_oracle_finds_what_it_does_not_see(bench, tmp_path):
    setup, exam = setup_of(bench, "seen"), exam_of(bench)
    priors = PlacePriors(task.situation for task in bench.tasks.values())
    with AnswerSheet(tmp_path / "answers.jsonl", setup) as sheet:
        play_episodes(
            exam.stage,
            lambda task_id, sample: SearchingAgent(bench.tasks[task_id], priors),
            exam.questions(Codec.LINES, 60),
            sheet,
            lambda *_: None,
        )
        answers = sheet.ordered(exam.task_ids)
    value, _ = judged(bench, answers, setup)
    assert value["overall"]["success"]["value"] == 1.0
    spoken = [text for answer in answers for text in json.loads(answer.text)]
    assert any(text.startswith(("go_to_room", "open")) for text in spoken)


@pytest.mark.parametrize(
    ("texts", "cause", "reason"),
    [
        (["move 10", "done"], Cause.GOAL_NOT_MET, "done"),
        (["pick_up 10"] * 4, Cause.MISSING_STEP, "out_of_reach"),
        (["move 99", "done"], Cause.HALLUCINATED_OBJECT, "unknown_index"),
        (["hm", "hm", "hm", "hm"], Cause.UNPARSABLE, "loop"),
        (["move 10", "move 0"] * 20, Cause.GOAL_NOT_MET, "calls"),
        ([], Cause.UNPARSABLE, "tokens"),
    ],
)
def test_end_of_an_episode_decides_its_cause(apple, texts, cause, reason):
    setup = setup_of(apple)
    value, _ = judged(apple, [Answer(APPLE, 0, json.dumps(texts))], setup)
    [task] = value["verdicts"]
    [sample] = task["samples"]
    assert (sample["cause"], sample["reason"]) == (cause, reason)


@pytest.mark.parametrize("text", ["move 10", "{}", "[1]"])
def test_answers_of_plans_are_no_episodes(apple, text):
    with pytest.raises(TrainerError, match="is no list of texts: expected the answers of an episode"):
        judged(apple, [Answer(APPLE, 0, text)], setup_of(apple))


def plans_of(task, *texts):
    """Return a writer of these plans, None for a text without one, and the list of what it is asked with."""
    plans, asked = iter(texts), []

    def write(situation, number):
        asked.append(situation)
        text = next(plans)
        return WrittenPlan(None if text is None else parse_plan(text), 5)

    return write, asked


def replanned(apple, folder, setup, *texts):
    write, asked = plans_of(apple.tasks[APPLE], *texts)
    exam = exam_of(apple)
    with AnswerSheet(folder / "answers.jsonl", setup) as sheet:
        play_episodes(
            exam.stage,
            lambda *_: ReplanningAgent(write),
            exam.questions(Codec.LINES, 60),
            sheet,
            lambda *_: None,
        )
        return sheet.ordered(exam.task_ids), asked


def test_policy_writes_another_plan_after_a_failed_call(apple, tmp_path):
    setup = setup_of(apple)
    plans = ("move 10\npick_up 10\nplace 0 ontop\nmove 0", "move 0\nplace 0 ontop")
    answers, asked = replanned(apple, tmp_path, setup, *plans)
    assert len(asked) == 2
    assert asked[1].held == ("apple_1",), "the second plan begins in the state reached"
    assert json.loads(answers[0].text) == [
        *("move 10", "pick_up 10", "place 0 ontop", "move 0", "place 0 ontop", "done")
    ]
    assert answers[0].completion_tokens == 10
    assert judged(apple, answers, setup)[0]["overall"]["success"]["value"] == 1.0


def test_text_without_a_plan_counts_as_a_failed_call_and_another_plan_follows(apple, tmp_path):
    answers, asked = replanned(apple, tmp_path, setup_of(apple), None, "move 10", None)
    assert json.loads(answers[0].text) == ["no plan", "move 10", "done"]
    assert len(asked) == 2


def test_policy_writes_another_plan_when_the_robot_has_seen_something_new(apple, tmp_path):
    setup = setup_of(apple, visibility="seen")
    plans = ("go_to_room living_room_0\nturn 1", "turn 1\nturn 1", "turn 1")
    answers, asked = replanned(apple, tmp_path, setup, *plans)
    assert len(asked) == 2
    assert len(asked[1].rows) > len(asked[0].rows)
    assert json.loads(answers[0].text) == ["go_to_room living_room_0", "turn 1.0", "turn 1.0", "done"]


def write_run(folder, bench, **changes):
    """Write a run of a small policy that has learnt nothing."""
    tasks = load_tasks(bench.folder)
    shape = {"tiny.layers": 1, "tiny.width": 16, "tiny.heads": 2, "tiny.inner": 16}
    settings = read_settings(None, {**shape, **changes})
    progress = TrainingProgress(step=1, grpo_ready=True)
    CheckpointStore(folder / CHECKPOINTS, keep=1).save(new_policy(settings, tasks), {}, progress, settings)


def test_command_plays_with_a_policy_for_episodes_and_judges_it_again(bench, tmp_path):
    write_run(tmp_path / "run", bench, **{"episodes.visibility": "seen"})
    where = (f"--bench={bench.folder}", f"--out={tmp_path / 'out'}")
    playing = (f"--model={tmp_path / 'run'}", "--interactive", "--visibility=seen", "--samples=3")
    code, printed = run_evaluation(*where, *playing)
    assert code == 0, printed
    answers = [json.loads(line) for line in (tmp_path / "out" / "answers.jsonl").read_text().splitlines()]
    said = [text for each in answers if "text" in each for text in json.loads(each["text"])]
    assert len({len(json.loads(each["text"])) for each in answers if "text" in each}) > 1
    assert all("\n" not in text for text in said)
    before = (tmp_path / "out" / "report.json").read_bytes()
    again = f"--answers={tmp_path / 'out' / 'answers.jsonl'}"
    assert run_evaluation(again, f"--bench={bench.folder}")[0] == 0
    assert (tmp_path / "out" / "report.json").read_bytes() == before
    code, printed = run_evaluation(*where, f"--model={tmp_path / 'run'}")
    assert (code, "was trained in episodes and writes no plans: pass --interactive" in printed) == (2, True)


def test_a_policy_without_room_for_another_answer_ends_its_episode(apple, tmp_path):
    tasks = load_tasks(apple.folder)
    settings = read_settings(None, {"tiny.layers": 1, "tiny.width": 16, "tiny.heads": 2, "tiny.inner": 16})
    vocabulary = word_level_shape(settings, tasks)[0]
    shape = DecoderShape(len(vocabulary), 1, 16, 2, 16, longest=200)
    policy = TinyPolicy(vocabulary, shape, seed=1, single_calls=True)
    policy.grammar._fixed[0, END] = False  # it never says that it is done
    setup = replace(setup_of(apple, calls_factor=9.0, calls_more=64), codec="names")
    exam = exam_of(apple)
    with AnswerSheet(tmp_path / "answers.jsonl", setup) as sheet:
        converse_in_episodes(policy, exam.stage, exam.questions(Codec.NAMES, 60), sheet, lambda *_: None)
        answers = sheet.ordered(exam.task_ids)
    (task,) = exam.judge(setup, answers, lambda *_: None).board.tasks
    (verdict,) = task.verdicts
    assert 2 < verdict.steps < 64
    assert verdict.reason == "unfinished" or verdict.step == verdict.steps
    assert len(json.loads(answers[0].text)) == verdict.steps


def test_command_plays_episodes_with_a_policy_and_repeats_them(bench, tmp_path):
    write_run(tmp_path / "run", bench)
    common = (
        f"--model={tmp_path / 'run'}",
        "--interactive",
        "--samples=1",
        "--temperature=0",
        "--max-tokens=12",
    )
    sheets = []
    for name in ("a", "b"):
        code, printed = run_evaluation(f"--bench={bench.folder}", *common, f"--out={tmp_path / name}")
        assert code == 0, printed
        sheets.append((tmp_path / name / "answers.jsonl").read_bytes())
    assert sheets[0] == sheets[1]


def test_command_plays_episodes_and_judges_them_again(bench, tmp_path):
    common = (f"--bench={bench.folder}", "--split=all", f"--out={tmp_path}", "--samples=1")
    code, printed = run_evaluation("--baseline=oracle", "--interactive", "--visibility=seen", *common)
    assert (code, "(visibility seen)" in printed) == (0, True)
    before = (tmp_path / "report.json").read_bytes()
    assert run_evaluation(f"--answers={tmp_path / 'answers.jsonl'}", f"--bench={bench.folder}")[0] == 0
    assert (tmp_path / "report.json").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--model=runs/a", "--bench=eai-native"), "eai-native judges whole plans: leave out --interactive"),
        (("--baseline=template",), "the baseline `template` writes whole plans: leave out --interactive"),
        (("--baseline=human",), "the human plans are of eai-native: pass --baseline oracle"),
        (("--baseline=oracle", "--calls-factor=0"), "calls_factor"),
        (("--baseline=oracle", "--visibility=half"), "Invalid value for '--visibility'"),
    ],
)
def test_command_refuses_what_plays_no_episodes(bench, tmp_path, arguments, words):
    code, printed = run_evaluation(
        f"--bench={bench.folder}", *arguments, "--interactive", f"--out={tmp_path / 'out'}"
    )
    assert (code, words in printed) == (2, True), printed


def test_plans_show_the_whole_table(bench):
    code, printed = run_evaluation("--baseline=oracle", "--visibility=seen", f"--bench={bench.folder}")
    assert (code, "--visibility seen is for episodes: pass --interactive" in printed) == (2, True)
