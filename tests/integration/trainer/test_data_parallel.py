"""Data-parallel workers: several processes learn bit-identically to one, and a dead one ends the run with a checkpoint."""

import asyncio
import os
import signal

import pytest
import torch
from rich.console import Console
from tests.fakes.symbolic_household import SymbolicCluster
from tests.integration.trainer.test_loop import SEVERAL_UPDATES, TASKS, run, weights

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import read_settings
from embomatrix.trainer.learning.data_parallel import DataParallelWorkers, RemoteLearner, SharedTensors
from embomatrix.trainer.learning.gradient import GradientSum
from embomatrix.trainer.learning.learner import SamplingParams
from embomatrix.trainer.lifecycle.checkpoint import CHECKPOINTS, CheckpointStore, TrainingProgress
from embomatrix.trainer.logging.display import LineDisplay
from embomatrix.trainer.logging.recorder import read_metrics
from embomatrix.trainer.policy.loading import new_policy
from embomatrix.trainer.run.starting import RunStart

FAST = {"imitation__steps": 20, "grpo__steps": 4, "checkpoint_every": 2}


@pytest.fixture
def remotes(monkeypatch):
    """Collect the processes of all data-parallel workers."""
    made = []
    real = DataParallelWorkers.__init__

    def noted(self, local, remotes=()):
        made.extend(remote._process for remote in remotes)
        real(self, local, remotes)

    monkeypatch.setattr(DataParallelWorkers, "__init__", noted)
    return made


def learnt(folder, **changes):
    return weights(run(folder, **FAST, **changes)[1])


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"grpo__chunk": 1, "imitation__chunk": 5},
        {"grpo__chunk": 1, "grpo__reserve": 4, "grpo__overlap": "ahead"},
        {"grpo__chunk": 1, "grpo__updates_per_batch": 2},
        {**SEVERAL_UPDATES, "grpo__reserve": 4, "grpo__overlap": "ahead", "grpo__truncate_ratio": 2.0},
    ],
    ids=["plain", "several microbatches each", "all", "two updates", "two updates of two minibatches"],
)
def test_two_processes_are_bit_identical_to_one(tmp_path, remotes, changes):
    one = learnt(tmp_path / "one", **changes)
    two = learnt(tmp_path / "two", processes=2, **changes)
    assert len(remotes) == 1
    assert torch.equal(one, two)
    results = [
        [{**row, "seconds": 0, "spent_s": {}} for row in read_metrics(tmp_path / name)]
        for name in ("one", "two")
    ]
    assert results[0] == results[1]


def test_more_processes_than_microbatches_are_bit_identical(tmp_path, remotes):
    assert torch.equal(learnt(tmp_path / "one"), learnt(tmp_path / "three", processes=3))
    assert len(remotes) == 2
    assert not any(process.is_alive() for process in remotes)


def test_killed_process_ends_the_run_and_a_resume_gives_the_same_result(tmp_path, remotes):
    whole, _ = run(tmp_path / "whole", **FAST)

    class Killer(LineDisplay):
        def stepped(self, record, share, rollouts_per_s):
            if record.step == 3:
                os.kill(remotes[0].pid, signal.SIGKILL)

    with pytest.raises(TrainerError, match=r"the process trainer-1 ended during a step \(exit code -9"):
        run(tmp_path / "cut", display=Killer(Console(quiet=True)), processes=2, **FAST)
    newest = CheckpointStore(tmp_path / "cut" / CHECKPOINTS, keep=9).latest()
    assert newest.name == "step-000003"
    gone_on, _ = run(tmp_path / "cut", resume=True)
    assert gone_on.after == whole.after


@pytest.fixture
def interruptible():
    """Restore the default SIGINT handler: shells ignore SIGINT in background processes."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_waits_for_neither_rewards_nor_processes(tmp_path, remotes, interruptible):
    class Silent(SymbolicCluster):
        """Cluster that withholds the rewards of GRPO's third step and interrupts the trainer."""

        async def execute(self, batch):
            if batch.batch_id == "step-3-0":
                asyncio.get_running_loop().call_later(0.3, os.kill, os.getpid(), signal.SIGINT)
            if batch.batch_id.startswith("step-3-"):
                await asyncio.Event().wait()
            async for result in super().execute(batch):
                yield result

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, Silent(TASKS), processes=2, **FAST)
    assert not remotes[0].is_alive()
    assert CheckpointStore(tmp_path / CHECKPOINTS, keep=9).latest().name == "step-000002"


def test_a_batch_of_imitation_is_shared_and_its_gradient_is_that_of_the_whole(monkeypatch):
    # In bfloat16, the default on some CPUs, sums of other parts differ in the third digit.
    settings = read_settings(None, {"compute_dtype": "float32"})
    policy = new_policy(settings, TASKS)
    examples = [
        RunStart(settings, TASKS, policy, TrainingProgress("")).prompt_builder.plain_example(task)
        for task in TASKS.train
    ]
    asked = []
    real = RemoteLearner.imitate

    def noted(self, examples, tokens):
        asked.append(len(examples))
        return real(self, examples, tokens)

    monkeypatch.setattr(RemoteLearner, "imitate", noted)

    def gradient(processes, size):
        changed = settings.model_copy(update={"processes": processes})
        with DataParallelWorkers.start(policy, changed) as workers:
            loss = GradientSum(policy, workers).imitate(examples, size)
        return loss, [parameter.grad.clone() for parameter in policy.parameters()]

    whole, one, two = gradient(1, len(examples)), gradient(1, 3), gradient(2, 3)
    assert asked == [3, 1]  # the second and the fourth part of ten examples
    assert two[0] == one[0] == pytest.approx(whole[0], rel=1e-5)
    for shared, alone, undivided in zip(two[1], one[1], whole[1], strict=True):
        assert torch.equal(shared, alone)
        torch.testing.assert_close(shared, undivided, rtol=1e-3, atol=1e-5)


def test_error_in_a_remote_process_is_reported():
    settings = read_settings(None, {"processes": 2})
    policy = new_policy(settings, TASKS)
    rule = SamplingParams.of(settings.grpo)
    with DataParallelWorkers.start(policy, settings) as workers:
        asked = workers.remote(1).run(lambda remote: remote.sample([(1, 2, 10**9)], 0, rule))
        with pytest.raises(TrainerError, match=r"trainer-1 failed \(IndexError.*continue with --resume"):
            asked.result(timeout=60)


def test_shared_tensors_are_visible_on_both_sides():
    like = [torch.zeros(3, 5), torch.zeros((), dtype=torch.float64), torch.zeros(7, dtype=torch.bfloat16)]
    ours = SharedTensors(like)
    theirs = SharedTensors(like, os.dup(ours.fd))
    ours.close()
    for at, each in enumerate(ours.tensors):
        assert each.data_ptr() % 64 == 0
        each.fill_(at + 1)
    assert [each.shape for each in theirs.tensors] == [each.shape for each in like]
    assert [each.dtype for each in theirs.tensors] == [each.dtype for each in like]
    assert all(torch.equal(one, other) for one, other in zip(ours.tensors, theirs.tensors, strict=True))
