"""Training curves in bounded memory."""

from hypothesis import given
from hypothesis import strategies as st

from embomatrix.manager.observe.training_reports import (
    PHASES_KEPT,
    RUNS_KEPT,
    STEPS_KEPT,
    Curves,
    TrainingBook,
)
from embomatrix.rpc.wire.training import FIGURES, SampledPlan, TrainingReport

PLAN = SampledPlan("task-1", "tidy up", "move 3", None, 0.0)


def curves_of(book, run_id="r1"):
    return {curves.phase: curves for curves in book.find(run_id).phases}


def test_repeated_step_merges_its_figures():
    book = TrainingBook()
    book.note("r1", "evening", TrainingReport("grpo", 1, {"reward": 1.5}), at_s=1.0)
    book.note("r1", "evening", TrainingReport("grpo", 2, {"reward": 2.0}), at_s=2.0)
    book.note("r1", "evening", TrainingReport("grpo", 2, {"spent_s/sampling": 7.0}, (PLAN,)), at_s=3.0)
    curves = curves_of(book)["grpo"]
    assert curves.steps == [1, 2]
    assert curves.figures == {"reward": [1.5, 2.0], "spent_s/sampling": [None, 7.0]}
    detail = book.find("r1")
    assert (detail.plans, detail.plans_step) == ([PLAN], 2)
    assert (detail.run.name, detail.run.step, detail.run.reported_s, detail.run.revision) == (
        "evening",
        2,
        3.0,
        3,
    )


def test_lower_step_discards_later_ones():
    book = TrainingBook()
    for step in (1, 2, 3, 2):
        book.note("r1", "", TrainingReport("grpo", step, {"reward": float(step)}), at_s=0.0)
    assert curves_of(book)["grpo"] == Curves("grpo", [1, 2], {"reward": [1.0, 2.0]})


def test_long_run_keeps_its_first_and_its_last_step():
    book = TrainingBook()
    for step in range(1, 5 * STEPS_KEPT):
        book.note("r1", "", TrainingReport("grpo", step, {"reward": float(step)}), at_s=0.0)
    curves = curves_of(book)["grpo"]
    assert len(curves.steps) <= STEPS_KEPT
    assert (curves.steps[0] < 32, curves.steps[-1]) == (True, 5 * STEPS_KEPT - 1)
    assert curves.figures["reward"] == [float(step) for step in curves.steps]


def test_longest_silent_run_is_dropped():
    book = TrainingBook()
    for number in range(RUNS_KEPT):
        book.note(f"r{number}", "", TrainingReport("grpo", 1, {"reward": 0.0}), at_s=0.0)
    book.note("r0", "", TrainingReport("grpo", 2, {"reward": 0.0}), at_s=1.0)
    book.note("new", "", TrainingReport("grpo", 1, {"reward": 0.0}), at_s=2.0)
    assert [view.run_id for view in book.views()][:2] == ["new", "r0"]
    assert len(book.views()) == RUNS_KEPT
    assert book.find("r1") is None


reports = st.builds(
    TrainingReport,
    phase=st.sampled_from([f"phase-{number}" for number in range(PHASES_KEPT + 2)]),
    step=st.integers(0, 40),
    figures=st.dictionaries(st.integers(0, 2 * FIGURES).map(str), st.floats(-1, 1), max_size=8),
)


@given(st.lists(reports, max_size=120))
def test_columns_are_as_long_as_steps_for_any_reports(sent):
    book = TrainingBook()
    for report in sent:
        book.note("r1", "", report, at_s=0.0)
    phases = curves_of(book).values() if sent else []
    assert len(phases) <= PHASES_KEPT
    for curves in phases:
        assert curves.steps == sorted(set(curves.steps))
        assert len(curves.figures) <= FIGURES
        assert {len(column) for column in curves.figures.values()} <= {len(curves.steps)}
