"""Start and resume of a run: kept settings, and rejected changes."""

import json

import pytest
import torch
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.small_llama import random_llama, word_tokenizer

from embomatrix.skills.prompt import Codec
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.data.tasks import load_tasks
from embomatrix.trainer.lifecycle.checkpoint import CHECKPOINTS, CheckpointStore
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.run import starting
from embomatrix.trainer.run.starting import REFERENCE, resume_run, start_run

SMALL = {"tiny.layers": 1, "tiny.width": 16, "tiny.heads": 2, "tiny.inner": 16, "threads": 1}


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    return write_kitchen_dataset(tmp_path_factory.mktemp("kitchen"))


@pytest.fixture
def begun(kitchen, tmp_path):
    """Save the checkpoint of a run after one step of imitation; with ``grpo_ready``, after one step of GRPO too."""

    def begin(*, grpo_ready=False):
        start = start_run(kitchen, tmp_path, "tiny", None, SMALL)
        start.progress.grpo_ready = grpo_ready
        start.progress.imitation.step = start.progress.step = 1
        if grpo_ready:
            start.policy.save(tmp_path / REFERENCE)
        store = CheckpointStore(tmp_path / CHECKPOINTS, keep=1)
        return store.save(start.policy, {}, start.progress, start.settings)

    return begin


@pytest.mark.parametrize("changes", [{"grpo.steps": 9, "threads": 1}, {"seed": 0}, {"seed": None}])
def test_resumed_run_can_be_longer_and_keeps_its_settings(kitchen, tmp_path, begun, changes):
    begun(grpo_ready=True)
    start = resume_run(kitchen, tmp_path, changes)
    assert start.progress.step == 1
    assert start.settings.grpo.steps == changes.get("grpo.steps")


@pytest.mark.parametrize(
    ("changes", "model", "written", "expected"),
    [
        (
            {"seed": 7},
            "tiny",
            "",
            "started with seed = 0, and can't be resumed with 7: leave that out, or start a new",
        ),
        ({}, "runs/other", "", "started with model = 'tiny', and can't be resumed with 'runs/other'"),
        (
            {"reward.goal": "10"},
            "tiny",
            "",
            r"started with reward\.goal = 30\.0, and can't be resumed with 10\.0",
        ),
        ({}, "tiny", "[grpo]\ngroup = 4\n", r"started with grpo\.group = 8, and can't be resumed with 4"),
        ({}, "tiny", "[grpo]\ngruop = 4\n", r"unknown setting 'grpo\.gruop'"),
    ],
)
def test_resume_rejects_changed_settings(kitchen, tmp_path, begun, changes, model, written, expected):
    begun(grpo_ready=True)
    file = tmp_path / "settings.toml"
    file.write_text(written)
    with pytest.raises(TrainerError, match=expected):
        resume_run(kitchen, tmp_path, changes, model=model, settings_file=file)


def test_later_settings_can_change_until_imitation_ends(kitchen, tmp_path, begun):
    begun()
    assert resume_run(kitchen, tmp_path, {"reward.goal": "10"}).settings.reward.goal == 10.0
    with pytest.raises(TrainerError, match=r"started with imitation\.patience = 0"):
        resume_run(kitchen, tmp_path, {"imitation.patience": 3})


def test_resume_rejects_other_tasks(kitchen, tmp_path, begun):
    begun()
    other = write_kitchen_dataset(tmp_path / "other")
    tasks = (other / "tasks.jsonl").read_text().splitlines(keepends=True)
    (other / "tasks.jsonl").write_text("".join(tasks[:-1]))
    with pytest.raises(
        TrainerError, match=r"started with other tasks than those of .*other: pass its original --dataset"
    ):
        resume_run(other, tmp_path, {})


def test_checkpoint_of_another_version_is_rejected(kitchen, tmp_path, begun):
    state = begun() / "state.json"
    state.write_text(json.dumps({**json.loads(state.read_text()), "schema": 2}))
    with pytest.raises(TrainerError, match="has schema 2, this version reads 3: start a new run"):
        resume_run(kitchen, tmp_path, {})


def test_default_threads_and_processes_depend_on_the_model(kitchen, tmp_path, monkeypatch):
    monkeypatch.setattr(starting, "usable_cores", lambda: 8)
    shape = {name: value for name, value in SMALL.items() if name != "threads"}
    by_itself = start_run(kitchen, tmp_path / "itself", "tiny", None, shape).settings
    assert (by_itself.threads, by_itself.processes) == (2, 2)
    alone = start_run(kitchen, tmp_path / "alone", "tiny", None, {**shape, "processes": 1}).settings
    assert (alone.threads, alone.processes) == (4, 1)
    written = tmp_path / "settings.toml"
    written.write_text("threads = 1\nprocesses = 3\n")
    chosen = start_run(kitchen, tmp_path / "chosen", "tiny", written, {**shape, "threads": None}).settings
    assert (chosen.threads, chosen.processes) == (1, 3)


def test_policy_on_another_device_has_one_process_by_default(kitchen, tmp_path, monkeypatch):
    monkeypatch.setattr(starting, "usable_cores", lambda: 8)
    assert start_run(kitchen, tmp_path, "tiny", None, {**SMALL, "device": "meta"}).settings.processes == 1


def test_resume_accepts_the_same_saved_policy(kitchen, tmp_path, begun):
    policy, arm = str(begun() / "policy"), tmp_path / "arm"
    start = start_run(kitchen, arm, policy, None, SMALL)
    start.progress.grpo_ready = True
    start.policy.save(arm / REFERENCE)
    CheckpointStore(arm / CHECKPOINTS, keep=1).save(start.policy, {}, start.progress, start.settings)
    assert resume_run(kitchen, arm, {"imitation.seconds": 0.0}, model=policy).settings.model == policy


@pytest.mark.parametrize(("able", "compute_dtype"), [(True, torch.bfloat16), (False, torch.float32)])
def test_word_level_policy_uses_bfloat16_on_capable_cpus(kitchen, tmp_path, monkeypatch, able, compute_dtype):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": able})
    assert (
        start_run(kitchen, tmp_path / "auto", "tiny", None, SMALL).policy.module.blocks[0].qkv.compute_dtype
        is compute_dtype
    )
    whole = start_run(kitchen, tmp_path / "whole", "tiny", None, {**SMALL, "compute_dtype": "float32"})
    assert whole.policy.module.blocks[0].qkv.compute_dtype is torch.float32


@pytest.mark.parametrize(("given", "codec"), [({}, Codec.JSON), ({"codec": "lines"}, Codec.LINES)])
def test_trained_language_model_keeps_its_codec_by_default(kitchen, tmp_path, given, codec):
    pytest.importorskip("tokenizers")
    tokenizer = word_tokenizer(load_tasks(kitchen).train)
    HfPolicy(random_llama(tokenizer), tokenizer, Codec.JSON, "random llama").save(tmp_path / "taught")
    start = start_run(kitchen, tmp_path / "run", str(tmp_path / "taught"), None, {**SMALL, **given})
    assert start.settings.codec is start.policy.codec is codec
