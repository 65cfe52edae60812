"""Episodes of language models: what is sampled is what is trained on, in any course of answers and observations."""

import random

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fakes.small_llama import random_llama, word_tokenizer
from tests.fakes.symbolic_household import make_tasks

from embomatrix.skills.prompt import Codec, prompt_for
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import TrainSettings
from embomatrix.trainer.episodes.oracle import OracleEpisode
from embomatrix.trainer.learning.likelihood import negative_log_likelihood
from embomatrix.trainer.policy.chat_rows import ChatRows
from embomatrix.trainer.policy.hf import HfPolicy, attention_window
from embomatrix.trainer.policy.loading import new_policy, saved_policy
from embomatrix.trainer.policy.playing import plays_episodes, rows_of_episodes

TASKS = make_tasks(6, 2)
TOLD = ("did it", "failed: there is no such thing", "did it\nRobot: kitchen_0, hand empty", "")
CHATML = (
    "{% for each in messages %}<|start|>{{ each.role }}\n{{ each.content }}<end>\n{% endfor %}"
    "{% if add_generation_prompt %}<|start|>assistant\n{% endif %}"
)


def policy(template=None, longest=None):
    tokenizer = word_tokenizer([*TASKS.train, *TASKS.heldout])
    tokenizer.chat_template = template
    made = HfPolicy(random_llama(tokenizer), tokenizer, Codec.LINES, "random llama")
    made.context = longest or made.context
    return made


POLICY = policy()


def prompts(count, made=POLICY):
    return [
        made.encode(prompt_for(task.situation, Codec.LINES))[-40 - 7 * at :]
        for at, task in enumerate(TASKS.train[:count])
    ]


def play(made, asked, group, seed, longest=5, turns=5):
    """Play episodes of random length and return their samples, and what each row was answered and told."""
    draw = random.Random(seed)
    rows = ChatRows(made, asked, group, 1.0, torch.Generator().manual_seed(seed), longest)
    going, heard = [*range(len(asked) * group)], {}
    for _ in range(turns):
        answers = rows.answer(going)
        going = [
            row
            for row, answer in zip(going, answers, strict=True)
            if answer is not None and draw.random() < 0.8
        ]
        if not going:
            break
        told = [draw.choice(TOLD) for _ in going]
        for row, text in zip(going, told, strict=True):
            heard.setdefault(row, []).append(text)
        rows.observe(going, told)
    return rows.samples(), heard


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 3), st.integers(1, 3), st.integers(0, 10_000), st.sampled_from([None, CHATML]))
def test_log_probabilities_of_sampling_are_those_of_training(count, group, seed, template):
    made = POLICY if template is None else policy(template)
    asked = prompts(count)
    samples, _ = play(made, asked, group, seed)
    scored = made.logprobs(asked, samples.tokens, samples.mask, group, 1.0)
    assert torch.allclose(scored.logprobs, samples.logprobs * samples.mask, atol=1e-4)
    for row in range(count * group):  # alone, without the other rows and their padding
        length = int(samples.mask[row].nonzero()[-1]) + 1
        alone = made.logprobs(
            [asked[row // group]],
            samples.tokens[row : row + 1, :length],
            samples.mask[row : row + 1, :length],
            1,
            1.0,
        )
        assert torch.allclose(
            alone.logprobs[0], samples.logprobs[row, :length] * samples.mask[row, :length], atol=1e-4
        )


def test_rows_are_answers_and_what_was_told_between_them():
    made = policy(CHATML)
    asked = prompts(2)
    samples, heard = play(made, asked, 2, 3)
    ends = set(made.end_tokens)
    for row, texts in heard.items():
        tokens, own = samples.tokens[row].tolist(), samples.mask[row].tolist()
        last = max(at for at, mine in enumerate(own) if mine)
        parts, at = [], 0
        while at <= last:
            end = next((to for to in range(at, last + 1) if own[to] != own[at]), last + 1)
            parts.append((own[at], tokens[at:end]))
            at = end
        answers = [part for mine, part in parts if mine]
        told = [part for mine, part in parts if not mine]
        assert samples.texts[row].count("\n") == len(answers) - 1
        assert len(told) == len(answers) - 1 <= len(texts)
        for answer, after, text in zip(answers, told, texts, strict=False):
            ending = [] if answer[-1] in ends else [made.end_tokens[0]]
            assert after == [*ending, *made.encode_observation(text)]
            assert len(answer) <= 5
            assert not ends & set(answer[:-1])


def test_equal_seeds_give_equal_episodes_and_greedy_ones_need_none():
    asked = prompts(2)
    first, again, other = (play(POLICY, asked, 2, seed)[0].tokens for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert first.shape != other.shape or not torch.equal(first, other)
    rows = [rows_of_episodes(POLICY, asked, 1, 0.0, seed, 4).answer([0, 1]) for seed in (1, 2)]
    assert rows[0] == rows[1]


def test_episode_ends_where_the_context_has_no_room_for_another_answer():
    made = policy(longest=80)
    asked = [prompts(1)[0][-40:]]
    rows = ChatRows(made, asked, 2, 1.0, torch.Generator().manual_seed(0), 6)
    for _ in range(20):
        answers = rows.answer([0, 1])
        if answers == [None, None]:
            break
        going = [row for row, answer in enumerate(answers) if answer is not None]
        rows.observe(going, ["did it and more"] * len(going))
        if len(going) < 2:
            break
    samples = rows.samples()
    assert samples.cut_off.any()
    assert 40 + samples.tokens.shape[1] <= 80


SPACED = "{% for each in messages %}{{ each.role }}: {{ each.content }} <end>{% endfor %}assistant:"
PLAIN = "{% for each in messages %}[{{ each.role }}]{{ each.content }}{% endfor %}[assistant]"
TURNS = CHATML.replace("<end>", "<turn>")


@pytest.mark.parametrize(
    ("template", "end", "between"),
    [
        (CHATML, "<end>", "<end>\n<|start|>user\ndid it<end>\n<|start|>assistant\n"),
        (SPACED, "<end>", "<end>user: did it <end>assistant:"),
        (PLAIN, "<end>", "[user]did it[assistant]"),
        (TURNS, "<turn>", "<turn>\n<|start|>user\ndid it<turn>\n<|start|>assistant\n"),
    ],
)
def test_tokens_between_two_answers_follow_the_template(template, end, between):
    made = policy(template)
    made._tokenizer.add_special_tokens({"additional_special_tokens": ["<turn>"]})
    known = made._tokenizer.convert_tokens_to_ids(end)
    assert made._between("did it") == between
    assert made.answer_end == known
    assert set(made.answer_ends) == {known, *made.end_tokens}
    assert made.encode_answer("move 1")[-1] == known
    whole = made._tokens(between)
    assert made.encode_observation("did it") == (whole[1:] if between.startswith(end) else whole)


def test_without_a_template_an_answer_follows_its_name():
    assert POLICY.encode_observation("did it") == POLICY._tokens("\ndid it\nAnswer:\n")
    assert POLICY.answer_end == POLICY.end_tokens[0]


def test_template_that_leaves_answers_out_is_refused():
    forgetful = "{% for each in messages if each.role == 'user' %}{{ each.content }}{% endfor %}"
    with pytest.raises(TrainerError, match="leaves earlier answers out"):
        policy(forgetful).encode_observation("did it")


def small(config, **changes):
    sizes = {"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
    more = {"num_key_value_heads": 1, "vocab_size": len(POLICY._tokenizer), "max_position_embeddings": 2048}
    return config(**{**sizes, **more, "eos_token_id": 1, **changes})


def test_model_with_a_window_of_attention_is_refused_in_episodes(tmp_path):
    from transformers import MistralConfig, MistralForCausalLM, Qwen2Config, Qwen2ForCausalLM

    narrow = MistralForCausalLM(small(MistralConfig, sliding_window=32))
    unused = Qwen2ForCausalLM(small(Qwen2Config, sliding_window=32, use_sliding_window=False))
    assert (attention_window(narrow), attention_window(unused)) == (32, None)
    for model, refused in ((narrow, True), (unused, False)):
        folder = tmp_path / type(model).__name__
        HfPolicy(model, POLICY._tokenizer, Codec.LINES, "small").save(folder)
        chosen = TrainSettings.model_validate({"model": str(folder), "episodes": {"visibility": "seen"}})
        if refused:
            with pytest.raises(TrainerError, match="attend to the last 32 tokens only"):
                new_policy(chosen, TASKS)
        else:
            assert plays_episodes(new_policy(chosen, TASKS))


def test_imitation_of_an_episode_counts_the_answers_of_the_oracle_alone():
    made = policy(CHATML)
    opening = prompt_for(TASKS.train[0].situation, Codec.LINES)
    turns = (("move 1", "did it"), ("pick_up 1", "did it"), ("done", "over"))
    whole, taught = (
        OracleEpisode(opening, turns).example(made),
        OracleEpisode(opening, turns, 1).example(made),
    )
    answers = [made.encode_answer(answer) for answer, _ in turns]
    assert whole.imitated == sum(map(len, answers))
    assert taught.imitated == whole.imitated - len(answers[0])
    assert whole.plan[-len(answers[2]) :] == answers[2]
    mask = torch.tensor([[not told for told in whole.observed]])
    scored = made.logprobs([whole.prompt], torch.tensor([whole.plan]), mask, 1, 1.0).logprobs
    assert negative_log_likelihood(made, [whole]).item() == pytest.approx(-scored.sum().item(), rel=1e-4)


@pytest.mark.parametrize("rank", [0, 2])
def test_saved_model_knows_that_it_plays_episodes(tmp_path, rank):
    POLICY.save(tmp_path / "plain")
    settings = {"model": str(tmp_path / "plain"), "lora": {"rank": rank}, "episodes": {"visibility": "seen"}}
    chosen = TrainSettings.model_validate(settings)
    made = new_policy(chosen, TASKS)
    made.save(tmp_path / "run")
    assert plays_episodes(made)
    assert plays_episodes(saved_policy(tmp_path / "run", chosen))  # as a resumed run loads it
    assert plays_episodes(saved_policy(tmp_path / "run", TrainSettings(), learns=False))
    with pytest.raises(TrainerError, match=r"writes the calls of episodes: set episodes\.visibility"):
        new_policy(TrainSettings(model=str(tmp_path / "run")), TASKS)
