"""Sampling by a model server: equal tokens, new weights after each step, interruptions, and servers that can't serve."""

import contextlib
import threading
import time
from concurrent.futures import CancelledError

import pytest
import torch
from rich.console import Console
from tests.fakes.model_server import SGLANG, VLLM, ServedLlama
from tests.fakes.small_llama import random_llama
from tests.fakes.symbolic_household import SymbolicCluster
from tests.integration.trainer.conftest import SMALL_TASKS

from embomatrix.skills.prompt import Codec
from embomatrix.trainer.cluster.gateway import Gateway
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import LANGUAGE_MODEL_DEFAULTS, read_settings
from embomatrix.trainer.learning.learner import SamplingParams
from embomatrix.trainer.lifecycle.checkpoint import CHECKPOINTS, CheckpointStore, TrainingProgress, read_state
from embomatrix.trainer.logging.display import LineDisplay
from embomatrix.trainer.logging.recorder import read_metrics
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.loading import new_policy, saved_policy
from embomatrix.trainer.run.loop import TrainingRun
from embomatrix.trainer.run.starting import REFERENCE, RunStart

TASKS = SMALL_TASKS
ADAPTERS = {"lora.rank": 4, "lora.alpha": 8.0}
SHORT = {
    "compute_dtype": "float32",
    "imitation.steps": 2,
    "imitation.learning_rate": 1e-2,
    "grpo.steps": 3,
    "grpo.tasks_per_step": 2,
    "grpo.group": 3,
    "grpo.max_new": 8,
    "grpo.learning_rate": 1e-2,
    "grpo.temperature": 0.8,
    "grpo.entropy_coef": 0.1,  # plans of a random model earn equal rewards, and only this term moves its weights
    "grpo.warmup_steps": 0,
    "evaluation.samples": 1,
    "checkpoint_every": 9,
    "sampler.retry_s": 1.0,
}
FORMS = {
    "vllm": (VLLM, "/v1/completions", "/v1/load_lora_adapter", ADAPTERS),
    "sglang adapters": (SGLANG, "/generate", "/load_lora_adapter", ADAPTERS),
    "sglang weights": (SGLANG, "/generate", "/update_weights_from_disk", {}),
}
EXACT = 1e-4
"""Nats by which two computations of one small model in float32 may differ."""
PROBE = 2
"""Plans of the check at the start."""


def started(folder, url, changes):
    """Return the start of a new run."""
    given = {**SHORT, "model": str(folder), "sampler.url": url, **changes}
    settings = read_settings(None, given, LANGUAGE_MODEL_DEFAULTS)
    return RunStart(settings, TASKS, new_policy(settings, TASKS), TrainingProgress())


def resumed(out):
    newest = CheckpointStore(out / CHECKPOINTS, keep=9).latest()
    progress, settings = read_state(newest)
    reference = saved_policy(out / REFERENCE, settings).frozen_copy() if progress.grpo_ready else None
    return RunStart(settings, TASKS, saved_policy(newest / "policy", settings), progress, reference)


def train(start, out):
    with (
        start.model_server(out) as server,
        Gateway(lambda: SymbolicCluster(TASKS), TASKS.bundle_bytes, run_name="served") as gateway,
    ):
        return TrainingRun(start, gateway, LineDisplay(Console(quiet=True)), out, (), server).run()


@pytest.mark.parametrize("form", FORMS)
def test_learnt_tokens_are_the_sampled_ones_and_their_log_probabilities_are_the_policys_own(
    model_folder, tmp_path, form
):
    kind, path, _, changes = FORMS[form]
    served = ServedLlama(model_folder, kind)
    with served.serving() as url:
        start = started(model_folder, url, {"sampler.kind": kind, **changes})
        prompts = [start.prompt_builder.plain(task).tokens for task in TASKS.train[:2]]
        with start.model_server(tmp_path) as sampler:
            samples = sampler.begin(prompts, 5, SamplingParams(3, 0.8, 8))()
        body, answer = served.bodies(path)[-1], served.calls[-1 if changes == {} else -2][2]
    rows = [row[own].tolist() for row, own in zip(samples.tokens, samples.mask, strict=True)]
    if kind == VLLM:
        assert body["prompt"] == [list(prompt) for prompt in prompts]
        assert rows == [choice["token_ids"] for choice in reversed(answer["choices"])]
    else:
        assert body["input_ids"] == [list(prompt) for prompt in prompts for _ in range(3)]
        assert rows == [each["output_ids"] for each in answer]
    own = start.policy.logprobs(prompts, samples.tokens, samples.mask, 3, 0.8).logprobs
    assert torch.allclose(own, samples.logprobs, atol=EXACT)
    ends = [row[-1] in start.policy.end_tokens for row in rows]
    assert samples.cut_off.tolist() == [not end for end in ends]


@pytest.mark.parametrize("form", FORMS)
def test_server_has_the_weights_of_each_step_before_it_samples_the_next(model_folder, tmp_path, form):
    kind, path, load, changes = FORMS[form]
    served = ServedLlama(model_folder, kind)
    with served.serving() as url:
        start = started(model_folder, url, {"sampler.kind": kind, **changes})
        summary = train(start, tmp_path)
    assert summary.outcome.steps == 3
    rows = read_metrics(tmp_path)
    assert max(row["sampler_gap_max"] for row in rows) < EXACT
    assert all(0 < row["sampler_gap"] <= row["sampler_gap_max"] for row in rows)
    names = list(served.loaded)
    assert len(names) == len(served.bodies(load)) == 5  # at the start, after imitation, after each step
    order = [at for at, _, _ in served.calls if at in (load, path)]
    step = [path, path, load]
    # The check, the evaluation before GRPO, three steps of two tasks, the evaluation after them.
    assert order == [load, path, load, path, *step, *step, *step, path]
    last, former = served.loaded[names[-1]], served.loaded[names[-2]]
    own = start.policy.module.state_dict()
    assert any(not torch.equal(last[name], former[name]) for name in last)
    assert all(torch.equal(last[name], own[name]) for name in last)
    assert served.adapters == set()  # the run removes its adapters
    assert not (tmp_path / "sampler").exists()


def test_other_arithmetic_of_the_server_is_logged(model_folder, tmp_path):
    with ServedLlama(model_folder, shift=-0.2).serving() as url:
        train(started(model_folder, url, {**ADAPTERS, "grpo.steps": 1}), tmp_path)
    (row,) = read_metrics(tmp_path)
    assert row["sampler_gap"] == pytest.approx(0.2, abs=EXACT)
    assert row["sampler_gap_max"] == pytest.approx(0.2, abs=EXACT)


def test_reserve_and_step_ahead_are_sampled_by_the_server_too(model_folder, tmp_path):
    served = ServedLlama(model_folder)
    with served.serving() as url:
        changes = {**ADAPTERS, "grpo.overlap": "ahead", "grpo.reserve": 1, "imitation.steps": 0}
        train(started(model_folder, url, changes), tmp_path)
    rows = read_metrics(tmp_path)
    assert any(row["groups"] > 2 for row in rows)
    drawn = [len(body["prompt"]) * body["n"] for body in served.bodies("/v1/completions")]
    ahead = 2 * 3  # plans of a fourth step, which the third one samples
    assert sum(drawn) == PROBE + 2 * len(TASKS.heldout) + sum(row["rollouts"] for row in rows) + ahead


def test_run_ends_with_a_sentence_when_the_server_dies_and_resumes_with_the_next_one(model_folder, tmp_path):
    # The check, the evaluation and the first step take 2 + 2 + 6 plans; the server dies in the second step.
    with ServedLlama(model_folder, dies_at=14).serving() as url:
        start = started(model_folder, url, ADAPTERS)
        with pytest.raises(
            TrainerError, match=r"can't be reached .*, for 1 s: start it again, and continue with --resume"
        ):
            train(start, tmp_path)
    assert read_state(CheckpointStore(tmp_path / CHECKPOINTS, keep=9).latest())[0].step == 1
    port = int(url.rpartition(":")[2])
    served = ServedLlama(model_folder)
    with served.serving(port):
        summary = train(resumed(tmp_path), tmp_path)
    assert summary.outcome.steps == 3
    assert [row["step"] for row in read_metrics(tmp_path)] == [1, 2, 3]


@pytest.mark.parametrize("form", FORMS)
def test_restarted_server_gets_the_weights_again_and_the_run_goes_on(model_folder, tmp_path, form):
    kind, _, _, changes = FORMS[form]
    first, second = ServedLlama(model_folder, kind, dies_at=14), ServedLlama(model_folder, kind)
    with contextlib.ExitStack() as stack:
        url = stack.enter_context(first.serving())

        def restart():
            while first.alive:
                time.sleep(0.02)
            stack.enter_context(second.serving(int(url.rpartition(":")[2])))

        thread = threading.Thread(target=restart)
        thread.start()
        summary = train(
            started(model_folder, url, {"sampler.kind": kind, "sampler.retry_s": 60.0, **changes}), tmp_path
        )
        thread.join()
    assert summary.outcome.steps == 3
    assert next(iter(second.loaded)) == list(first.loaded)[-1]
    assert max(row["sampler_gap_max"] for row in read_metrics(tmp_path)) < EXACT


REFUSALS = {
    "no log-probabilities": (
        {"faults": ("logprobs",)},
        {},
        r"it returns no log-probabilities: serve the model with vLLM",
    ),
    "no token ids": (
        {"faults": ("token_ids",)},
        {},
        r"it returns no token ids: serve the model with vLLM or SGLang",
    ),
    "no adapters": (
        {"faults": ("adapters",)},
        {},
        r"404 to /v1/load_lora_adapter .* start it with VLLM_ALLOW_RUNTIME_LORA_UPDATING=True, --enable-lora",
    ),
    "short context": (
        {"context": 100},
        {},
        r"takes 100 tokens with random-llama, and the longest prompt and plan have \d+: start it with --max-model-len \d+",
    ),
    "log-probabilities at temperature 1": (
        {"faults": ("temperature",)},
        {"grpo.temperature": 0.5},
        r"at temperature 1, and grpo\.temperature is 0\.5: start vLLM with --logprobs-mode processed_logprobs",
    ),
    "the other kind": (
        {},
        {"sampler.kind": "sglang"},
        r"404 to /load_lora_adapter .*check sampler\.url, sampler\.kind",
    ),
}


@pytest.mark.parametrize("fault", REFUSALS)
def test_unsuitable_server_is_refused_before_imitation(model_folder, tmp_path, fault):
    options, changes, sentence = REFUSALS[fault]
    with ServedLlama(model_folder, **options).serving() as url:
        start = started(model_folder, url, {**ADAPTERS, **changes})
        with pytest.raises(TrainerError, match=sentence):
            train(start, tmp_path)
    assert start.progress.imitation.step == 0
    assert not (tmp_path / "sampler").exists()


def test_server_with_another_model_is_refused(model_folder, tokenizer, tmp_path):
    other = HfPolicy(random_llama(tokenizer, seed=1), tokenizer, Codec.LINES, "another llama")
    other.save(tmp_path / "other")
    with ServedLlama(tmp_path / "other").serving() as url:
        start = started(model_folder, url, ADAPTERS)
        with pytest.raises(
            TrainerError, match=r"differ from those of .* nats per token, .* another model or tokenizer"
        ):
            train(start, tmp_path / "run")


def test_server_with_a_larger_vocabulary_is_refused(model_folder, tokenizer, tmp_path):
    wide = random_llama(tokenizer)
    wide.resize_token_embeddings(20 * len(tokenizer))
    HfPolicy(wide, tokenizer, Codec.LINES, "wide llama").save(tmp_path / "wide")
    with ServedLlama(tmp_path / "wide", SGLANG).serving() as url:
        start = started(model_folder, url, {**ADAPTERS, "sampler.kind": "sglang", "grpo.temperature": 50.0})
        with pytest.raises(
            TrainerError, match=r"sampled the token \d+, and .* has \d+ tokens: serve the model"
        ):
            train(start, tmp_path / "run")


def test_absent_server_is_named_before_imitation(model_folder, tmp_path):
    start = started(model_folder, "http://127.0.0.1:9", ADAPTERS)
    with pytest.raises(
        TrainerError,
        match=r"http://127\.0\.0\.1:9: it can't be reached .*: start it first, or correct sampler\.url",
    ):
        train(start, tmp_path)


def test_wrong_address_is_named(model_folder, tmp_path):
    start = started(model_folder, "http://ä" + 70 * "a", ADAPTERS)
    with pytest.raises(
        TrainerError, match=r"sampler\.url 'http://ä.*' is not an address .*: expected http://HOST:PORT"
    ):
        train(start, tmp_path)


def test_whole_model_on_vllm_is_refused_with_the_two_ways_out(model_folder, tmp_path):
    start = started(model_folder, "http://127.0.0.1:9", {})
    with pytest.raises(TrainerError, match=r"set lora\.rank, or serve the model with SGLang"):
        train(start, tmp_path)


def test_weights_that_another_program_loads_end_the_run(model_folder, tmp_path):
    served = ServedLlama(model_folder, SGLANG)
    with served.serving() as url:
        start = started(model_folder, url, {"sampler.kind": "sglang"})
        with start.model_server(tmp_path) as sampler:
            served.forced_version = "of another run"
            with pytest.raises(
                TrainerError, match=r"sampled from the weights .*: give this run a server of its own"
            ):
                sampler.begin([(2, 3)], 0, SamplingParams(2, 1.0, 4))()


def test_end_of_a_run_does_not_wait_for_unfinished_plans(model_folder, tmp_path):
    served = ServedLlama(model_folder)
    with served.serving() as url:
        start = started(model_folder, url, ADAPTERS)
        with start.model_server(tmp_path) as sampler:
            served.hold.clear()
            wait = sampler.begin([(2, 3)], 0, SamplingParams(2, 1.0, 4))
            began_s = time.monotonic()
        assert time.monotonic() - began_s < 10
        with pytest.raises(CancelledError):
            wait()
