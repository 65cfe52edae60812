"""Gateway: executed and unparsable plans, lost rollouts, uploads, shutdown."""

import contextlib
import math
import time

import pytest
from tests.fakes.symbolic_household import SymbolicCluster, make_tasks

from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.reward.settings import RewardSettings
from embomatrix.rpc.status import DeadlineError, ManagerUnreachableError, UnavailableError
from embomatrix.rpc.traffic import TrafficError, TrafficLog, read_traffic
from embomatrix.rpc.wire.values import Cancelled, InfraCode, InfraFailure, RunTerms
from embomatrix.skills.prompt import Codec, plan_in_names
from embomatrix.skills.seeds import evaluation_seed, training_seed
from embomatrix.trainer.cluster.gateway import (
    Gateway,
    PlanGroup,
    PlanOutcome,
    refuse_without_workers,
    result_of,
)
from embomatrix.trainer.config.errors import TrainerError

TASKS = make_tasks(6, 2)
TASK = TASKS.train[0]
ORACLE = plan_in_names(TASK.oracle, TASK.situation)


def gateway(cluster, **options):
    return Gateway(lambda: cluster, TASKS.bundle_bytes, run_name="test", **options)


def outcomes(cluster, *texts, **options):
    with gateway(cluster, **options) as gate:
        return result_of(submit(gate, "b", texts))


def submit(gate, batch_id, texts):
    (future,) = gate.submit(batch_id, 1, [PlanGroup(TASK, TASK.situation, texts, 5)], Codec.NAMES)
    return future


def until(condition, seconds=10.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_outcomes_keep_the_order_of_the_texts():
    wrong, right = outcomes(SymbolicCluster(TASKS), "toggle_on countertop", ORACLE)
    assert right.success
    assert right.value > 30
    assert not wrong.success
    assert wrong.value == 0.5


def test_unparsable_text_is_scored_locally_and_never_executed():
    cluster = SymbolicCluster(TASKS)
    (verdict,) = outcomes(cluster, "no idea")
    assert verdict.value == -1
    assert verdict.problem
    assert cluster.executed == 0
    assert cluster.batches == []


def test_reward_coefficients_apply_to_executed_and_unparsable_plans():
    terms = RunTerms(reward=RewardSettings(unparsable=-7.0, format=2.0))
    cluster = SymbolicCluster(TASKS)
    none, failed = outcomes(cluster, "no idea", "toggle_on countertop", terms=terms)
    assert cluster.terms == terms
    assert (none.value, failed.value) == (-7.0, 2.0)


ABSENT = "no worker took work for 60 s, none is there: start one with `embomatrix worker run`"


def lost(code):
    return PlanOutcome(ORACLE, None, InfraFailure(code, ABSENT))


def test_work_that_no_worker_took_is_refused_with_the_remedies():
    cancelled = PlanOutcome(ORACLE, None, Cancelled())
    unparsable = PlanOutcome("no idea", RewardBreakdown(-1.0, 0.0, 0.0, (), success=False), problem="no plan")
    with pytest.raises(TrainerError) as raised:
        refuse_without_workers([unparsable, cancelled, lost(InfraCode.NO_CAPACITY)], "step 7")
    assert str(raised.value).startswith(f"none of the 2 rollouts of step 7 has a result: {ABSENT}")
    assert "--resume" in str(raised.value)


def test_work_with_a_result_or_another_loss_is_accepted():
    (kept,) = outcomes(SymbolicCluster(TASKS), ORACLE)
    refuse_without_workers([kept, lost(InfraCode.NO_CAPACITY)], "step 7")
    refuse_without_workers([lost(InfraCode.SCENE_LOAD_FAILED)], "step 7")
    refuse_without_workers([], "step 7")


def test_lost_rollout_has_no_reward():
    lost, kept = outcomes(SymbolicCluster(TASKS, lost=frozenset({"b/0/0"})), ORACLE, ORACLE)
    assert lost.reward is None
    assert math.isnan(lost.value)
    assert kept.success


def test_bundle_is_uploaded_once_before_its_first_rollout():
    cluster = SymbolicCluster(TASKS)
    with gateway(cluster) as gate:
        gate.announce({1: TASKS.train[:2], 2: TASKS.train[2:4]}, 8)
        futures = [submit(gate, f"b{at}", [ORACLE]) for at in range(3)]
        assert all(result_of(future)[0].success for future in futures)
        until(lambda: cluster.announced)
    assert cluster.sent == {task.bundle_digest for task in (*TASKS.train[:4], TASK)}
    assert cluster.announced == [(1, [1, 1, 2, 2])]


class Away(SymbolicCluster):
    """Cluster that rejects the first three uploads."""

    refused = 0

    async def put_bundles(self, bundles):
        if self.refused < 3:
            self.refused += 1
            raise (UnavailableError, DeadlineError)[self.refused % 2]("the manager is away")
        return await super().put_bundles(bundles)


def test_bundle_upload_retries_until_the_manager_is_back():
    cluster = Away(TASKS)
    (found,) = outcomes(cluster, ORACLE)
    assert found.success
    assert (cluster.refused, cluster.sent) == (3, {TASK.bundle_digest})


def test_exit_does_not_wait_for_an_unreachable_manager():
    cluster = Away(TASKS)
    cluster.refused = -1_000_000
    with gateway(cluster) as gate:
        submit(gate, "b", [ORACLE])
        until(lambda: cluster.refused > -1_000_000)
    assert cluster.closed
    assert cluster.sent == set()


def test_exit_closes_the_run_with_pending_work():
    cluster = SymbolicCluster(TASKS, delay_s=60)
    with gateway(cluster) as gate:
        submit(gate, "b", [ORACLE])
    assert cluster.closed


class Unreachable(SymbolicCluster):
    async def open_run(self, name, run_id="", terms=None):
        raise ManagerUnreachableError("no manager answers at nowhere:1: start one, or pass --manager")


def test_unreachable_manager_gives_a_one_sentence_error():
    with pytest.raises(TrainerError, match=r"no manager answers at nowhere:1"), gateway(Unreachable(TASKS)):
        pass


def test_training_and_evaluation_use_different_seeds():
    trained = {training_seed(0, "a"), training_seed(0, "b"), training_seed(1, "a"), training_seed(0, "a", 1)}
    evaluated = {evaluation_seed(0, "a"), evaluation_seed(0, "b"), evaluation_seed(1, "a")}
    assert (len(trained), len(evaluated)) == (4, 3)
    assert all(0 <= seed < 2**31 for seed in evaluated)
    assert all(2**31 <= seed < 2**32 for seed in trained)
    assert training_seed(0, "a") == training_seed(0, "a", 0)


def test_groups_of_one_batch_have_their_own_outcomes():
    cluster = SymbolicCluster(TASKS, lost=frozenset({"b/1/"}))
    tasks = TASKS.train[:3]
    groups = [
        PlanGroup(task, task.situation, [plan_in_names(task.oracle, task.situation), "no idea"], 5)
        for task in tasks
    ]
    with gateway(cluster) as gate:
        found = [result_of(future) for future in gate.submit("b", 1, groups, Codec.NAMES)]
    assert cluster.batches == ["b"]
    assert [outcomes[0].success for outcomes in found] == [True, False, True]
    assert found[1][0].lost
    assert all(outcomes[1].value == -1 for outcomes in found)


def test_submitted_batches_can_be_recorded_and_read_back(tmp_path):
    log = TrafficLog(tmp_path / "traffic.jsonl")
    with contextlib.closing(log), gateway(SymbolicCluster(TASKS), on_submit=log.append) as gate:
        result_of(submit(gate, "b", [ORACLE, ORACLE, "toggle_on countertop"]))
        result_of(submit(gate, "c", ["no idea"]))
    (group,) = read_traffic((tmp_path / "traffic.jsonl").read_bytes().splitlines())
    assert (group.group_id, group.seed, group.members) == ("b/0", 5, (0, 0, 1))
    assert [rollout.plan for rollout in group.rollouts()][:2] == [TASK.oracle, TASK.oracle]


def test_damaged_record_names_its_line():
    with pytest.raises(TrafficError, match="line 1 of the traffic"):
        list(read_traffic([b'{"step": 1}']))
