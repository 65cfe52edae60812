"""Low-rank adapters and gradient checkpointing: learning, merging, resuming, memory."""

import shutil

import pytest
import torch
from rich.console import Console
from tests.fakes.small_llama import random_llama
from tests.fakes.symbolic_household import SymbolicCluster
from tests.integration.trainer.conftest import SMALL_TASKS

from embomatrix.skills.prompt import Codec, prompt_for
from embomatrix.trainer.cluster.gateway import Gateway
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import (
    LANGUAGE_MODEL_DEFAULTS,
    ComputeDtype,
    LoraSettings,
    TrainSettings,
    read_settings,
)
from embomatrix.trainer.evaluation.models import load_model
from embomatrix.trainer.lifecycle.checkpoint import CHECKPOINTS, CheckpointStore, TrainingProgress, read_state
from embomatrix.trainer.logging.display import LineDisplay
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.loading import new_policy, saved_policy
from embomatrix.trainer.policy.lora import ADAPTERS
from embomatrix.trainer.run.loop import TrainingRun
from embomatrix.trainer.run.starting import REFERENCE, RunStart

TASKS = SMALL_TASKS
SHAPE = LoraSettings(rank=4, alpha=8.0)
SHORT = {
    "compute_dtype": "float32",
    "lora.rank": 4,
    "lora.alpha": 8.0,
    "imitation.steps": 2,
    "imitation.learning_rate": 1e-2,
    "grpo.steps": 4,
    "grpo.tasks_per_step": 2,
    "grpo.group": 3,
    "grpo.max_new": 8,
    "grpo.learning_rate": 1e-2,
    "evaluation.samples": 1,
    "checkpoint_every": 2,
    "keep_checkpoints": 9,
}


def policy_of(tokenizer, *, seed=0, recompute=False):
    return HfPolicy(
        random_llama(tokenizer, seed),
        tokenizer,
        Codec.LINES,
        "random llama",
        gradient_checkpointing=recompute,
    )


def adapters(module):
    """Return the adapted layers by name."""
    return {name: layer for name, layer in module.named_modules() if hasattr(layer, "lora_B")}


def moved(policy):
    """Give the adapters random weights."""
    with torch.no_grad():
        for at, layer in enumerate(adapters(policy.module).values()):
            up = layer.lora_B["default"].weight
            up.copy_(0.3 * torch.randn(up.shape, generator=torch.Generator().manual_seed(at)))
    return policy


def scored(policy, *, rows=4):
    """Return log-probabilities of the same plans under any policy; prompts differ in length."""
    prompt_ids = [policy.encode(prompt_for(task.situation, Codec.LINES)) for task in TASKS.train[:2]]
    prompt_ids[0] = prompt_ids[0][20:]
    tokens = torch.arange(rows * 5).view(rows, 5) % 30 + 2
    mask = torch.ones(rows, 5, dtype=torch.bool)
    mask[1, 3:] = False
    return policy.logprobs(prompt_ids, tokens, mask, rows // 2, 0.9)


def train(out, changes, *, resume=False):
    settings = read_settings(None, {**SHORT, **changes}, LANGUAGE_MODEL_DEFAULTS)
    progress, reference = TrainingProgress(), None
    if resume:
        newest = CheckpointStore(out / CHECKPOINTS, keep=9).latest()
        progress, settings = read_state(newest)
        policy = saved_policy(newest / "policy", settings)
        reference = saved_policy(out / REFERENCE, settings).frozen_copy()
    else:
        policy = new_policy(settings, TASKS)
    start = RunStart(settings, TASKS, policy, progress, reference)
    display = LineDisplay(Console(quiet=True))
    with Gateway(lambda: SymbolicCluster(TASKS), TASKS.bundle_bytes, run_name="lora") as gateway:
        summary = TrainingRun(start, gateway, display, out).run()
    return policy, summary


def learnt(policy):
    return torch.cat([parameter.detach().flatten() for parameter in policy.parameters()])


def test_new_adapters_do_not_change_the_output(tokenizer):
    plain, adapted = policy_of(tokenizer), policy_of(tokenizer)
    adapted.adapt(SHAPE, seed=0)
    # Weights that want a gradient may be multiplied by another kernel than frozen ones: the last bits would differ.
    plain.module.requires_grad_(False)
    assert torch.equal(scored(plain).logprobs, scored(adapted).logprobs)


def test_only_adapters_learn_and_the_output_layer_has_none(tokenizer):
    policy = policy_of(tokenizer)
    policy.adapt(SHAPE, seed=0)
    scored(policy).logprobs.sum().backward()
    names = {name for name, each in policy.module.named_parameters() if each.grad is not None}
    assert names
    assert all("lora_A" in name or "lora_B" in name for name in names)
    assert len(list(policy.parameters())) == 2 * 7 * 2  # seven linear layers in each of two blocks
    assert not any("lm_head" in name for name in adapters(policy.module))


def test_merged_model_equals_the_adapted_one(tokenizer, tmp_path):
    policy = policy_of(tokenizer)
    policy.adapt(SHAPE, seed=0)
    before = scored(policy).logprobs
    expected = scored(moved(policy)).logprobs
    policy.save(tmp_path)
    assert torch.equal(scored(policy).logprobs, expected)  # saving leaves the adapters where they are
    assert not torch.allclose(before, expected, atol=1e-2)
    assert torch.allclose(
        scored(HfPolicy.load(tmp_path, TrainSettings(compute_dtype=ComputeDtype.FLOAT32))).logprobs,
        expected,
        atol=1e-4,
    )


def test_frozen_copy_shares_the_model_but_not_the_adapters(tokenizer):
    policy = policy_of(tokenizer)
    policy.adapt(SHAPE, seed=0)
    twin = policy.frozen_copy()
    before = scored(twin).logprobs
    moved(policy)
    assert torch.equal(scored(twin).logprobs, before)
    for name, layer in adapters(policy.module).items():
        assert adapters(twin.module)[name].base_layer.weight is layer.base_layer.weight
    assert not any(parameter.requires_grad for parameter in twin.module.parameters())


def test_resumed_run_with_adapters_is_bit_identical(model_folder, tmp_path):
    whole, summary = train(tmp_path / "whole", {"model": str(model_folder)})
    train(tmp_path / "halves", {"model": str(model_folder)})
    shutil.rmtree(tmp_path / "halves" / CHECKPOINTS / "step-000004")  # as if killed after its second step
    resumed, _ = train(tmp_path / "halves", {}, resume=True)
    assert torch.equal(learnt(whole), learnt(resumed))
    assert learnt(whole).abs().sum() > 0
    frozen = adapters(whole.module)
    for name, layer in adapters(new_policy(settings_of(model_folder), TASKS).module).items():
        assert torch.equal(layer.base_layer.weight, frozen[name].base_layer.weight)
    loaded, _ = load_model(str(summary.checkpoint), Codec.LINES, threads=1, device="cpu")
    assert not adapters(loaded.module)
    assert torch.allclose(scored(loaded).logprobs, scored(whole).logprobs, atol=1e-4)


def test_two_processes_with_adapters_are_bit_identical_to_one(model_folder, tmp_path):
    one, _ = train(tmp_path / "one", {"model": str(model_folder)})
    two, _ = train(tmp_path / "two", {"model": str(model_folder), "processes": 2, "grpo.chunk": 1})
    assert torch.equal(learnt(one), learnt(two))
    assert learnt(one).abs().sum() > 0


def settings_of(folder, **changes):
    return read_settings(None, {"model": str(folder), "lora.rank": 4, "lora.alpha": 8.0, **changes})


def test_adapters_of_another_model_or_shape_are_rejected(tokenizer, tmp_path):
    policy = policy_of(tokenizer)
    policy.adapt(SHAPE, seed=0)
    policy.save(tmp_path)
    other = policy_of(tokenizer, seed=1)
    with pytest.raises(TrainerError, match="belong to another model"):
        other.adapt(SHAPE, seed=0, saved=tmp_path)
    with pytest.raises(TrainerError, match="resume with the settings of the run"):
        policy_of(tokenizer).adapt(LoraSettings(rank=2, alpha=8.0), seed=0, saved=tmp_path)
    (tmp_path / ADAPTERS / "adapter_model.safetensors").write_bytes(b"rubbish")
    with pytest.raises(TrainerError, match="are damaged"):
        policy_of(tokenizer).adapt(SHAPE, seed=0, saved=tmp_path)


def test_unknown_target_layers_are_rejected(tokenizer):
    with pytest.raises(TrainerError, match=r"no linear layer named query.*such as q_proj"):
        policy_of(tokenizer).adapt(LoraSettings(rank=4, alpha=8.0, targets=("query",)), seed=0)


@pytest.mark.parametrize("changes", [{"lora.rank": 4}, {"gradient_checkpointing": True}])
def test_word_level_policy_rejects_adapters_and_checkpointing(changes):
    with pytest.raises(TrainerError, match="are for Hugging Face models"):
        new_policy(read_settings(None, changes), TASKS)


@pytest.mark.parametrize("adapted", [False, True])
def test_gradient_checkpointing_gives_the_same_gradient_in_less_memory(tokenizer, adapted):
    gradients, kept = [], []
    for recompute in (False, True):
        policy = policy_of(tokenizer, recompute=recompute)
        if adapted:
            policy.adapt(SHAPE, seed=0)
            moved(policy)
        sizes = []
        with torch.autograd.graph.saved_tensors_hooks(
            lambda x, to=sizes: to.append(x.numel()) or x, lambda x: x
        ):
            result = scored(policy, rows=8)
        (result.logprobs * torch.arange(5.0)).sum().backward()
        gradients.append(torch.cat([each.grad.flatten() for each in policy.parameters()]))
        kept.append(sum(sizes))
    assert torch.allclose(gradients[0], gradients[1], atol=1e-3, rtol=1e-3)
    assert gradients[0].abs().max() > 0.1
    assert kept[1] < 0.7 * kept[0]


def test_gradient_checkpointing_restores_the_layers(tokenizer):
    policy = policy_of(tokenizer, recompute=True)
    scored(policy)
    assert all("forward" not in vars(module) for module in policy.module.modules())
