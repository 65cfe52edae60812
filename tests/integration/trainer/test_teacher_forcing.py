"""Imitation: early stopping, exact resume, and the resulting policy."""

import itertools
import json
import math
import signal

import pytest
import torch
from rich.console import Console
from tests.fakes.symbolic_household import make_tasks

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import read_settings
from embomatrix.trainer.imitation.optimiser import ImitationOptimiser
from embomatrix.trainer.imitation.teacher_forcing import Imitation
from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
from embomatrix.trainer.lifecycle.checkpoint import CHECKPOINTS, CheckpointStore, TrainingProgress, read_state
from embomatrix.trainer.logging.display import LineDisplay, LiveDisplay
from embomatrix.trainer.logging.recorder import IMITATION, Recorder
from embomatrix.trainer.policy.loading import new_policy, saved_policy
from embomatrix.trainer.policy.tiny import TinyPolicy
from embomatrix.trainer.run.imitation import run_imitation
from embomatrix.trainer.run.starting import RunStart

TINY = {"tiny.layers": 1, "tiny.width": 32, "tiny.heads": 2, "tiny.inner": 64}
SHORT = {
    "imitation.steps": 12,
    "imitation.batch": 4,
    "imitation.learning_rate": 8e-3,
    "prompt.rename_share": 0.5,
    "prompt.drop_share": 0.5,
}
STOPPING = {"imitation.patience": 2, "imitation.validate_every": 4, "imitation.validation_share": 0.2}
TASKS = make_tasks(20, 0, objects=7)


class CutError(Exception):
    """Error that ends a run before its last step."""


def settings_of(**changes):
    return read_settings(None, {**TINY, **SHORT, **{k.replace("__", "."): v for k, v in changes.items()}})


def imitate(out, settings, cut_after=None, tasks=TASKS, display=None):
    store = CheckpointStore(out / CHECKPOINTS, keep=9)
    newest = store.latest()
    progress = read_state(newest)[0] if newest else TrainingProgress()
    policy = saved_policy(newest / "policy", settings) if newest else new_policy(settings, tasks)
    steps = []

    def report(step):
        steps.append(step)
        if display:
            display.imitation(step)
        if cut_after == step.step:
            raise CutError

    with DataParallelWorkers.start(policy, settings) as workers:
        run_imitation(RunStart(settings, tasks, policy, progress), workers, out, Recorder(out), report)
    return policy, progress.imitation, steps


def weights(policy):
    return torch.cat([parameter.detach().flatten() for parameter in policy.parameters()])


def test_gradients_that_are_not_finite_change_no_weight_and_end_imitation(tmp_path, monkeypatch):
    settings = settings_of()
    begun = weights(new_policy(settings, TASKS))
    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", lambda parameters, most: torch.tensor(math.nan))
    steps, changed = [], []

    def report(step):
        steps.append(step.step)
        changed.append(not torch.equal(weights(policy), begun))

    policy = new_policy(settings, TASKS)
    progress = TrainingProgress()
    with (
        DataParallelWorkers.start(policy, settings) as workers,
        pytest.raises(
            TrainerError, match=r"norm in step 5 is nan, .* unchanged: lower imitation\.learning_rate"
        ),
    ):
        run_imitation(
            RunStart(settings, TASKS, policy, progress), workers, tmp_path, Recorder(tmp_path), report
        )
    assert steps == [1, 2, 3, 4]
    assert not any(changed)


@pytest.mark.parametrize("stopping", [{}, STOPPING])
def test_resumed_imitation_is_bit_identical(tmp_path, stopping):
    settings = settings_of(**{key.replace(".", "__"): value for key, value in stopping.items()})
    whole, state, _ = imitate(tmp_path / "whole", settings)
    with pytest.raises(CutError):
        imitate(tmp_path / "halves", settings, cut_after=7)
    resumed, again, _ = imitate(tmp_path / "halves", settings)
    assert torch.equal(weights(whole), weights(resumed))
    assert (state.step, state.best_loss, state.best_step) == (again.step, again.best_loss, again.best_step)
    assert (tmp_path / "whole" / IMITATION).read_text() == (tmp_path / "halves" / IMITATION).read_text()


def test_ctrl_c_during_an_imitation_update_is_deferred(tmp_path, monkeypatch):
    whole, _, _ = imitate(tmp_path / "whole", settings_of())
    step, calls = ImitationOptimiser.step, itertools.count(1)

    def interrupted(optimiser, factor):
        if next(calls) == 7:
            signal.raise_signal(signal.SIGINT)
        step(optimiser, factor)

    monkeypatch.setattr(ImitationOptimiser, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        imitate(tmp_path / "halves", settings_of())
    monkeypatch.undo()
    resumed, _, steps = imitate(tmp_path / "halves", settings_of())
    assert [each.step for each in steps] == [8, 9, 10, 11, 12]
    assert torch.equal(weights(whole), weights(resumed))


@pytest.mark.parametrize(("chunk", "at_once"), [(None, [4]), (1, [1, 1, 1, 1]), (3, [3, 1])])
def test_chunked_step_has_the_full_gradient_and_the_memory_of_one_chunk(
    tmp_path, monkeypatch, chunk, at_once
):
    def gradient(name, **changes):
        one = settings_of(imitation__steps=1, compute_dtype="float32", **changes)
        policy, _, (step,) = imitate(tmp_path / name, one)
        return torch.cat([each.grad.flatten() for each in policy.parameters()]), step.loss

    whole, loss = gradient("whole")
    learnt, rows = TinyPolicy.logprobs, []

    def counted(policy, prompts, *rest, **named):
        rows.append(len(prompts))
        return learnt(policy, prompts, *rest, **named)

    monkeypatch.setattr(TinyPolicy, "logprobs", counted)
    parts, loss_of_parts = gradient("parts", imitation__chunk=chunk)
    assert rows == at_once
    assert torch.allclose(whole, parts, atol=1e-5)
    assert loss_of_parts == pytest.approx(loss, rel=1e-5)


def test_early_stopping_restores_the_best_weights(tmp_path):
    ruin = settings_of(
        imitation__steps=400,
        imitation__learning_rate=2.0,  # after the first measurement nothing gets better
        imitation__patience=3,
        imitation__validate_every=2,
        imitation__warmup_steps=0,
    )
    policy, state, _ = imitate(tmp_path, ruin)
    rows = [json.loads(line) for line in (tmp_path / IMITATION).read_text().splitlines()]
    measured = {row["step"]: row["validation"] for row in rows if row["validation"] is not None}
    assert state.done
    assert state.step < 400
    assert state.best_loss == min(measured.values()) == measured[state.best_step]
    losses = list(measured.values())
    assert state.step >= state.best_step + 3 * 2
    assert sum(losses[-3:]) >= sum(losses[-6:-3])
    assert sum(losses[-4:-1]) < sum(losses[-7:-4]) or state.step == state.best_step + 3 * 2, (
        "not a step too many"
    )
    newest = CheckpointStore(tmp_path / CHECKPOINTS, keep=9).latest()
    assert torch.equal(weights(saved_policy(newest / "policy", ruin)), weights(policy))


@pytest.mark.parametrize(
    ("losses", "taken"),
    [
        # Three without a lower loss, and no better than those before them on average.
        ([0.5, 0.4, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3], 8),
        # 0.2 was luck: the others go on falling for a while.
        ([0.5, 0.4, 0.2, 0.3, 0.25, 0.22, 0.21, 0.22, 0.23, 0.24, 0.25, 0.26], 10),
        ([0.5, 0.6, 0.7, 0.8, 0.9], 4),
    ],
)
def test_low_outlier_does_not_stop_a_falling_loss(tmp_path, monkeypatch, losses, taken):
    given_losses = iter(losses)
    monkeypatch.setattr(Imitation, "_validation_loss", lambda _: next(given_losses))
    settings = settings_of(imitation__steps=len(losses), imitation__patience=3, imitation__validate_every=1)
    _, state, steps = imitate(tmp_path, settings)
    assert (len(steps), state.best_loss) == (taken, min(losses[:taken]))


def test_finished_imitation_is_not_repeated(tmp_path):
    first, _, _ = imitate(tmp_path, settings_of())
    again, state, steps = imitate(tmp_path, settings_of())
    assert steps == []
    assert state.done
    assert torch.equal(weights(first), weights(again))


def test_checkpoints_are_written_by_time(tmp_path):
    imitate(tmp_path, settings_of(imitation__checkpoint_seconds=1e-9, keep_checkpoints=3))
    names = sorted(path.name for path in (tmp_path / CHECKPOINTS).iterdir())
    assert names == ["imitation-000010", "imitation-000011", "imitation-000012"]


def test_too_few_tasks_for_validation_are_rejected(tmp_path):
    with pytest.raises(TrainerError, match="which leaves none to train on"):
        imitate(tmp_path, settings_of(imitation__patience=1), tasks=make_tasks(1, 0, objects=7))


def test_saved_policy_can_start_a_run(tmp_path):
    policy, _, _ = imitate(tmp_path, settings_of())
    policy.save(tmp_path / "reference")
    begun = new_policy(settings_of(model=str(tmp_path / "reference")), TASKS)
    assert torch.equal(weights(begun), weights(policy))


@pytest.mark.parametrize("live", [False, True])
def test_displays_show_the_validation_loss(tmp_path, live):
    console = Console(force_terminal=live, width=120, record=True)
    display = LiveDisplay(console) if live else LineDisplay(console)
    with display:
        imitate(tmp_path, settings_of(imitation__patience=20, imitation__validate_every=1), display=display)
    assert "validation loss" in console.export_text()
