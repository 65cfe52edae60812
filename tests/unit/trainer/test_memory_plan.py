"""Arithmetic of the memory plan, on sizes that can be counted by hand."""

from dataclasses import replace

import pytest
import torch

from embomatrix.trainer.config.settings import (
    LANGUAGE_MODEL_DEFAULTS,
    LoraSettings,
    TrainSettings,
    read_settings,
)
from embomatrix.trainer.imitation.optimiser import _matrices
from embomatrix.trainer.policy.decoder import Decoder, DecoderShape
from embomatrix.trainer.policy.footprint import (
    FULL_BYTES,
    LORA_BYTES,
    Batch,
    LanguageModelFootprint,
    LanguageModelShape,
    Matrix,
    Precision,
    WordLevelFootprint,
    precision_of,
)
from embomatrix.trainer.policy.memory_plan import Lengths, MemoryPlan, Part, Phase, advice, plan_memory
from embomatrix.trainer.policy.token_scores import SCORES_PER_CHUNK

SHAPE = LanguageModelShape(
    parameters=1000,
    vocabulary=10,
    layers=2,
    width=8,
    inner=16,
    heads=2,
    key_value_heads=1,
    head_width=4,
    matrices=(Matrix("q_proj", 8, 8), Matrix("down_proj", 16, 8)),
)
LENGTHS = Lengths(prompt=30, oracle=5)


def footprint(precision=Precision.FLOAT32, *, rank=0, recomputes=False):
    return LanguageModelFootprint(SHAPE, precision, LoraSettings(rank=rank), recomputes)


def settings(**changes):
    given = {"device": "cuda", **{name.replace("__", "."): value for name, value in changes.items()}}
    return read_settings(None, given, LANGUAGE_MODEL_DEFAULTS)


def plan(**changes):
    chosen = settings(**changes)
    precision = precision_of(chosen, casts=False)
    return plan_memory(
        chosen,
        LanguageModelFootprint(SHAPE, precision, chosen.lora, chosen.gradient_checkpointing),
        LENGTHS,
    )


def test_full_fine_tuning_takes_twenty_bytes_per_parameter_and_adamws_denominators():
    parts = plan().parts[Phase.STEP]
    assert parts[Part.WEIGHTS] == parts[Part.GRADIENTS] == parts[Part.REFERENCE] == 4000
    assert parts[Part.OPTIMISER] == 8000
    assert parts[Part.ACTIVATIONS] == 4000
    assert plan(device="cpu").parts[Phase.STEP][Part.ACTIVATIONS] == 2 * 4 * 10 * 8


def test_adapters_learn_beside_frozen_bfloat16_weights():
    adapted = footprint(Precision.BFLOAT16, rank=2)
    adapters = 2 * (8 + 8) + 2 * (16 + 8)
    assert adapted.learning == adapters
    assert adapted.weights == 1000 * 2 + adapters * 4
    assert adapted.reference == adapters * 4
    one = replace(adapted, lora=LoraSettings(rank=2, targets=("q_proj",)))
    assert one.learning == 2 * (8 + 8)
    # A checkpoint is merged in a copy of the model.
    assert plan(lora__rank=2).parts[Phase.CHECKPOINT][Part.COPIES] == adapted.weights
    assert Phase.CHECKPOINT not in plan().parts


def test_cache_grows_with_plans_and_layers():
    usage = footprint().sampled(Batch(prompts=2, group=3, prompt=30, new=500))
    cache = 2 * 6 * 530 * 4 * 8  # layers, plans, positions, width of the keys, bytes of a key and a value
    assert usage.cache == cache + cache // 4
    assert usage.logits == 5 * 4 * 6 * 10


def test_scores_stay_within_a_chunk():
    wide = replace(footprint(), shape=replace(SHAPE, vocabulary=2**20))
    usage = wide.learnt(Batch(1, 8, 30, 100), entropy=False)
    assert usage.logits == 3 * 4 * SCORES_PER_CHUNK
    assert wide.learnt(Batch(1, 8, 30, 100), entropy=True).logits == 5 * 4 * SCORES_PER_CHUNK


def test_activations_of_one_plan_are_counted_by_hand():
    saved = footprint()._saved(Batch(prompts=1, group=1, prompt=3, new=3))
    tokens, length = 3 + 2, 3 + 2
    per_token = (16 + 8) * 8 + 8 * 8 + 16 * 16
    keys_of_prompt, keys_of_plan, mask = 2 * 4 * 3 * 4, 2 * 4 * length * 8, 4 * 2 * length
    last_norm = 2 * 4 * 8 * tokens
    assert saved == 2 * (tokens * per_token + keys_of_prompt + keys_of_plan + mask) + last_norm


def test_recomputation_keeps_one_input_for_each_layer():
    batch = Batch(prompts=1, group=4, prompt=30, new=11)
    assert footprint(recomputes=True)._saved_recomputed(batch) == 4 * 40 * 8 * (2 * 4 + 2 * 4)


def test_every_precision_has_its_bytes():
    assert set(FULL_BYTES) | set(LORA_BYTES) == set(Precision)
    found = {
        precision_of(settings(device=device, lora__rank=rank, compute_dtype=dtype), casts=dtype == "bfloat16")
        for device in ("cpu", "cuda")
        for rank in (0, 4)
        for dtype in ("bfloat16", "float32")
    }
    assert found == set(Precision)


@pytest.mark.parametrize(
    "changes", [{"layers": 1}, {"width": 32, "heads": 2}, {"vocabulary": 7, "inner": 20}]
)
def test_word_level_parameters_are_those_of_the_network(changes):
    shape = replace(DecoderShape(vocabulary=50, layers=2, width=16, heads=4, inner=24, longest=32), **changes)
    network = Decoder(shape, torch.Generator().manual_seed(0))
    counted = WordLevelFootprint(shape, casts=False)
    assert counted.learning == sum(parameter.numel() for parameter in network.parameters())
    assert counted.matrices == sum(matrix.numel() for matrix in _matrices(network))


def test_without_a_kl_term_there_is_no_reference():
    without, full = plan(grpo__kl_coef=0.0), plan()
    assert {parts[Part.REFERENCE] for parts in without.parts.values()} == {0}
    assert full.total(Phase.UPDATE) - without.total(Phase.UPDATE) == 4000


def test_with_a_model_server_the_trainer_scores_its_plans_and_samples_nothing():
    served = plan(sampler__url="http://localhost:8000", grpo__kl_coef=0.0)
    alone = plan(grpo__kl_coef=0.0)
    assert set(alone.parts) - set(served.parts) == {Phase.EVALUATION}
    scored = footprint(precision_of(settings(), casts=False)).scored(
        Batch(1, settings().grpo.group, 30, settings().grpo.max_new)
    )
    assert served.parts[Phase.SAMPLING][Part.CACHE] == scored.cache
    assert served.parts[Phase.SAMPLING][Part.ACTIVATIONS] == scored.activations
    assert served.parts[Phase.UPDATE] == alone.parts[Phase.UPDATE]


def test_imitation_has_no_reference_and_muon_one_moment():
    parts = plan(imitation__patience=2).parts[Phase.IMITATION]
    assert parts[Part.REFERENCE] == 0
    assert parts[Part.WEIGHTS] == 2 * 4000  # the best weights are kept beside the current ones
    assert parts[Part.OPTIMISER] == 8000
    muon = plan(imitation__optimiser="muon").parts[Phase.IMITATION]
    assert muon[Part.OPTIMISER] == 8000 - 4 * (8 * 8 + 16 * 8)
    assert Phase.IMITATION not in plan(imitation__steps=0).parts


def test_first_microbatch_of_a_step_has_no_earlier_gradient():
    single, several = (plan(grpo__tasks_per_step=tasks).parts[Phase.UPDATE] for tasks in (1, 4))
    assert several[Part.GRADIENTS] - single[Part.GRADIENTS] == 4000


def test_kept_groups_do_not_raise_the_peak():
    assert plan(grpo__zero_variance="keep") == plan(grpo__zero_variance="skip")


def test_advice_is_the_change_with_the_lowest_peak():
    peaks = {"grpo.chunk = 1": 50, "evaluation.chunk = 1": 40}

    def planned(changed: TrainSettings) -> MemoryPlan:
        low = {
            "grpo.chunk = 1": changed.grpo.chunk == 1,
            "evaluation.chunk = 1": changed.evaluation.chunk == 1,
        }
        peak = min((peaks[change] for change, is_set in low.items() if is_set), default=60)
        return MemoryPlan({Phase.UPDATE: {Part.LOGITS: peak}})

    best = advice(TrainSettings(), planned, word_level=True)
    assert best is not None
    assert (best.change, best.peak) == ("evaluation.chunk = 1", 40)
    constant = MemoryPlan({Phase.UPDATE: {Part.LOGITS: 1}})
    assert advice(TrainSettings(), lambda _: constant, word_level=True) is None


def test_gradients_of_plans_wait_for_those_of_prompts():
    long_prompt = Batch(prompts=1, group=1, prompt=30, new=2)
    wide = replace(SHAPE, parameters=10**6)
    usage = replace(footprint(), shape=wide).learnt(long_prompt, entropy=False)
    assert usage.gradients == 4 * (10**6 - 80)
    tied = replace(footprint(), shape=replace(wide, tied=True)).learnt(long_prompt, entropy=False)
    assert tied.gradients == 4 * (10**6 + 2 * 80)
    assert usage.activations == footprint()._saved_of_prompts(long_prompt) + 2 * 4 * 2 * 30 * 4
    # Recomputation runs each plan with its prompt in one pass.
    alone = LanguageModelFootprint(wide, Precision.FLOAT32, LoraSettings(), recomputes=True)
    assert alone.learnt(long_prompt, entropy=False).gradients <= 4 * 80
