"""Hugging Face policies: a tiny random Llama by default, and the packaged SmolLM2 if available."""

import copy
import math
import sys

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
    LoraSettings,
    TrainSettings,
    read_settings,
)
from embomatrix.trainer.evaluation.models import load_model
from embomatrix.trainer.lifecycle.checkpoint import CheckpointStore, TrainingProgress
from embomatrix.trainer.logging.display import LineDisplay
from embomatrix.trainer.logging.recorder import read_metrics
from embomatrix.trainer.policy import token_scores
from embomatrix.trainer.policy.compute_dtype import use_compute_dtype
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.import_gguf import import_gguf
from embomatrix.trainer.policy.loading import saved_policy
from embomatrix.trainer.run.loop import TrainingRun
from embomatrix.trainer.run.starting import RunStart, default_threads

TASKS = SMALL_TASKS


@pytest.fixture
def policy(tokenizer):
    return HfPolicy(random_llama(tokenizer), tokenizer, Codec.LINES, "random llama")


def prompts(policy, count=3):
    return [policy.encode(prompt_for(task.situation, Codec.LINES)) for task in TASKS.train[:count]]


REFUSING = "{{ raise_exception('System role not supported') if messages[0].role == 'system' }}"
EACH = "{% for each in messages %}<{{ each.role }}>{{ each.content }}{% endfor %}<assistant>"
USERS = EACH.replace("in messages", "in messages if each.role != 'system'")


@pytest.mark.parametrize(
    ("template", "expected"),
    [
        (EACH, "<system>{system}<user>{user}<assistant>"),
        (REFUSING + EACH, "<user>{system}\n\n{user}<assistant>"),  # as Gemma does
        (USERS, "<user>{system}\n\n{user}<assistant>"),
    ],
)
def test_chat_templates_without_a_system_role_keep_the_system_text(policy, template, expected, monkeypatch):
    monkeypatch.setattr(policy._tokenizer, "chat_template", template)
    texts = []
    monkeypatch.setattr(policy, "_tokens", texts.append)
    prompt = prompt_for(TASKS.train[0].situation, Codec.LINES)
    policy.encode(prompt)
    assert texts == [expected.format(system=prompt.system, user=prompt.user)]


def test_shared_prompt_gives_the_log_probabilities_of_a_plain_forward_pass(policy):
    prompt_ids = [prompts(policy)[0][30:], *prompts(policy)[1:]]
    samples = policy.sample(prompt_ids, 3, 1.2, 10, torch.Generator().manual_seed(0))
    shared = policy.logprobs(prompt_ids, samples.tokens, samples.mask, 3, 1.2)
    assert torch.allclose(shared.logprobs, samples.logprobs * samples.mask, atol=1e-4)
    for row in range(9):
        whole = torch.tensor([[*prompt_ids[row // 3], *samples.tokens[row].tolist()]])
        scores = policy.module(whole).logits[0, len(prompt_ids[row // 3]) - 1 : -1].float() / 1.2
        plain = torch.log_softmax(scores, -1).gather(-1, samples.tokens[row][:, None])[:, 0]
        assert torch.allclose(shared.logprobs[row], plain * samples.mask[row], atol=1e-4)


def test_samples_without_an_end_token_are_cut_off(policy):
    samples = policy.sample(prompts(policy), 8, 1.0, 40, torch.Generator().manual_seed(0))
    for tokens, mask, cut_off in zip(samples.tokens, samples.mask, samples.cut_off.tolist(), strict=True):
        assert cut_off == (int(tokens[mask][-1]) not in policy.end_tokens)
    assert 0 < samples.cut_off.sum() < len(samples.cut_off)


def test_shared_prompt_gives_the_same_gradient(policy):
    prompt_ids = prompts(policy, 1)
    samples = policy.sample(prompt_ids, 2, 1.0, 8, torch.Generator().manual_seed(0))

    def gradient(total):
        policy.module.zero_grad()
        total.backward()
        return torch.cat([parameter.grad.flatten() for parameter in policy.parameters()])

    shared = gradient(policy.logprobs(prompt_ids, samples.tokens, samples.mask, 2, 1.0).logprobs.sum())
    rows = [
        policy.logprobs(prompt_ids, samples.tokens[row, None], samples.mask[row, None], 1, 1.0).logprobs.sum()
        for row in range(2)
    ]
    assert torch.allclose(shared, gradient(rows[0] + rows[1]), atol=1e-4, rtol=1e-3)


def test_entropy_has_a_graph_only_on_request(policy):
    prompt_ids = prompts(policy)
    samples = policy.sample(prompt_ids, 2, 1.0, 8, torch.Generator().manual_seed(0))
    plain = policy.logprobs(prompt_ids, samples.tokens, samples.mask, 2, 1.0)
    learning = policy.logprobs(prompt_ids, samples.tokens, samples.mask, 2, 1.0, entropy_gradient=True)
    assert not plain.entropy.requires_grad
    assert learning.entropy.requires_grad
    assert torch.equal(plain.entropy, learning.entropy.detach())


def learnt_in_chunks(policy, monkeypatch, tokens):
    """Score plans with chunks of this many tokens and back-propagate log-probabilities and entropy.

    Return the scores, the gradient, and the largest number of rows of scores that any tensor of the graph had.
    """
    module, vocabulary = policy.module, policy.module.config.vocab_size
    head = module.get_output_embeddings()
    monkeypatch.setattr(token_scores, "SCORES_PER_CHUNK", tokens * vocabulary)
    prompt_ids = prompts(policy, 2)
    ids = torch.arange(4 * 7).view(4, 7) % 30 + 2
    mask = torch.arange(7) < torch.tensor([[7], [3], [5], [1]])
    rows = []

    def record(tensor):
        is_weight = tensor.data_ptr() == head.weight.data_ptr()
        if tensor.shape and tensor.shape[-1] == vocabulary and not is_weight:
            rows.append(tensor.numel() // vocabulary)
        return tensor

    hook = head.register_forward_hook(lambda *call: record(call[-1]))
    hooks = torch.autograd.graph.saved_tensors_hooks(record, lambda tensor: tensor)
    module.zero_grad()
    with hooks:
        scores = policy.logprobs(prompt_ids, ids, mask, 2, 0.9, entropy_gradient=True)
    (scores.logprobs.sum() + 0.1 * scores.entropy.sum()).backward()
    hook.remove()
    gradient = torch.cat([each.grad.flatten() for each in policy.parameters() if each.grad is not None])
    return scores, gradient, max(rows)


@pytest.mark.parametrize("lora", [False, True])
@pytest.mark.parametrize("recompute", [False, True])
def test_chunks_give_the_scores_and_the_gradient_of_the_whole(tokenizer, monkeypatch, lora, recompute):
    policy = HfPolicy(
        random_llama(tokenizer), tokenizer, Codec.LINES, "random llama", gradient_checkpointing=recompute
    )
    if lora:
        policy.adapt(LoraSettings(rank=2, alpha=4.0), seed=0)
    whole, whole_gradient, _ = learnt_in_chunks(policy, monkeypatch, 100)
    parts, gradient, largest = learnt_in_chunks(policy, monkeypatch, 3)
    assert largest <= 3
    assert torch.allclose(parts.logprobs, whole.logprobs, atol=1e-5)
    assert torch.allclose(parts.entropy, whole.entropy, atol=1e-5)
    assert torch.allclose(gradient, whole_gradient, atol=1e-5 * float(whole_gradient.abs().max()))


def test_only_scored_tokens_have_scores(policy, monkeypatch):
    assert learnt_in_chunks(policy, monkeypatch, 100)[2] == 7 + 3 + 5 + 1


def test_chunks_learn_in_automatic_mixed_precision(policy, tmp_path, monkeypatch):
    policy.save(tmp_path)
    mixed = saved_policy(tmp_path, TrainSettings(device="cpu:0"))
    whole, whole_gradient, _ = learnt_in_chunks(mixed, monkeypatch, 100)
    parts, gradient, largest = learnt_in_chunks(mixed, monkeypatch, 3)
    assert largest <= 3
    assert torch.allclose(parts.logprobs, whole.logprobs, atol=0.05)
    assert torch.allclose(gradient, whole_gradient, atol=0.02 * float(whole_gradient.abs().max()))


def capped_gemma(tokenizer):
    """Return a random Gemma 2, a family whose scores are capped after the output layer."""
    from transformers import Gemma2Config, Gemma2ForCausalLM

    torch.manual_seed(0)
    config = Gemma2Config(
        vocab_size=len(tokenizer),
        hidden_size=32,
        intermediate_size=64,
        num_hidden_layers=2,
        num_attention_heads=4,
        num_key_value_heads=2,
        head_dim=8,
        final_logit_softcapping=1.0,
        eos_token_id=tokenizer.eos_token_id,
    )
    return Gemma2ForCausalLM(config)


def test_capped_scores_are_those_of_the_model(tokenizer, monkeypatch):
    policy = HfPolicy(capped_gemma(tokenizer), tokenizer, Codec.LINES, "random gemma")
    whole, whole_gradient, _ = learnt_in_chunks(policy, monkeypatch, 100)
    parts, gradient, _ = learnt_in_chunks(policy, monkeypatch, 3)
    assert torch.allclose(parts.logprobs, whole.logprobs, atol=1e-5)
    assert torch.allclose(gradient, whole_gradient, atol=1e-5 * float(whole_gradient.abs().max()))
    prompt_ids = prompts(policy, 1)
    samples = policy.sample(prompt_ids, 2, 1.0, 6, torch.Generator().manual_seed(0))
    scored = policy.logprobs(prompt_ids, samples.tokens, samples.mask, 2, 1.0).logprobs
    assert torch.allclose(scored, samples.logprobs, atol=1e-5)
    text = torch.tensor([[*prompt_ids[0], *samples.tokens[0].tolist()]])
    scores = policy.module(text).logits[0, len(prompt_ids[0]) - 1 : -1]
    plain = torch.log_softmax(scores, -1).gather(-1, samples.tokens[0][:, None])[:, 0]
    assert torch.allclose(scored[0], plain * samples.mask[0], atol=1e-4)


def test_head_is_plain_only_if_it_gives_the_scores_of_the_model(tokenizer):
    assert token_scores.has_plain_head(random_llama(tokenizer))
    assert not token_scores.has_plain_head(capped_gemma(tokenizer).eval())
    assert not token_scores.has_plain_head(capped_gemma(tokenizer).eval().bfloat16())


@pytest.fixture
def half(policy, tokenizer):
    """Policy with the same weights in half precision."""
    model = copy.deepcopy(policy.module)
    use_compute_dtype(model, torch.bfloat16, model.get_output_embeddings())
    return HfPolicy(model, tokenizer, Codec.LINES, "random llama")


def near_float32(policy, other):
    """Check that the other policy's scores are near those of the first and of its own samples. Return samples and scores."""
    prompt_ids = prompts(policy)
    samples = other.sample(prompt_ids, 3, 1.2, 10, torch.Generator().manual_seed(0))
    scored = other.logprobs(prompt_ids, samples.tokens, samples.mask, 3, 1.2).logprobs
    apart = (scored - policy.logprobs(prompt_ids, samples.tokens, samples.mask, 3, 1.2).logprobs).abs()
    assert 0 < apart.max() < 0.1
    assert torch.allclose(scored, samples.logprobs * samples.mask, atol=0.05)
    return samples, scored


def test_bfloat16_products_are_close_and_keep_float32_weights_and_gradients(policy, half):
    _, logprobs = near_float32(policy, half)
    logprobs.sum().backward()
    assert {parameter.dtype for parameter in half.parameters()} == {torch.float32}
    assert {parameter.grad.dtype for parameter in half.parameters()} == {torch.float32}


def test_model_with_bfloat16_products_learns_and_is_saved_in_float32(half, tmp_path):
    prompt_ids = prompts(half)
    before = half.sample(prompt_ids, 2, 0.0, 6, torch.Generator()).texts
    with torch.no_grad():
        for parameter in half.parameters():
            parameter.neg_()
    after = half.sample(prompt_ids, 2, 0.0, 6, torch.Generator()).texts
    assert after != before
    half.save(tmp_path)
    back = saved_policy(tmp_path, read_settings(None, {"compute_dtype": "float32"}))
    ours, theirs = half.module.state_dict(), back.module.state_dict()
    assert list(ours) == list(theirs)
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


@pytest.mark.parametrize(("able", "compute_dtype"), [(True, torch.bfloat16), (False, None)])
def test_layers_but_not_the_head_use_bfloat16_on_capable_cpus(
    policy, tmp_path, monkeypatch, able, compute_dtype
):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": able})
    policy.save(tmp_path)
    model = saved_policy(tmp_path, read_settings(None, {})).module
    assert getattr(model.model.layers[0].mlp.down_proj, "compute_dtype", None) is compute_dtype
    assert not hasattr(model.get_output_embeddings(), "compute_dtype")


def changed_share(policy, steps=6):
    """Share of the weights that change in full fine-tuning with AdamW at a rate of 1e-5."""
    prompt_ids = prompts(policy)
    samples = policy.sample(prompt_ids, 2, 1.0, 10, torch.Generator().manual_seed(0))
    before = [parameter.detach().clone() for parameter in policy.parameters()]
    optimiser = torch.optim.AdamW(policy.parameters(), lr=1e-5, weight_decay=0.0)
    for _ in range(steps):
        optimiser.zero_grad()
        (-policy.logprobs(prompt_ids, samples.tokens, samples.mask, 2, 1.0).logprobs.sum()).backward()
        optimiser.step()
    moved = touched = 0
    for old, parameter in zip(before, policy.parameters(), strict=True):
        learning = parameter.grad != 0  # rows of words that no prompt has stay as they are
        touched += int(learning.sum())
        moved += int(((parameter != old) & learning).sum())
    return moved / touched


def test_all_weights_learn_on_a_device_that_computes_in_bfloat16(policy, tmp_path):
    policy.save(tmp_path)
    # The CPU under another name than "cpu" is treated as a GPU is.
    settings = TrainSettings(device="cpu:0")
    stored_short = HfPolicy.load(tmp_path, settings, learns=False)
    assert changed_share(stored_short) < 0.5
    learning = saved_policy(tmp_path, settings)
    assert {parameter.dtype for parameter in learning.parameters()} == {torch.float32}
    assert changed_share(learning) > 0.99


def test_automatic_mixed_precision_is_close_to_float32_and_scores_are_close_to_samples(policy, tmp_path):
    policy.save(tmp_path)
    mixed = saved_policy(tmp_path, TrainSettings(device="cpu:0"))
    samples, _ = near_float32(policy, mixed)
    prompt_ids = prompts(policy)
    exact = saved_policy(tmp_path, TrainSettings(device="cpu:0", compute_dtype="float32"))
    assert torch.equal(
        exact.logprobs(prompt_ids, samples.tokens, samples.mask, 3, 1.2).logprobs,
        policy.logprobs(prompt_ids, samples.tokens, samples.mask, 3, 1.2).logprobs,
    )


def test_adapters_learn_beside_short_fixed_weights(policy, tmp_path):
    policy.save(tmp_path)
    lora = LoraSettings(rank=2, alpha=4.0)
    adapted = HfPolicy.load(tmp_path, TrainSettings(device="cpu:0", lora=lora))
    adapted.adapt(lora, seed=0)
    assert {parameter.dtype for parameter in adapted.parameters()} == {torch.float32}
    fixed = [parameter for parameter in adapted.module.parameters() if not parameter.requires_grad]
    assert {parameter.dtype for parameter in fixed} == {torch.bfloat16}
    prompt_ids = prompts(adapted)
    samples = adapted.sample(prompt_ids, 2, 1.0, 6, torch.Generator().manual_seed(0))
    adapted.logprobs(prompt_ids, samples.tokens, samples.mask, 2, 1.0).logprobs.sum().backward()
    assert all(parameter.grad is not None for parameter in adapted.parameters())


def test_recomputed_and_frozen_scores_have_the_same_precision_as_plain_ones(policy, tmp_path):
    policy.save(tmp_path)
    prompt_ids = prompts(policy)
    plain = saved_policy(tmp_path, TrainSettings(device="cpu:0"))
    samples = plain.sample(prompt_ids, 2, 1.0, 6, torch.Generator().manual_seed(0))
    recomputing = saved_policy(tmp_path, TrainSettings(device="cpu:0", gradient_checkpointing=True))
    scores = [
        each.logprobs(prompt_ids, samples.tokens, samples.mask, 2, 1.0).logprobs
        for each in (plain, recomputing, plain.frozen_copy())
    ]
    assert torch.allclose(scores[0], scores[1], atol=0.05)
    assert torch.equal(scores[0], scores[2])
    scores[1].sum().backward()
    assert all(parameter.grad is not None for parameter in recomputing.parameters())


def test_adapters_learn_with_bfloat16_products(half, tmp_path):
    half.adapt(LoraSettings(rank=2, alpha=4.0), seed=0)
    prompt_ids = prompts(half)
    samples = half.sample(prompt_ids, 2, 1.0, 6, torch.Generator().manual_seed(0))
    half.logprobs(prompt_ids, samples.tokens, samples.mask, 2, 1.0).logprobs.sum().backward()
    assert all(parameter.grad is not None for parameter in half.parameters())
    half.save(tmp_path)
    back = saved_policy(tmp_path, read_settings(None, {"compute_dtype": "float32"}))
    assert back.module.model.layers[0].mlp.down_proj.weight.dtype is torch.float32


def test_saved_model_can_be_loaded(policy, tmp_path):
    policy.save(tmp_path)
    back = saved_policy(tmp_path, read_settings(None, {}))
    prompt_ids = prompts(policy)
    first, again = (each.sample(prompt_ids, 2, 0.0, 6, torch.Generator()).texts for each in (policy, back))
    assert first == again


def test_damaged_weights_give_a_one_sentence_error(policy, tmp_path):
    policy.save(tmp_path)
    weights_file = tmp_path / "model.safetensors"
    weights_file.write_bytes(weights_file.read_bytes()[:-40])
    with pytest.raises(TrainerError, match=r"can't be loaded \(.*\): pass `tiny`"):
        HfPolicy.load(tmp_path, TrainSettings())


def test_full_disk_leaves_the_previous_checkpoint_intact(policy, tmp_path, small_files):
    settings = read_settings(None, {})
    store = CheckpointStore(tmp_path, keep=3)
    before = store.save(policy, {}, TrainingProgress(step=1, grpo_ready=True), settings)
    with (
        small_files(10_000),
        pytest.raises(TrainerError, match=r"step-000002 can't be written .*--resume continues"),
    ):
        store.save(policy, {}, TrainingProgress(step=2, grpo_ready=True), settings)
    assert [path.name for path in tmp_path.iterdir()] == ["step-000001"]
    assert torch.equal(weights(saved_policy(before / "policy", settings)), weights(policy))


def test_missing_model_gives_a_one_sentence_error(tmp_path):
    with pytest.raises(TrainerError, match=r"is not a folder.*pass `tiny`"):
        HfPolicy.load(tmp_path / "nothing", TrainSettings())


@pytest.mark.parametrize(("name", "content"), [("a.txt", b"x"), ("a.gguf", b"no gguf at all")])
def test_invalid_gguf_gives_a_one_sentence_error(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(TrainerError):
        import_gguf(tmp_path / name, tmp_path / "out")


def train(policy, out, **changes):
    settings = read_settings(
        None, {k.replace("__", "."): v for k, v in changes.items()}, LANGUAGE_MODEL_DEFAULTS
    )
    start = RunStart(settings, TASKS, policy, TrainingProgress())
    display = LineDisplay(Console(quiet=True))
    with Gateway(lambda: SymbolicCluster(TASKS), TASKS.bundle_bytes, run_name="hf") as gateway:
        return TrainingRun(start, gateway, display, out).run()


def weights(policy):
    return torch.cat([parameter.detach().flatten() for parameter in policy.parameters()]).clone()


def test_random_llama_completes_a_run(policy, tmp_path):
    before = weights(policy)
    summary = train(
        policy,
        tmp_path,
        imitation__steps=2,
        grpo__steps=2,
        grpo__tasks_per_step=2,
        grpo__group=2,
        grpo__max_new=8,
        evaluation__samples=1,
    )
    assert summary.outcome.steps == 2
    assert not torch.equal(before, weights(policy))
    assert (summary.checkpoint / "policy" / "config.json").exists()


@pytest.mark.hf
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_smollm2_takes_real_grpo_steps(smollm2_folder, tmp_path):
    torch.set_num_threads(default_threads())
    policy = HfPolicy.load(smollm2_folder, TrainSettings())
    before = weights(policy)
    summary = train(
        policy,
        tmp_path,
        imitation__steps=24,
        imitation__learning_rate=3e-4,
        grpo__steps=3,
        grpo__tasks_per_step=2,
        grpo__group=3,
        grpo__max_new=32,
        grpo__learning_rate=2e-5,
        evaluation__samples=1,
    )
    rows = read_metrics(tmp_path)
    assert [row["step"] for row in rows] == [1, 2, 3]
    learnt = [row for row in rows if row["zero_variance_groups"] < 1]
    assert learnt
    assert all(math.isfinite(row[name]) for row in learnt for name in ("gradient_norm", "kl", "reward"))
    assert summary.outcome.rollouts == 18
    assert not torch.equal(before, weights(policy))


def test_model_folder_without_a_tokenizer_is_rejected(tmp_path):
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(TrainerError, match=r"has no tokenizer: copy the model's tokenizer\.json"):
        HfPolicy.load(tmp_path, TrainSettings())


def test_missing_folder_is_reported_before_missing_transformers(tmp_path, monkeypatch):
    for library in ("transformers", "huggingface_hub"):
        monkeypatch.setitem(sys.modules, library, None)
    (tmp_path / "tokenizer.json").write_text("{}")
    with pytest.raises(TrainerError, match=rf"the model '{tmp_path}' needs transformers: `pip install"):
        HfPolicy.load(tmp_path, TrainSettings())
    with pytest.raises(TrainerError, match="'runs/nowhere' is not a folder, and a Hugging Face model needs"):
        HfPolicy.load("runs/nowhere", TrainSettings())


def test_trained_policy_keeps_its_codec_and_other_models_use_json(policy, tokenizer, tmp_path):
    policy.save(tmp_path / "taught")
    model = copy.deepcopy(policy.module)
    del model.config.embomatrix_codec
    model.save_pretrained(tmp_path / "other")
    tokenizer.save_pretrained(tmp_path / "other")

    def codec(name, requested):
        return load_model(str(tmp_path / name), requested, threads=1, device="cpu")[0].codec

    assert codec("taught", None) is Codec.LINES
    assert codec("taught", Codec.JSON) is Codec.JSON
    assert codec("other", None) is Codec.JSON
    assert codec("other", Codec.LINES) is Codec.LINES
