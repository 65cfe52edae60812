"""Request forms of vLLM and SGLang: contents of requests, and answers that hold no plans."""

import json
from pathlib import Path

import pytest

from embomatrix.trainer.config.settings import ServerKind
from embomatrix.trainer.serving.forms import (
    FORMS,
    AbortedError,
    AnswerError,
    OldWeightsError,
    PlanRequest,
    ServedPlan,
    Weights,
)

VLLM, SGLANG = FORMS[ServerKind.VLLM], FORMS[ServerKind.SGLANG]
ADAPTERS = Weights("run-3", Path("/shared/run-3/adapter"), are_adapters=True)
MODEL = Weights("run-4", Path("/shared/run-4"), are_adapters=False)
ONE = PlanRequest(((5, 6), (7,)), 1, 0.9, 8, (2,), 11)


def choice(index, **changes):
    logprobs = {"tokens": ["token_id:4", "token_id:2"], "token_logprobs": [-0.5, -0.25]}
    return {"index": index, "text": "a", "logprobs": logprobs, "token_ids": [4, 2], **changes}


def completions(*choices):
    return json.dumps({"choices": list(choices)}).encode()


def generation(version="run-4", **changes):
    meta = {
        "finish_reason": {"type": "stop", "matched": 2},
        "weight_version": version,
        "output_token_logprobs": [[-0.5, 4, None], [-0.25, 2, None]],
    }
    return {"text": "a", "meta_info": {**meta, **changes}}


PLAN = ServedPlan((4, 2), (-0.5, -0.25), "a")


def test_requests_repeat_each_prompt_or_ask_for_several_plans_and_fix_all_sampling_parameters():
    request = PlanRequest(((5, 6), (7,)), 2, 0.9, 8, (2, 3), 11)
    body = VLLM.sampling(request, ADAPTERS).body
    assert (body["model"], body["prompt"], body["n"], body["seed"]) == ("run-3", [[5, 6], [7]], 2, 11)
    other = SGLANG.sampling(request, ADAPTERS).body
    assert (other["lora_path"], other["input_ids"]) == ("run-3", [[5, 6], [5, 6], [7], [7]])
    assert "lora_path" not in SGLANG.sampling(request, MODEL).body
    for parameters in (body, other["sampling_params"]):
        assert (parameters["temperature"], parameters["top_p"], parameters["top_k"]) == (0.9, 1.0, -1)
        assert (parameters["min_p"], parameters["repetition_penalty"]) == (0.0, 1.0)
        assert parameters["stop_token_ids"] == [2, 3]


def test_new_weights_have_a_request_on_each_server():
    assert VLLM.loading(ADAPTERS).path == "/v1/load_lora_adapter"
    assert SGLANG.loading(ADAPTERS).body == {"lora_name": "run-3", "lora_path": "/shared/run-3/adapter"}
    call = SGLANG.loading(MODEL)
    assert call.path == "/update_weights_from_disk"
    assert call.body == {"model_path": "/shared/run-4", "weight_version": "run-4"}
    assert SGLANG.unloading(MODEL) is None


def test_plans_have_the_order_of_their_prompts():
    other = choice(1, token_ids=[9], logprobs={"tokens": ["x"], "token_logprobs": [0.0]}, text="b")
    assert VLLM.plans(completions(other, choice(0)), ONE, ADAPTERS) == [PLAN, ServedPlan((9,), (0.0,), "b")]
    both = json.dumps([generation(), generation(output_token_logprobs=[[-1.0, 9, None]])]).encode()
    assert [plan.tokens for plan in SGLANG.plans(both, ONE, MODEL)] == [(4, 2), (9,)]


def test_older_vllm_gives_token_ids_as_texts():
    old = choice(0)
    del old["token_ids"]
    assert VLLM.plans(completions(old, choice(1)), ONE, ADAPTERS) == [PLAN, PLAN]


@pytest.mark.parametrize(
    ("answer", "error", "sentence"),
    [
        (b"<html>", AnswerError, "not a list of completions"),
        (completions(choice(0)), AnswerError, "returns 1 plans for 2"),
        (completions(choice(0), choice(1, logprobs=None)), AnswerError, "returns no log-probabilities"),
        (
            completions(choice(0), choice(1, logprobs={"tokens": ["a"], "token_logprobs": [None]})),
            AnswerError,
            "0 log-probabilities for a plan of 2 tokens",
        ),
        (
            completions(
                choice(0), choice(1, token_ids=None, logprobs={"tokens": ["a"], "token_logprobs": [-1]})
            ),
            AnswerError,
            "returns no token ids",
        ),
        (
            completions(choice(0), choice(1, token_ids=[-4, 2])),
            AnswerError,
            "token ids that no tokenizer has",
        ),
        (completions(choice(0), choice(1, finish_reason="abort")), AbortedError, "aborted a plan"),
    ],
)
def test_answer_of_vllm_without_plans_is_refused(answer, error, sentence):
    with pytest.raises(error, match=sentence):
        VLLM.plans(answer, ONE, ADAPTERS)


@pytest.mark.parametrize(
    ("second", "error", "sentence"),
    [
        ({}, AnswerError, "not a list of generations"),
        (generation("default"), OldWeightsError, "sampled from the weights 'default'"),
        (generation(output_token_logprobs=None), AnswerError, "returns no log-probabilities"),
        (generation(output_token_logprobs=[]), AnswerError, "a plan of 0 tokens"),
        (
            generation(output_token_logprobs=[[2.5, 4, None]]),
            AnswerError,
            "0 log-probabilities for a plan of 1",
        ),
        (
            generation(finish_reason={"type": "abort", "message": "shutting down"}),
            AbortedError,
            "aborted a plan .shutting down",
        ),
    ],
)
def test_answer_of_sglang_without_plans_is_refused(second, error, sentence):
    with pytest.raises(error, match=sentence):
        SGLANG.plans(json.dumps([generation(), second]).encode(), ONE, MODEL)
