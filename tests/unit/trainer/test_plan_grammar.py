"""A policy constrained by the grammar writes valid plans about objects in its prompt."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tests.fakes.symbolic_household import make_tasks

from embomatrix.skills.prompt import Codec, PromptRow, plan_in_names, prompt_for
from embomatrix.skills.syntax import PROFILES
from embomatrix.trainer.cluster.gateway import parse_policy_text
from embomatrix.trainer.policy.decoder import DecoderShape, Shortlist
from embomatrix.trainer.policy.grammar import PlanGrammar
from embomatrix.trainer.policy.tiny import TinyPolicy
from embomatrix.trainer.policy.vocabulary import END, build_vocabulary
from embomatrix.world.task import Profile

TASKS = make_tasks(12, 3)


def twins(situation):
    """Return a situation with two more objects of one category, so that names need numbers."""
    first = situation.rows[0]
    more = [PromptRow(100 + at, f"{first.category}_{at}", first.category, first.room) for at in (7, 3)]
    return replace(situation, rows=(*situation.rows[1:], *more), table_size=102)


TWINS = twins(TASKS.train[0].situation)
WORDS = build_vocabulary(
    [
        *(replace(task.situation, profile=Profile.HOUSEHOLD) for task in TASKS.train),
        *(task.situation for task in TASKS.heldout),
        TWINS,
    ],
    [task.task.instruction for task in TASKS.train],
)
GRAMMAR = PlanGrammar(WORDS, torch.device("cpu"))
SKILLS = {skill.value for skill in PROFILES[Profile.HOUSEHOLD]}
POLICY = TinyPolicy(WORDS, DecoderShape(len(WORDS), layers=1, width=16, heads=2, inner=16), seed=0)


def prompt_of(situation):
    return POLICY.encode(prompt_for(situation, Codec.NAMES))


def next_words(situation, written):
    """Return the words that may follow this text in its prompt."""
    names = GRAMMAR.prompt_names(torch.tensor([prompt_of(situation)]))
    state = GRAMMAR.start(1)
    for token in WORDS.encode(written):
        state = GRAMMAR.advance(state, torch.tensor([token]), names)
    token_mask = GRAMMAR.token_mask(state, names)[0]
    return {WORDS.words[token] for token in (~token_mask).nonzero()[:, 0].tolist()}


@pytest.mark.parametrize("task", TASKS.train, ids=lambda task: task.task.task_id)
def test_untrained_policy_writes_valid_plans(task):
    samples = POLICY.sample(
        [prompt_of(task.situation)], 40, 2.0, 60, torch.Generator().manual_seed(len(task.oracle))
    )
    ended = (samples.tokens == END).any(dim=1).tolist()
    assert sum(ended) >= 20
    listed = {row.index for row in task.situation.rows}
    for text in (text for text, whole in zip(samples.texts, ended, strict=True) if whole):
        for call in parse_policy_text(text, replace(task.situation, profile=Profile.HOUSEHOLD), Codec.NAMES):
            assert {call.object_index, call.source_index} - {None} <= listed
            assert call.room_name is None or call.room_name in task.situation.rooms


def test_room_with_a_number_in_instructions_can_be_reached():
    situation = TASKS.train[0].situation
    room = situation.rooms[0]
    words = build_vocabulary([situation], [f"Put the apple away in {room}."] * 3)
    grammar = PlanGrammar(words, torch.device("cpu"))
    names = grammar.prompt_names(torch.tensor([words.encode(prompt_for(situation, Codec.NAMES).user)]))
    state = grammar.advance(grammar.start(1), torch.tensor([words.index["go_to_room"]]), names)
    allowed = {
        words.words[token] for token in (~grammar.token_mask(state, names)[0]).nonzero()[:, 0].tolist()
    }
    assert allowed == {room.rpartition("_")[0] for room in situation.rooms}


@pytest.mark.parametrize("task", TASKS.train, ids=lambda task: task.task.task_id)
def test_oracle_plans_are_never_masked(task):
    text = plan_in_names(task.oracle, task.situation)
    tokens = torch.tensor([POLICY.encode_plan(text)])
    names = GRAMMAR.prompt_names(torch.tensor([prompt_of(task.situation)]))
    state = GRAMMAR.start(1)
    for token in tokens[0]:
        assert not GRAMMAR.token_mask(state, names)[0, token]
        state = GRAMMAR.advance(state, token[None], names)


def test_only_skills_can_start_a_call():
    assert next_words(TASKS.train[0].situation, "") == SKILLS


def test_ambiguous_name_needs_a_number():
    situation = TWINS
    category = situation.rows[-1].category
    assert next_words(situation, f"open {category}") == {"_3", "_7"}
    assert next_words(situation, f"open {category}_3") == SKILLS | {"<end>"}


def test_unique_name_without_a_number_gets_none():
    situation = TASKS.train[0].situation
    assert next_words(situation, f"open {situation.rows[0].category}") == SKILLS | {"<end>"}


def test_vocabulary_of_an_older_checkpoint_offers_the_relations_that_it_has():
    older = replace(WORDS, words=tuple(word for word in WORDS.words if word != "nextto"))
    grammar = PlanGrammar(older, torch.device("cpu"))
    situation = TASKS.train[0].situation
    prompt = older.encode(prompt_for(situation, Codec.NAMES).user)
    names = grammar.prompt_names(torch.tensor([prompt]))
    state = grammar.start(1)
    for token in older.encode(f"place {situation.rows[0].category}"):
        state = grammar.advance(state, torch.tensor([token]), names)
    allowed = (~grammar.token_mask(state, names)[0]).nonzero()[:, 0].tolist()
    assert {older.words[token] for token in allowed} == {"ontop", "inside", "under"}


def test_objects_only_in_the_instruction_are_masked():
    situation = TASKS.train[0].situation
    gone = situation.rows[0].category
    without = replace(situation, rows=situation.rows[1:], instruction=f"bring the {gone.replace('_', ' ')}")
    assert gone in next_words(situation, "move")
    assert gone not in next_words(without, "move")


def test_arguments_follow_the_signature_of_the_skill():
    situation = TASKS.train[0].situation
    kind = situation.rows[0].category
    assert next_words(situation, f"place {kind}") == {"ontop", "inside", "under", "nextto"}
    assert kind in next_words(situation, f"heat_object_with_source {kind}")
    assert "1.57" in next_words(situation, "turn")
    assert next_words(situation, "turn 1.57") == SKILLS | {"<end>"}
    room = next(iter(next_words(situation, "go_to_room")))
    assert any(name.startswith(room) for name in situation.rooms)


@given(st.lists(st.integers(0, len(WORDS) - 1), min_size=1, max_size=12))
def test_invalid_plan_still_has_a_likelihood(written):
    tokens = torch.tensor([written])
    scored = POLICY.logprobs(
        [prompt_of(TASKS.train[0].situation)], tokens, torch.ones_like(tokens) > 0, 1, 1.0
    )
    assert torch.isfinite(scored.logprobs).all()
    assert (scored.logprobs > -1e6).all()


def test_empty_prompt_allows_only_the_end_token():
    situation = replace(TASKS.train[0].situation, rows=(), rooms=())
    assert next_words(situation, "move") == {"<end>"}


def coverage_after(situation, written):
    """Return the coverage above 0 of the words that may follow this text in its prompt."""
    names = GRAMMAR.prompt_names(torch.tensor([prompt_of(situation)]))
    shortlist = Shortlist.of(GRAMMAR.words(names))
    state = GRAMMAR.start(1)
    for token in WORDS.encode(written):
        state = GRAMMAR.advance(state, torch.tensor([token]), names)
    values = GRAMMAR.coverage(state, names, shortlist)[0]
    allowed = ~GRAMMAR.token_mask(state, names)[0][shortlist.words]
    return {
        WORDS.words[int(shortlist.words[at])]: float(values[at])
        for at in (allowed & (values > 0)).nonzero()[:, 0]
    }


def test_things_that_were_picked_up_are_covered():
    situation = TWINS
    twin, alone = situation.rows[-1].category, situation.rows[0].category
    assert coverage_after(situation, f"move {twin}_3 move") == {}
    assert coverage_after(situation, f"pick_up {twin}_3 move") == {twin: 0.5}
    assert coverage_after(situation, f"pick_up {twin}_3 move {twin}") == {"_3": 1.0}
    assert coverage_after(situation, f"pick_up {twin}_3 pick_up {twin}_7 move") == {twin: 1.0}
    assert coverage_after(situation, f"pick_up {alone} move") == {alone: 1.0}
    assert coverage_after(situation, f"pick_up {twin}_3 pick_up {twin}_3 pick_up {twin}_3 move") == {
        twin: 1.0
    }
