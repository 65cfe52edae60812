"""Word-level policy: shared prompts, vocabulary, saving and loading."""

import json
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tests.fakes.symbolic_household import make_tasks

from embomatrix.skills.prompt import Codec, plan_in_names, prompt_for
from embomatrix.skills.syntax import PROFILES, SIGNATURES, Arg, PlaceRelation
from embomatrix.trainer.cluster.gateway import parse_policy_text
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import TrainSettings
from embomatrix.trainer.policy.decoder import DecoderShape, Shortlist
from embomatrix.trainer.policy.loading import saved_policy
from embomatrix.trainer.policy.tiny import TinyPolicy
from embomatrix.trainer.policy.vocabulary import (
    BREAK,
    END,
    GO,
    SPECIAL,
    UNKNOWN,
    Vocabulary,
    build_vocabulary,
)
from embomatrix.world.task import Profile

TASKS = make_tasks(12, 3)
WORDS = build_vocabulary(
    [task.situation for task in (*TASKS.train, *TASKS.heldout)],
    [task.task.instruction for task in TASKS.train],
)
SHAPE = DecoderShape(len(WORDS), layers=2, width=32, heads=2, inner=64)


def policy(seed=0, compute_dtype=torch.float32):
    made = TinyPolicy(WORDS, SHAPE, seed=seed, compute_dtype=compute_dtype)
    with torch.no_grad():
        for parameter in made.parameters():  # far from uniform, so that differences would show
            parameter.mul_(4 if parameter.dim() > 1 else 1)
    return made


def prompts(made, count=3):
    return [made.encode(prompt_for(task.situation, Codec.NAMES)) for task in TASKS.train[:count]]


def draw(made, prompt_ids, group=4, temperature=1.3, seed=0):
    return made.sample(prompt_ids, group, temperature, 12, torch.Generator().manual_seed(seed))


def test_sampler_and_update_agree_on_log_probabilities():
    made = policy()
    prompt_ids = prompts(made)
    samples = draw(made, prompt_ids)
    scored = made.logprobs(prompt_ids, samples.tokens, samples.mask, 4, 1.3)
    assert torch.allclose(scored.logprobs, samples.logprobs * samples.mask, atol=1e-5)
    assert (scored.entropy[samples.mask] >= 0).all()  # 0 where one word alone may follow
    assert (scored.entropy[samples.mask] > 0).any()


@pytest.mark.parametrize("in_grammar", [True, False])
def test_words_that_no_plan_of_the_batch_contains_change_no_value(in_grammar, monkeypatch):
    made = policy()
    prompt_ids = prompts(made)
    samples = draw(made, prompt_ids)
    tokens = samples.tokens.clone()
    if not in_grammar:  # plans of other sources contain words that no prompt names
        tokens[samples.mask] = torch.arange(int(samples.mask.sum())) % len(WORDS)

    def scored():
        made.module.zero_grad()
        found = made.logprobs(prompt_ids, tokens, samples.mask, 4, 1.3)
        found.logprobs.sum().backward()
        return found, [parameter.grad.clone() for parameter in made.parameters()]

    included_words = []
    shortlisted, gradients = scored()
    monkeypatch.setattr(
        Shortlist, "of", lambda included: included_words.append(int(included.sum())) or every_word(included)
    )
    whole, expected = scored()
    assert not in_grammar or included_words[0] < len(WORDS)
    assert torch.allclose(shortlisted.logprobs, whole.logprobs, atol=1e-5)
    assert torch.allclose(shortlisted.entropy, whole.entropy, atol=1e-5)
    for one, other in zip(gradients, expected, strict=True):
        assert torch.allclose(one, other, atol=1e-4 * float(other.abs().max()) + 1e-7)
    assert torch.equal(draw(made, prompt_ids).tokens, samples.tokens)


def every_word(included):
    numbers = torch.arange(len(included))
    return Shortlist(numbers, numbers)


def test_entropy_has_a_graph_only_on_request():
    made = policy()
    prompt_ids = prompts(made)
    samples = draw(made, prompt_ids)
    plain = made.logprobs(prompt_ids, samples.tokens, samples.mask, 4, 1.3)
    learning = made.logprobs(prompt_ids, samples.tokens, samples.mask, 4, 1.3, entropy_gradient=True)
    assert not plain.entropy.requires_grad
    assert learning.entropy.requires_grad
    assert torch.equal(plain.entropy, learning.entropy.detach())
    assert torch.equal(plain.logprobs, learning.logprobs)


def test_padding_and_prompt_sharing_do_not_change_values_or_gradients():
    made = policy()
    prompt_ids = [prompts(made)[0][:9], *prompts(made)[1:]]
    samples = draw(made, prompt_ids)

    def gradient(scored):
        made.module.zero_grad()
        scored.sum().backward()
        return torch.cat([parameter.grad.flatten() for parameter in made.parameters()])

    together = made.logprobs(prompt_ids, samples.tokens, samples.mask, 4, 1.0).logprobs
    shared = gradient(together)
    alone = torch.cat(
        [
            made.logprobs(
                [prompt_ids[row // 4]], samples.tokens[row, None], samples.mask[row, None], 1, 1.0
            ).logprobs
            for row in range(12)
        ]
    )
    assert torch.allclose(together, alone, atol=1e-5)
    assert torch.allclose(shared, gradient(alone), atol=1e-3, rtol=1e-3)


def test_bfloat16_products_are_close_and_keep_float32_weights_and_gradients():
    whole, half = policy(), policy(compute_dtype=torch.bfloat16)
    prompt_ids = prompts(whole)
    samples = draw(half, prompt_ids)
    scored = half.logprobs(prompt_ids, samples.tokens, samples.mask, 4, 1.3)
    apart = (
        scored.logprobs - whole.logprobs(prompt_ids, samples.tokens, samples.mask, 4, 1.3).logprobs
    ).abs()
    assert 0 < apart.max() < 0.2  # of log-probabilities that differ by ten and more
    assert torch.allclose(scored.logprobs, samples.logprobs * samples.mask, atol=0.1)
    scored.logprobs.sum().backward()
    assert {parameter.dtype for parameter in half.parameters()} == {torch.float32}
    assert {parameter.grad.dtype for parameter in half.parameters()} == {torch.float32}


@pytest.mark.parametrize("compute_dtype", [torch.float32, torch.bfloat16])
def test_sampling_uses_weights_learned_since_the_last_sampling(compute_dtype):
    made = policy(compute_dtype=compute_dtype)
    before = draw(made, prompts(made))
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.neg_()
    after = draw(made, prompts(made))
    scored = made.logprobs(prompts(made), after.tokens, after.mask, 4, 1.3)
    assert after.texts != before.texts
    assert torch.allclose(scored.logprobs, after.logprobs * after.mask, atol=0.1)


def test_samples_depend_only_on_the_generator():
    made = policy()
    first, again, other = (draw(made, prompts(made), seed=seed).texts for seed in (1, 1, 2))
    assert first == again
    assert first != other


def test_temperature_zero_gives_the_greedy_plan():
    made = policy()
    texts = draw(made, prompts(made, 1), group=3, temperature=0.0).texts
    assert len(set(texts)) == 1


def test_mask_ends_with_the_end_token():
    made = policy()
    samples = draw(made, prompts(made))
    for tokens, own in zip(samples.tokens.tolist(), samples.mask.tolist(), strict=True):
        length = sum(own)
        assert own == [True] * length + [False] * (len(own) - length)
        assert END not in tokens[: length - 1]


@pytest.mark.parametrize("task", TASKS.train, ids=lambda task: task.task.task_id)
def test_oracle_plans_survive_encoding_and_decoding(task):
    text = plan_in_names(task.oracle, task.situation)
    assert (
        parse_policy_text(WORDS.decode_plan(WORDS.encode_plan(text)), task.situation, Codec.NAMES)
        == task.oracle
    )


def test_instruction_phrases_get_the_tokens_of_table_names():
    assert WORDS.encode("the chicken leg") == WORDS.encode("the chicken_leg")
    assert WORDS.encode("apples") == WORDS.encode("apple")
    assert WORDS.encode("xylophone") == [UNKNOWN]


OBJECTS = st.sampled_from(
    [name for row in TASKS.train[0].situation.rows for name in (row.name, row.category)]
)
ARGUMENTS = {
    Arg.OBJECT: OBJECTS,
    Arg.SOURCE: OBJECTS,
    Arg.RELATION: st.sampled_from([*PlaceRelation]),
    Arg.YAW: st.sampled_from(["1.57", "-1.57"]),
    Arg.DISTANCE: st.sampled_from(["0.5", "2"]),
    Arg.ROOM: st.sampled_from(TASKS.train[0].situation.rooms),
}
CALLS = st.sampled_from(PROFILES[Profile.PAPER]).flatmap(
    lambda skill: st.tuples(st.just(skill.value), *(ARGUMENTS[argument] for argument in SIGNATURES[skill]))
)


@given(st.lists(CALLS, max_size=12))
def test_plans_have_no_tokens_for_line_breaks_and_are_decoded_to_one_call_a_line(calls):
    text = "\n".join(" ".join(call) for call in calls)
    tokens = WORDS.encode_plan(text)
    assert WORDS.index[BREAK] not in tokens
    assert WORDS.decode_plan([*tokens, END, GO]) == text


def test_object_that_is_called_like_a_skill_stays_in_its_line():
    made = Vocabulary((*SPECIAL, BREAK, "open", "move", "_0", "place", "ontop"), ("open",), ())
    for text in ("move open\nopen open", "open open_0\nmove open", "place open ontop\nopen open"):
        assert made.decode_plan(made.encode_plan(text)) == text


@given(st.text(max_size=200))
def test_any_text_can_be_encoded(text):
    assert all(0 <= token < len(WORDS) for token in WORDS.encode(text))


@given(st.lists(st.integers(0, len(WORDS) - 1), max_size=40))
def test_any_tokens_can_be_decoded(tokens):
    assert isinstance(WORDS.decode_plan(tokens), str)


def test_saved_policy_can_be_loaded(tmp_path):
    made = policy(seed=3)
    made.save(tmp_path)
    assert TinyPolicy.is_saved_in(tmp_path)
    back = TinyPolicy.load(tmp_path)
    assert draw(back, prompts(back)).texts == draw(made, prompts(made)).texts


@pytest.mark.parametrize(
    "change",
    [
        {"layers": 10**9},
        {"width": 2**20},
        {"inner": 2**30},
        {"vocabulary": 2**31},
        {"longest": 2**40},
        {"heads": 3},
        {"heads": 0},
        {"layers": 10**400},
    ],
    ids=str,
)
def test_description_that_the_weights_contradict_is_refused_at_once(tmp_path, change):
    policy().save(tmp_path)
    path = tmp_path / "tiny.json"
    description = json.loads(path.read_text())
    path.write_text(json.dumps({**description, "shape": {**description["shape"], **change}}))
    with pytest.raises(TrainerError, match=r"is damaged .*expected"):
        saved_policy(tmp_path, TrainSettings())


def test_policy_of_an_older_version_is_refused(tmp_path):
    policy().save(tmp_path)
    path = tmp_path / "tiny.json"
    description = json.loads(path.read_text())
    del description["format"]
    path.write_text(json.dumps(description))
    with pytest.raises(TrainerError, match=r"format 1.*expected 3; train the policy again"):
        saved_policy(tmp_path, TrainSettings())


def test_frozen_copy_does_not_change_with_the_policy():
    made = policy()
    reference = made.frozen_copy()
    before = draw(reference, prompts(made)).texts
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(1.0)
    assert draw(reference, prompts(made)).texts == before
    assert not any(parameter.requires_grad for parameter in reference.parameters())


def test_too_long_prompt_keeps_its_end():
    made = policy()
    prompt_ids = made.encode(prompt_for(TASKS.train[0].situation, Codec.NAMES))
    situation = TASKS.train[0].situation
    rows = situation.rows * 40
    long = made.encode(prompt_for(type(situation)((), "", rows, situation.instruction, 16), Codec.NAMES))
    assert len(long) <= SHAPE.longest
    assert long[-4:] == prompt_ids[-4:]


def test_household_tasks_add_words_to_the_vocabulary():
    situations = [task.situation for task in TASKS.train]
    added = {skill.value for skill in PROFILES[Profile.HOUSEHOLD]} - {
        skill.value for skill in PROFILES[Profile.PAPER]
    }
    assert not added & set(build_vocabulary(situations, []).words)
    dirty = replace(situations[0].rows[0], states=("covered_with_mud",))
    household = replace(situations[0], rows=(dirty, *situations[0].rows[1:]), profile=Profile.HOUSEHOLD)
    words = build_vocabulary([*situations, household], []).words
    assert added | {"covered_with_mud"} <= set(words)
    assert set(words) - set(build_vocabulary(situations, []).words) == added | {"covered_with_mud"}
