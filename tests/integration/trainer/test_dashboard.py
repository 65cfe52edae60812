"""Training reports to the manager: figures of every step, plans of a group, and no waiting."""

import math

from tests.fakes.symbolic_household import SymbolicCluster
from tests.integration.trainer.test_loop import TASKS, run
from tests.unit.trainer.test_gateway import outcomes

from embomatrix.rpc.status import PreconditionError, UnavailableError
from embomatrix.rpc.wire.training import TrainingReport
from embomatrix.trainer.cluster.gateway import MAX_QUEUED_REPORTS, Gateway
from embomatrix.trainer.grpo.records import GroupLog
from embomatrix.trainer.logging.dashboard import PLANS_SHOWN, DashboardReporter

ORACLE_TASK = TASKS.train[0]


class AwayCluster(SymbolicCluster):
    """Cluster that rejects reports until it is back."""

    error = UnavailableError("away")

    async def report_training(self, run_id, report):
        if self.error:
            raise self.error
        await super().report_training(run_id, report)


def test_run_reports_both_phases_time_by_activity_and_plans(tmp_path):
    cluster = SymbolicCluster(TASKS)
    short = {"imitation__steps": 2, "grpo__steps": 2, "grpo__tasks_per_step": 2, "grpo__max_new": 8}
    run(tmp_path, cluster, **short, evaluation__samples=1)
    grpo = [report for report in cluster.reports if report.phase == "grpo"]
    assert sorted({report.step for report in grpo}) == [1, 2]
    figures = {name for report in grpo for name in report.figures}
    assert {
        "reward_goal",
        "entropy",
        "zero_variance_groups",
        "plan_steps",
        "seconds",
        "spent_s/sampling",
    } <= figures
    assert any(name.startswith("success_by_category/") for name in figures)
    assert all(math.isfinite(value) for report in grpo for value in report.figures.values())
    sampled = [report for report in grpo if report.plans]
    assert [report.step for report in sampled] == [1, 2]
    assert all(len(report.plans) == PLANS_SHOWN and report.plans[0].text for report in sampled)
    assert {"imitation", "success after GRPO"} <= {report.phase for report in cluster.reports}


def test_report_shows_best_and_worst_plan_and_a_lost_one_last():
    sent = []
    good, bad = outcomes(SymbolicCluster(TASKS), "toggle_on countertop", "what?")
    lost = good.__class__("move table", None)
    group = GroupLog(ORACLE_TASK, (bad, lost, good), (-1.0, math.nan, 1.0), zero_variance=False, cut_off=0)
    DashboardReporter(sent.append).sampled(4, [group])
    (report,) = sent
    assert (report.step, report.figures) == (4, {})
    assert [plan.text for plan in report.plans] == [good.text, bad.text, lost.text]
    assert report.plans[1].problem
    assert (report.plans[2].reward, report.plans[2].advantage) == (None, 0.0)


def test_non_finite_numbers_are_not_reported():
    sent = []
    DashboardReporter(sent.append).log("grpo", 1, {"reward": 1.0, "kl": math.nan})
    assert sent == [TrainingReport("grpo", 1, {"reward": 1.0})]


def test_latest_reports_are_queued_for_an_unreachable_manager():
    cluster = AwayCluster(TASKS)
    with Gateway(lambda: cluster, TASKS.bundle_bytes, run_name="test") as gateway:
        for step in range(MAX_QUEUED_REPORTS + 10):
            gateway.report(TrainingReport("grpo", step, {"reward": 0.0}))
        assert cluster.reports == []
        cluster.error = None
    assert [report.step for report in cluster.reports] == list(range(10, MAX_QUEUED_REPORTS + 10))


def test_manager_that_rejects_reports_gets_no_more():
    cluster = AwayCluster(TASKS)
    cluster.error = PreconditionError("no such call")
    with Gateway(lambda: cluster, TASKS.bundle_bytes, run_name="test") as gateway:
        gateway.report(TrainingReport("grpo", 1))
        gateway.announce({}, 1)
        gateway.close_run()
        cluster.error = None
    assert cluster.reports == []
