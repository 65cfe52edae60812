"""Episodes of the word-level policy: what is sampled is what is trained on."""

import itertools
import json
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fakes.symbolic_household import make_tasks

from embomatrix.skills.prompt import Codec, prompt_for
from embomatrix.skills.syntax import PROFILES
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import TrainSettings
from embomatrix.trainer.data.tasks import TaskSet
from embomatrix.trainer.learning.likelihood import negative_log_likelihood, plan_tokens
from embomatrix.trainer.policy.decoder import DecoderShape
from embomatrix.trainer.policy.episode_rows import EpisodeRows
from embomatrix.trainer.policy.loading import new_policy
from embomatrix.trainer.policy.protocol import ImitationExample
from embomatrix.trainer.policy.tiny import TinyPolicy
from embomatrix.trainer.policy.vocabulary import END, build_vocabulary
from embomatrix.world.task import Profile

TASKS = make_tasks(12, 3)
WORDS = build_vocabulary(
    [task.situation for task in (*TASKS.train, *TASKS.heldout)],
    [task.task.instruction for task in TASKS.train],
    in_episodes=True,
)
ROOM = TASKS.train[0].situation.rooms[0]
THING = f"{TASKS.train[0].situation.rows[0].category}_0"
TOLD = (
    f"did\nrobot {ROOM}",
    f"failed blocked {THING}\nrobot {ROOM} holds {THING}",
    f"did\n{THING} open in {ROOM}\nrobot {ROOM}",
    "failed unparsable",
)
SKILLS = {skill.value for skill in PROFILES[Profile.PAPER]}


def policy(longest=256, seed=0):
    shape = DecoderShape(len(WORDS), layers=2, width=32, heads=2, inner=64, longest=longest)
    made = TinyPolicy(WORDS, shape, seed=seed, single_calls=True)
    with torch.no_grad():
        for parameter in made.parameters():  # far from uniform, so that differences would show
            parameter.mul_(4 if parameter.dim() > 1 else 1)
    return made


POLICY = policy()


def prompts(made, count):
    return [made.encode(prompt_for(task.situation, Codec.NAMES)) for task in TASKS.train[:count]]


def played(made, tasks, group, choices, *, turns=4, seed=0):
    """Play episodes. ``choices`` says for each row and turn what it is told, None to end it."""
    generator = torch.Generator().manual_seed(seed)
    asked = prompts(made, tasks)
    episodes = EpisodeRows(made, asked, group, 1.3, generator)
    rows, answers = list(range(tasks * group)), {}
    for turn in range(turns):
        for row, answer in zip(rows, episodes.answer(rows), strict=True):
            answers.setdefault(row, []).append(answer)
        told = {row: choices[(row, turn)] for row in rows if choices.get((row, turn)) is not None}
        rows = sorted(told)
        if not rows:
            break
        episodes.observe(rows, [TOLD[told[row]] for row in rows])
    return asked, episodes.samples(), answers


CHOICES = st.dictionaries(
    st.tuples(st.integers(0, 5), st.integers(0, 3)), st.integers(0, len(TOLD) - 1), max_size=24
)


@settings(deadline=None)
@given(CHOICES, st.integers(0, 99))
def test_log_probabilities_of_sampling_are_those_of_training(choices, seed):
    asked, samples, _ = played(POLICY, 2, 3, choices, seed=seed)
    scored = POLICY.logprobs(asked, samples.tokens, samples.mask, 3, 1.3)
    assert torch.allclose(scored.logprobs, samples.logprobs * samples.mask, atol=1e-5)


@settings(deadline=None)
@given(CHOICES)
def test_rows_hold_the_answers_and_what_was_told_between_them(choices):
    _, samples, answers = played(POLICY, 2, 3, choices)
    for row in range(6):
        expected, own = [], []
        for turn, answer in enumerate(answers[row]):
            words = POLICY.encode_answer(answer)
            expected += words
            own += [True] * len(words)
            if turn + 1 < len(answers[row]):
                told = POLICY.encode_observation(TOLD[choices[(row, turn)]])
                expected += told
                own += [False] * len(told)
        length = len(expected)
        assert samples.tokens[row, :length].tolist() == expected
        assert samples.mask[row, :length].tolist() == own
        assert not samples.mask[row, length:].any()
        assert samples.texts[row].split("\n") == answers[row]


def test_every_answer_is_one_call_or_says_that_nothing_is_left_to_do():
    everything = dict.fromkeys(itertools.product(range(24), range(6)), 0)
    _, _, answers = played(POLICY, 4, 6, everything, turns=6)
    said = [answer for each in answers.values() for answer in each]
    assert "done" in said
    assert all(answer == "done" or answer.split()[0] in SKILLS for answer in said)
    assert all("\n" not in answer for answer in said)


def test_episodes_may_be_lost_before_the_first_answer():
    generator = torch.Generator().manual_seed(0)
    asked = prompts(POLICY, 2)
    episodes = EpisodeRows(POLICY, asked, 2, 1.3, generator)
    for _ in range(3):
        episodes.answer([1, 2, 3])
        episodes.observe([1, 2, 3], [TOLD[1]] * 3)
    samples = episodes.samples()
    assert not samples.mask[0].any()
    scored = POLICY.logprobs(asked, samples.tokens, samples.mask, 2, 1.3)
    assert torch.allclose(scored.logprobs, samples.logprobs * samples.mask, atol=1e-5)


def test_a_batch_without_any_answer_has_samples_without_own_words():
    samples = EpisodeRows(POLICY, prompts(POLICY, 1), 2, 1.3, torch.Generator()).samples()
    assert samples.mask.tolist() == [[False], [False]]
    assert POLICY.logprobs(prompts(POLICY, 1), samples.tokens, samples.mask, 2, 1.3).logprobs.sum() == 0


def test_rooms_without_objects_and_states_of_substances_have_words():
    situation = replace(TASKS.train[0].situation, home=("hammam_0", ROOM))
    words = build_vocabulary([situation], [], in_episodes=True)
    assert {"hammam", ROOM.rpartition("_")[0]} <= set(words.room_words)
    assert not words.unknown_words("did\nabsent\nfilled_with_water\nsoaked_with_water")


def test_a_thing_can_be_named_once_the_policy_was_told_of_it():
    names = POLICY.grammar.prompt_names(torch.tensor(prompts(POLICY, 1)))
    stem, number = (torch.tensor([WORDS.index[word]]) for word in (THING.rpartition("_")[0], "_0"))
    skill = torch.tensor([WORDS.index["move"]])

    def may_follow():
        state = POLICY.grammar.advance(POLICY.grammar.start(1), skill, names)
        state = POLICY.grammar.advance(state, stem, names)
        return not POLICY.grammar.token_mask(state, names)[0, number]

    assert not may_follow()
    told = torch.tensor([POLICY.encode_observation(f"did\n{THING} in {ROOM}")])
    POLICY.grammar.observe(names, told, torch.zeros_like(told, dtype=torch.bool))
    assert not may_follow()
    POLICY.grammar.observe(names, told, torch.ones_like(told, dtype=torch.bool))
    assert may_follow()


def test_other_episodes_of_a_game_change_no_log_probability():
    alone = {(0, turn): 1 for turn in range(3)}
    beside = {**alone, **{(row, turn): 2 for row in (1, 2) for turn in range(row)}}
    for choices in (alone, beside):
        asked, samples, _ = played(POLICY, 1, 3, choices, seed=4)
        scored = POLICY.logprobs(asked, samples.tokens[:1], samples.mask[:1], 1, 1.3)
        assert torch.allclose(scored.logprobs[0], samples.logprobs[0] * samples.mask[0], atol=1e-5)


def test_an_episode_ends_where_the_context_has_no_room_for_another_answer():
    made = policy(longest=len(prompts(POLICY, 1)[0]) + 60)
    generator = torch.Generator().manual_seed(0)
    episodes = EpisodeRows(made, prompts(made, 1), 2, 1.0, generator)
    for _ in range(60):
        answers = episodes.answer([0, 1])
        if answers == [None, None]:
            break
        rows = [row for row, answer in enumerate(answers) if answer is not None]
        episodes.observe(rows, [TOLD[2]] * len(rows))
        if len(rows) < 2:
            break
    samples = episodes.samples()
    assert samples.cut_off.any()
    asked = prompts(made, 1)
    scored = made.logprobs(asked, samples.tokens, samples.mask, 2, 1.0)
    assert torch.allclose(scored.logprobs, samples.logprobs * samples.mask, atol=1e-5)
    assert len(asked[0]) + samples.tokens.shape[1] <= made.context


def test_what_the_policy_is_told_is_not_imitated():
    prompt = prompts(POLICY, 1)[0]
    call, told = POLICY.encode_plan(f"go_to_room {ROOM}"), POLICY.encode_observation(TOLD[0])
    plan = (*call, *told, END)
    marks = (False,) * len(call) + (True,) * len(told) + (False,)
    example = ImitationExample(prompt, plan, marks)
    assert plan_tokens([example]) == example.imitated == len(call) + 1
    tokens = torch.tensor([plan])
    own = ~torch.tensor([marks])
    scored = POLICY.logprobs([prompt], tokens, own, 1, 1.0)
    loss = negative_log_likelihood(POLICY, [example]).item()
    assert loss == pytest.approx(-scored.logprobs[own].sum().item())
    assert scored.logprobs[~own].abs().sum().item() == 0


def test_what_the_policy_began_is_not_imitated_and_counts_as_its_own():
    prompt = prompts(POLICY, 1)[0]
    call, told = POLICY.encode_plan(f"go_to_room {ROOM}"), POLICY.encode_observation(TOLD[0])
    plan = (*call, *told, *call, *told, END)
    marks = ((False,) * len(call) + (True,) * len(told)) * 2 + (False,)
    begun = len(call) + len(told)
    whole, taught = ImitationExample(prompt, plan, marks), ImitationExample(prompt, plan, marks, begun)
    assert (whole.imitated, taught.imitated) == (2 * len(call) + 1, len(call) + 1)
    own = ~torch.tensor([marks])
    scored = POLICY.logprobs([prompt], torch.tensor([plan]), own, 1, 1.0).logprobs[0]
    losses = [negative_log_likelihood(POLICY, [example]).item() for example in (whole, taught)]
    assert losses[0] == pytest.approx(-scored.sum().item())
    assert losses[1] == pytest.approx(-scored[begun:].sum().item())
    both = negative_log_likelihood(POLICY, [whole, taught]).item()
    assert both == pytest.approx(sum(losses), rel=1e-5)


def test_a_saved_policy_for_episodes_is_one_after_loading(tmp_path):
    POLICY.save(tmp_path)
    assert TinyPolicy.load(tmp_path).single_calls
    assert json.loads((tmp_path / "tiny.json").read_text())["single_calls"] is True


@pytest.mark.parametrize("in_episodes", [True, False])
def test_a_policy_of_the_other_kind_is_refused(tmp_path, in_episodes):
    kind = TinyPolicy(WORDS, DecoderShape(len(WORDS), 1, 16, 2, 16), seed=0, single_calls=not in_episodes)
    kind.save(tmp_path)
    table = {"visibility": "seen"} if in_episodes else {}
    chosen = TrainSettings.model_validate({"model": str(tmp_path), "episodes": table})
    remedy = "leave out" if in_episodes else "set"
    with pytest.raises(TrainerError, match=rf"{remedy} episodes\.visibility"):
        new_policy(chosen, TaskSet(TASKS.train, TASKS.heldout, TASKS.bundle_bytes))
