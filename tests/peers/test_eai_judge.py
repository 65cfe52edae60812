"""EAI's published judge, run without iGibson on human plans and on hand-made wrong plans.

The first test creates the judge's virtual environment (27 MB download) unless EMBOMATRIX_EAI names one.
"""

import json

import pytest

from embomatrix.trainer.eai.environment import install
from embomatrix.trainer.eai.exam import NativeExam
from embomatrix.trainer.eai.judge import NativeJudge
from embomatrix.trainer.evaluation.answers import Answer, EvaluationSetup
from embomatrix.trainer.evaluation.taxonomy import Cause

pytestmark = [pytest.mark.eai, pytest.mark.timeout(900)]
FRUIT = "bottling_fruit_0_Wainscott_0_int_0_2021-05-24_19-46-46"
INCOMPARABLE = "rearranging_furniture"
"""The record has four goals for it, the definition three."""


@pytest.fixture(scope="module")
def environment():
    return install()


@pytest.fixture(scope="module")
def judge(environment):
    with NativeJudge(environment) as started:
        yield started


@pytest.fixture(scope="module")
def exam(judge):
    return NativeExam(judge)


def judged(exam, texts):
    """Return the result of an exam with one answer for each of these tasks."""
    setup = EvaluationSetup(exam.name, exam.digest, "all", len(texts), "me", "eai", 60, 1, 0.0, 1, 0)
    answers = [Answer(task_id, 0, text) for task_id, text in texts.items()]
    return exam.judge(setup, answers, lambda *_: None)


def verdict(exam, *steps, text=None):
    """Return the judge's verdict on one plan for the fruit task."""
    plan = text if text is not None else json.dumps([{"action": a, "object": o} for a, o in steps])
    board = judged(exam, {FRUIT: plan}).board
    return next(task for task in board.tasks if task.task_id == FRUIT).verdicts[0]


def test_human_plans_get_the_published_judges_figures(exam):
    result = judged(exam, {task_id: exam.human(task_id) for task_id in exam.task_ids})
    assert len(exam.task_ids) == 100
    assert result.board.success().interval.value == pytest.approx(0.88)
    assert result.others["goal exactly true and executed"].interval.value == pytest.approx(0.90)
    assert result.others["executed to the end"].interval.value == pytest.approx(0.95)
    assert result.board.lost == 0


def test_categories_follow_the_rule(judge):
    counts = {}
    for task in judge.tasks():
        counts[task.category] = counts.get(task.category, 0) + 1
    assert counts == {"pick_and_place": 36, "appliance_use": 9, "kitchen_operation": 16, "compound": 39}


def test_reconstructed_start_agrees_with_the_real_simulators(judge):
    truths = [judge.first_truths(task.demo) for task in judge.tasks() if task.task != INCOMPARABLE]
    pairs = [pair for here, there in truths for pair in zip(here, there, strict=True)]
    assert len(pairs) == 363
    assert sum(here == there for here, there in pairs) == 362


@pytest.mark.parametrize(
    ("steps", "cause"),
    [
        ([("RIGHT_GRASP", "strawberry_0")], Cause.MISSING_STEP),
        ([("OPEN", "fridge_97"), ("CLOSE", "fridge_97"), ("RIGHT_GRASP", "strawberry_0")], Cause.WRONG_ORDER),
        ([("OPEN", "strawberry_0")], Cause.AFFORDANCE),
        ([("OPEN", "fridge_97"), ("OPEN", "fridge_97")], Cause.GOAL_NOT_MET),
        ([("OPEN", "fridge_98")], Cause.HALLUCINATED_OBJECT),
        ([("open", "fridge_97")], Cause.HALLUCINATED_SKILL),
        ([("NAVIGATE_TO", "fridge_97")], Cause.HALLUCINATED_SKILL),
        ([("RIGHT_PLACE_NEXTTO_ONTOP", "fridge_97")], Cause.WRONG_ARGUMENT),
        ([], Cause.UNPARSABLE),
    ],
)
def test_broken_plans_get_the_expected_errors(exam, steps, cause):
    found = verdict(exam, *steps)
    assert not found.success
    assert found.cause is cause


def test_model_text_is_never_executed(exam, tmp_path):
    """The published parser would execute this text if it received it unsanitised."""
    trap = tmp_path / "trap"
    text = f'[__import__("pathlib").Path({str(trap)!r}).touch()]'
    assert verdict(exam, text=text).cause is Cause.UNPARSABLE
    assert not trap.exists()


def test_raw_text_cannot_write_files_or_start_processes_in_the_judge(judge, tmp_path):
    trap = tmp_path / "trap"
    for code in (
        f'__import__("pathlib").Path({str(trap)!r}).write_text("x")',
        f'__import__("os").system("touch {trap}")',
        '__import__("socket").socket()',
    ):
        found = judge._request({"op": "judge", "id": FRUIT, "demo": FRUIT, "text": f"[{code}]"})
        assert found["errors"]["parsing"]
    assert not trap.exists()


def test_crashed_judge_is_restarted(judge):
    assert (
        judge._request({"op": "judge", "id": FRUIT, "demo": FRUIT, "text": '[__import__("os")._exit(1)]'})
        is None
    )
    assert judge.judge(FRUIT, '[{"action": "OPEN", "object": "fridge_97"}]').executed
