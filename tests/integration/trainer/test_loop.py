"""Training run: it learns, resumes exactly, and reports its time by activity."""

import json
import shutil
import signal
from contextlib import ExitStack
from dataclasses import replace

import pytest
import torch
from rich.console import Console
from tests.fakes.symbolic_household import SymbolicCluster, make_tasks

from embomatrix.trainer.cluster.gateway import Gateway
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import OnLost, SeedPer, read_settings
from embomatrix.trainer.grpo.update import Updater
from embomatrix.trainer.lifecycle.checkpoint import CHECKPOINTS, CheckpointStore, TrainingProgress, read_state
from embomatrix.trainer.lifecycle.stopwatch import Activity
from embomatrix.trainer.logging.display import LineDisplay, LiveDisplay
from embomatrix.trainer.logging.evaluations import AFTER, BEFORE, DURING, EVALUATIONS, read_evaluations
from embomatrix.trainer.logging.outcome import read_outcome
from embomatrix.trainer.logging.recorder import read_metrics
from embomatrix.trainer.logging.report import success_rows, time_rows
from embomatrix.trainer.policy.loading import new_policy, saved_policy
from embomatrix.trainer.run.loop import TrainingRun
from embomatrix.trainer.run.starting import REFERENCE, RunStart

TINY = {"tiny.layers": 2, "tiny.width": 32, "tiny.heads": 2, "tiny.inner": 64}
SHORT = {
    "imitation.steps": 60,
    "imitation.batch": 8,
    "imitation.learning_rate": 8e-3,
    "grpo.steps": 6,
    "grpo.tasks_per_step": 4,
    "grpo.group": 4,
    "grpo.chunk": 2,
    "grpo.max_new": 24,
    "evaluation.samples": 2,
    "prompt.rename_share": 0.5,
    "prompt.drop_share": 0.5,
    "checkpoint_every": 3,
    "samples_every": 1,
}
SEVERAL_UPDATES = {"grpo__chunk": 1, "grpo__updates_per_batch": 2, "grpo__minibatches": 2}
TASKS = make_tasks(10, 4, objects=10)
SAMPLING, WAITING, UPDATE = Activity.SAMPLING, Activity.WAITING, Activity.UPDATE


def run(out, cluster=None, tasks=TASKS, resume=False, display=None, **changes):
    settings = read_settings(None, {**TINY, **SHORT, **{k.replace("__", "."): v for k, v in changes.items()}})
    cluster = cluster or SymbolicCluster(tasks)
    progress, reference = TrainingProgress(), None
    policy = new_policy(settings, tasks)
    if resume:
        newest = CheckpointStore(out / CHECKPOINTS, keep=9).latest()
        progress, settings = read_state(newest)
        policy = saved_policy(newest / "policy", settings)
        reference = saved_policy(out / REFERENCE, settings).frozen_copy()
    start = RunStart(settings, tasks, policy, progress, reference)
    display = display or LineDisplay(Console(quiet=True))
    with (
        Gateway(lambda: cluster, tasks.bundle_bytes, run_name="test") as gateway,
        display,
    ):
        return TrainingRun(start, gateway, display, out).run(), policy


def weights(policy):
    return torch.cat([parameter.detach().flatten() for parameter in policy.parameters()])


def without_time(metrics):
    return [
        {key: value for key, value in row.items() if key not in ("seconds", "spent_s")} for row in metrics
    ]


@pytest.mark.parametrize("changes", [{}, SEVERAL_UPDATES], ids=["one update", "several updates"])
def test_resumed_run_is_bit_identical_to_an_uninterrupted_one(tmp_path, changes):
    _, whole = run(tmp_path / "whole", **changes)
    run(tmp_path / "halves", **changes)
    newest = CheckpointStore(tmp_path / "halves" / CHECKPOINTS, keep=9).latest()
    for path in sorted(newest.rglob("*"), reverse=True):  # as if the run had been killed after its third step
        path.unlink() if path.is_file() else path.rmdir()
    newest.rmdir()
    _, resumed = run(tmp_path / "halves", resume=True)
    assert torch.equal(weights(whole), weights(resumed))
    assert without_time(read_metrics(tmp_path / "whole")) == without_time(read_metrics(tmp_path / "halves"))


def test_evaluations_during_training_change_nothing_and_a_resumed_run_repeats_none(tmp_path):
    _, plain = run(tmp_path / "plain")
    summary, whole = run(tmp_path / "whole", evaluation__every=2, evaluation__samples_during=1)
    assert torch.equal(weights(plain), weights(whole))
    found = read_evaluations(tmp_path / "whole")
    assert [(each.step, each.label, len(each.answers)) for each in found] == [
        (0, BEFORE, 8),
        (2, DURING, 4),
        (4, DURING, 4),
        (6, AFTER, 8),
    ]
    page = summary.report.read_text()
    assert "Held-out success during GRPO" in page
    assert "Why held-out plans failed" in page
    run(tmp_path / "halves", evaluation__every=2, evaluation__samples_during=1)
    newest = CheckpointStore(tmp_path / "halves" / CHECKPOINTS, keep=9).latest()
    shutil.rmtree(newest)  # as if the run had been killed after its third step
    run(tmp_path / "halves", resume=True)
    assert read_evaluations(tmp_path / "halves") == found


def test_evaluations_on_some_tasks_use_the_same_ones_each_time(tmp_path):
    summary, _ = run(tmp_path, evaluation__tasks=2, evaluation__every=1, grpo__steps=2, imitation__steps=1)
    asked = [{answer.verdict.task_id for answer in each.answers} for each in read_evaluations(tmp_path)]
    assert len(asked) == 3
    assert asked[0] == asked[1] == asked[2]
    assert asked[0] < {task.task.task_id for task in TASKS.heldout}
    assert success_rows(summary)[0][:2] == ("all", "2")


def test_cut_lines_of_an_evaluation_are_left_out(tmp_path):
    run(tmp_path)
    path = tmp_path / EVALUATIONS
    whole = read_evaluations(tmp_path)
    path.write_bytes(path.read_bytes()[:-40])
    cut = read_evaluations(tmp_path)
    assert cut[0] == whole[0]
    assert cut[1].answers == whole[1].answers[:-1]


def test_slow_cluster_does_not_change_the_learned_weights(tmp_path):
    _, fast = run(tmp_path / "fast")
    _, slow = run(tmp_path / "slow", SymbolicCluster(TASKS, delay_s=0.02))
    assert torch.equal(weights(fast), weights(slow))


def test_run_writes_report_metrics_samples_and_the_newest_checkpoints(tmp_path):
    summary, _ = run(tmp_path, keep_checkpoints=1)
    page = summary.report.read_text()
    assert page.count("<svg") == 6, "a curve for each figure of a step"
    for part in (
        "Success on held-out tasks",
        "Where the time went",
        "seed 0",
        "10 training and 4 held-out tasks",
    ):
        assert part in page
    assert [row["step"] for row in read_metrics(tmp_path)] == [1, 2, 3, 4, 5, 6]
    sample = json.loads((tmp_path / "samples.jsonl").read_text().splitlines()[0])
    assert {"step", "task", "instruction", "text", "reward", "advantage"} <= set(sample)
    assert [path.name for path in (tmp_path / CHECKPOINTS).iterdir()] == ["step-000006"]
    assert summary.checkpoint.name == "step-000006"
    assert sum(seconds for _, seconds, _ in time_rows(summary.outcome)) == pytest.approx(
        summary.outcome.wall_s
    )
    assert success_rows(summary)[0][:2] == ("all", "4")
    outcome = read_outcome(tmp_path)
    assert (outcome.steps, outcome.rollouts, len(outcome.before), len(outcome.after)) == (6, 96, 4, 4)
    assert 0 <= outcome.shares.waiting <= outcome.shares.overhead < 1
    assert outcome.peak_mb > 50, "torch alone takes more"


def test_full_disk_ends_the_run_and_keeps_the_previous_checkpoint(tmp_path, small_files):
    whole, _ = run(tmp_path / "whole")

    class Filled(LineDisplay):
        def stepped(self, record, share, rollouts_per_s):
            if record.step == 4:
                room.enter_context(small_files(20_000))

    with ExitStack() as room, pytest.raises(TrainerError, match=r"step-000006 can't be written .*--resume"):
        run(tmp_path / "full", display=Filled(Console(quiet=True)))
    assert CheckpointStore(tmp_path / "full" / CHECKPOINTS, keep=9).latest().name == "step-000003"
    gone_on, _ = run(tmp_path / "full", resume=True)
    assert gone_on.after == whole.after


def test_used_share_of_the_budget_is_at_most_one(tmp_path):
    shares = []

    class Listener(LineDisplay):
        def stepped(self, record, share, rollouts_per_s):
            shares.append(share)

    run(tmp_path, display=Listener(Console(quiet=True)), grpo__steps=None, grpo__minutes=1e-6)
    assert shares == [1.0]


def test_every_step_announces_its_window(tmp_path):
    cluster = SymbolicCluster(TASKS)
    run(tmp_path, cluster, grpo__lookahead=2)
    windows = [sorted(set(steps)) for _, steps in cluster.announced]
    assert [1, 2, 3] in windows or [2, 3, 4] in windows
    assert [version for version, _ in cluster.announced] == sorted(
        version for version, _ in cluster.announced
    )


def test_group_with_a_lost_rollout_is_left_out_of_the_update(tmp_path):
    summary, policy = run(tmp_path / "a", SymbolicCluster(TASKS, lose_first=True))
    reference = saved_policy(tmp_path / "a" / REFERENCE, read_settings(None, {}))
    assert summary.outcome.lost > 0
    assert torch.equal(weights(policy), weights(reference))
    _, moved = run(tmp_path / "b", SymbolicCluster(TASKS, lose_first=True), grpo__on_lost=OnLost.PARTIAL)
    assert not torch.equal(weights(moved), weights(reference))


def test_interrupted_step_is_rolled_back_and_repeated_after_a_resume(tmp_path):
    class Failing(SymbolicCluster):
        async def execute(self, batch):
            if batch.batch_id.startswith("step-4"):
                from embomatrix.rpc.status import OverloadedError

                raise OverloadedError("the queue is full: try again later")
            async for result in super().execute(batch):
                yield result

    _, whole = run(tmp_path / "whole", grpo__chunk=4)
    with pytest.raises(TrainerError, match="queue is full"):
        run(tmp_path / "broken", Failing(TASKS), grpo__chunk=4)
    progress, _ = read_state(CheckpointStore(tmp_path / "broken" / CHECKPOINTS, keep=9).latest())
    assert progress.step == 3
    in_steps = sum(progress.spent_s.get(what, 0.0) for what in (SAMPLING, WAITING, UPDATE))
    assert in_steps <= progress.grpo_s
    _, resumed = run(tmp_path / "broken", resume=True)
    assert torch.equal(weights(whole), weights(resumed))
    assert without_time(read_metrics(tmp_path / "whole")) == without_time(read_metrics(tmp_path / "broken"))


@pytest.mark.parametrize("changes", [{}, SEVERAL_UPDATES], ids=["one update", "several updates"])
def test_ctrl_c_during_an_update_waits_for_the_end_of_the_step(tmp_path, monkeypatch, changes):
    apply = Updater._apply

    def interrupted(updater, state):
        apply(updater, state)
        if state.plan.step == 4 and len(state.norms) == 1:
            signal.raise_signal(signal.SIGINT)

    _, whole = run(tmp_path / "whole", **changes)
    monkeypatch.setattr(Updater, "_apply", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "halves", **changes)
    progress, _ = read_state(CheckpointStore(tmp_path / "halves" / CHECKPOINTS, keep=9).latest())
    assert progress.step == 4
    _, resumed = run(tmp_path / "halves", resume=True)
    assert torch.equal(weights(whole), weights(resumed))
    assert without_time(read_metrics(tmp_path / "whole")) == without_time(read_metrics(tmp_path / "halves"))


def test_error_between_two_updates_of_a_step_leaves_the_checkpoint_before_the_step(tmp_path, monkeypatch):
    apply = Updater._apply

    def failing(updater, state):
        apply(updater, state)
        if state.plan.step == 5 and len(state.norms) == 2:
            raise TrainerError("the process trainer-1 ended during a step")

    _, whole = run(tmp_path / "whole", **SEVERAL_UPDATES)
    with monkeypatch.context() as patched:
        patched.setattr(Updater, "_apply", failing)
        with pytest.raises(TrainerError, match="trainer-1 ended"):
            run(tmp_path / "cut", **SEVERAL_UPDATES)
    assert CheckpointStore(tmp_path / "cut" / CHECKPOINTS, keep=9).latest().name == "step-000003"
    _, resumed = run(tmp_path / "cut", resume=True)
    assert torch.equal(weights(whole), weights(resumed))
    assert without_time(read_metrics(tmp_path / "whole")) == without_time(read_metrics(tmp_path / "cut"))


def test_live_display_shows_every_phase(tmp_path):
    console = Console(force_terminal=True, width=120, record=True)
    run(tmp_path, display=LiveDisplay(console))
    text = console.export_text()
    assert "held-out success before GRPO" in text
    assert "held-out success after GRPO" in text


def test_damaged_checkpoints_are_rejected(tmp_path):
    run(tmp_path)
    newest = CheckpointStore(tmp_path / CHECKPOINTS, keep=9).latest()
    (newest / "state.json").write_text("{}")
    with pytest.raises(TrainerError, match="not a readable checkpoint"):
        read_state(newest)
    (newest / "policy" / "weights.pt").write_bytes(b"rubbish")
    with pytest.raises(TrainerError, match=r"damaged|no policy"):
        saved_policy(newest / "policy", read_settings(None, {}))


def test_imitation_alone_learns_a_small_world(tmp_path):
    tasks = make_tasks(40, 20, objects=7)
    summary, _ = run(
        tmp_path,
        tasks=tasks,
        imitation__steps=150,
        imitation__batch=24,
        imitation__learning_rate=8e-3,
        grpo__steps=0,
        grpo__max_new=40,
        tiny__width=64,
        tiny__inner=128,
        evaluation__samples=5,
    )
    assert summary.after.success().value > 0.15


@pytest.mark.slow
def test_grpo_raises_held_out_success(tmp_path):
    tasks = make_tasks(120, 40, objects=7)
    summary, _ = run(
        tmp_path,
        tasks=replace(tasks),
        imitation__steps=50,
        imitation__batch=24,
        imitation__learning_rate=5e-3,
        grpo__steps=150,
        grpo__tasks_per_step=8,
        grpo__group=8,
        grpo__chunk=4,
        grpo__max_new=40,
        tiny__width=64,
        tiny__inner=128,
        evaluation__samples=10,
    )
    rows = success_rows(summary)
    assert summary.after.success().value > summary.before.success().value + 0.1, rows


class SeedKeeper(SymbolicCluster):
    """Stand-in that keeps the seeds of each task, of GRPO and of evaluations."""

    def kept(self):
        self.trained, self.evaluated = {}, set()
        return self

    async def execute(self, batch):
        for rollout in batch.rollouts:
            if batch.batch_id.startswith("step-"):
                self.trained.setdefault(rollout.task_id, {}).setdefault(batch.step, set()).add(rollout.seed)
            else:
                self.evaluated.add(rollout.seed)
        async for result in super().execute(batch):
            yield result


@pytest.mark.parametrize("seed_per", SeedPer)
def test_task_keeps_its_seed_for_an_epoch_or_for_the_run(tmp_path, seed_per):
    cluster = SeedKeeper(TASKS).kept()
    run(tmp_path, cluster, grpo__seed_per=seed_per)
    repeated = 0
    for steps in cluster.trained.values():
        assert all(len(seeds) == 1 for seeds in steps.values())
        epochs = {(step - 1) * 4 // len(TASKS.train) for step in steps}
        repeated += len(epochs) > 1
        assert len(set.union(*steps.values())) == (len(epochs) if seed_per is SeedPer.EPOCH else 1)
    assert repeated
    trained = {seed for steps in cluster.trained.values() for seeds in steps.values() for seed in seeds}
    assert cluster.evaluated
    assert max(cluster.evaluated) < 2**31 <= min(trained)
