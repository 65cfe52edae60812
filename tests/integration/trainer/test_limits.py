"""Limits of prompts and plans: derived from oracle plans, and the share of tasks that can't be expressed."""

from dataclasses import replace

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.small_llama import random_llama, word_tokenizer

from embomatrix.skills.prompt import Codec, limited
from embomatrix.starter.shipped import unpack
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import LANGUAGE_MODEL_DEFAULTS, TrainSettings, read_settings
from embomatrix.trainer.data.tasks import load_tasks
from embomatrix.trainer.data.variation import used_rows
from embomatrix.trainer.evaluation.models import load_model
from embomatrix.trainer.lifecycle.checkpoint import CHECKPOINTS, CheckpointStore
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.limits import (
    ANSWER_TOKENS,
    MARGIN,
    Limits,
    Obstacle,
    TokenCounter,
    check_context,
    expressibility,
    plan_of,
    prompts_of,
    room_for,
    rows_needed,
    sentence_about,
    with_limits,
)
from embomatrix.trainer.policy.loading import new_policy
from embomatrix.trainer.run.starting import resume_run, start_run
from embomatrix.world.task import MAX_TABLE

SMALL = {"tiny.layers": 1, "tiny.width": 16, "tiny.heads": 2, "tiny.inner": 16, "threads": 1}


@pytest.fixture(scope="module")
def shipped(tmp_path_factory):
    """Tasks that ship with the package."""
    folder = tmp_path_factory.mktemp("shipped")
    unpack(folder)
    return load_tasks(folder)


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    return write_kitchen_dataset(tmp_path_factory.mktemp("kitchen"))


@pytest.fixture(scope="module")
def policy(shipped):
    return new_policy(read_settings(None, SMALL), shipped)


@pytest.fixture(scope="module")
def smollm2(smollm2_folder):
    pytest.importorskip("transformers")
    return HfPolicy.load(smollm2_folder, TrainSettings())


def limits_of(settings):
    return Limits(settings.prompt.rows, settings.grpo.max_new)


def test_unset_limits_hold_every_oracle_plan_for_training(shipped, policy):
    limits = limits_of(with_limits(read_settings(None, SMALL), policy, shipped))
    lengths = [len(policy.encode_plan(plan_of(task, limits.rows, Codec.NAMES))) for task in shipped.train]
    assert max(lengths) < limits.max_new <= MARGIN * max(lengths) + 1
    assert expressibility(shipped.train, limits, TokenCounter.of_policy(policy)).share == 0
    fewer = expressibility(
        shipped.train, replace(limits, rows=limits.rows - 1), TokenCounter.of_policy(policy)
    )
    assert fewer.obstacles[Obstacle.ROWS] > 0


def test_given_limits_stay(shipped, policy):
    given = read_settings(None, {**SMALL, "grpo.max_new": 72, "prompt.rows": 16})
    assert with_limits(given, policy, shipped) == given
    one = with_limits(read_settings(None, {**SMALL, "grpo.max_new": 72}), policy, shipped)
    assert one.grpo.max_new == 72
    assert one.prompt.rows > 16


def test_former_limits_of_the_word_level_policy_excluded_a_third_of_the_shipped_tasks(shipped, policy):
    former = Limits(16, 72)
    found = expressibility(shipped.train, former, TokenCounter.of_policy(policy))
    assert 0.3 < found.share < 0.4
    sentence = sentence_about(found, "training tasks", former, "grpo.max_new")
    assert sentence.startswith("warning: ")
    assert f"need objects beyond prompt.rows = 16: {found.needed.rows} rows hold all" in sentence
    assert f"beyond grpo.max_new = 72 tokens: {found.needed.max_new} hold all" in sentence
    assert expressibility(shipped.train, found.needed, TokenCounter.of_policy(policy)).inexpressible == 0


def test_sentence_is_a_warning_only_above_five_percent(shipped, policy):
    limits = replace(limits_of(with_limits(read_settings(None, SMALL), policy, shipped)), rows=24)
    found = expressibility(shipped.heldout, limits, TokenCounter.of_policy(policy))
    assert 0 < found.share < 0.05
    assert sentence_about(found, "held-out tasks", limits, "grpo.max_new").startswith(
        f"{found.inexpressible} of {len(shipped.heldout)} held-out tasks ("
    )


def test_rows_needed_is_the_smallest_limit_that_keeps_the_plan_s_objects(shipped):
    for task in shipped.heldout:
        rows = rows_needed(task)
        used = used_rows(task.oracle)
        assert used <= {row.index for row in limited(task.situation, rows).rows}
        if rows > 1:
            assert not used <= {row.index for row in limited(task.situation, rows - 1).rows}


def test_skills_and_words_that_a_vocabulary_lacks_are_obstacles(shipped, kitchen):
    from_kitchen = new_policy(read_settings(None, SMALL), load_tasks(kitchen))
    limits = Limits(MAX_TABLE, 400)
    found = expressibility(shipped.train, limits, TokenCounter.of_policy(from_kitchen))
    assert found.obstacles[Obstacle.VOCABULARY] > 0
    assert set(found.obstacles) <= {Obstacle.SKILLS, Obstacle.VOCABULARY}
    assert "need words that the model can't write (" in sentence_about(found, "tasks", limits, "max_tokens")
    open_limits = Limits(MAX_TABLE, ANSWER_TOKENS)
    refused = expressibility(shipped.train, open_limits, TokenCounter.of_endpoint(Codec.JSON), refused=40)
    assert refused.obstacles == {Obstacle.SKILLS: 40}
    assert refused.share == 40 / 2040


def test_tasks_without_oracle_plans_are_left_out_and_keep_the_settings(shipped, policy):
    bare = replace(shipped, train=tuple(replace(task, oracle=()) for task in shipped.train))
    assert with_limits(read_settings(None, SMALL), policy, bare) == read_settings(None, SMALL)
    found = expressibility(bare.train, Limits(1, 1), TokenCounter.of_policy(policy))
    assert found.tasks == 0
    assert "no oracle plans" in sentence_about(found, "training tasks", Limits(1, 1), "grpo.max_new")


def test_run_starts_with_derived_limits_and_its_resumption_keeps_them(kitchen, tmp_path):
    start = start_run(kitchen, tmp_path, "tiny", None, SMALL)
    assert start.settings.grpo.max_new != TrainSettings().grpo.max_new
    first, training, heldout = start.about_limits
    assert f"{start.settings.grpo.max_new} tokens in a plan (grpo.max_new)" in first
    assert training == "0 of 3 training tasks (0.0%) can't be expressed"
    assert heldout.startswith(("0 of 1 held-out tasks", "warning: 1 of 1 held-out tasks"))
    start.progress.imitation.step = 1
    CheckpointStore(tmp_path / CHECKPOINTS, keep=1).save(start.policy, {}, start.progress, start.settings)
    assert limits_of(resume_run(kitchen, tmp_path, {}).settings) == limits_of(start.settings)


def test_model_without_the_settings_of_a_run_gets_the_limits_of_an_endpoint(kitchen, tmp_path):
    tasks = load_tasks(kitchen)
    new_policy(read_settings(None, SMALL), tasks).save(tmp_path / "words")
    tokenizer = word_tokenizer(tasks.train)
    model = random_llama(tokenizer)
    model.save_pretrained(tmp_path / "llama")
    tokenizer.save_pretrained(tmp_path / "llama")
    for name in ("words", "llama"):
        _, settings = load_model(str(tmp_path / name), None, threads=1, device="cpu")
        assert limits_of(settings) == Limits(MAX_TABLE, ANSWER_TOKENS)


def test_prompt_beyond_the_model_s_context_is_refused_before_the_run(kitchen, tmp_path):
    tasks = load_tasks(kitchen)
    tokenizer = word_tokenizer(tasks.train)
    llama = random_llama(tokenizer)
    llama.config.max_position_embeddings = 64
    short = HfPolicy(llama, tokenizer, Codec.LINES, "short")
    with pytest.raises(
        TrainerError, match=r"prompt of the task '\w+' has \d+ tokens, but the model's context has 64"
    ):
        with_limits(read_settings(None, {}, LANGUAGE_MODEL_DEFAULTS), short, tasks)
    prompts = prompts_of((*tasks.train, *tasks.heldout), MAX_TABLE, Codec.LINES).values()
    llama.config.max_position_embeddings = max(len(short.encode(prompt)) for prompt in prompts) + 5
    near = HfPolicy(llama, tokenizer, Codec.LINES, "near")
    whole_table = {"prompt.rows": MAX_TABLE}
    derived = with_limits(read_settings(None, whole_table, LANGUAGE_MODEL_DEFAULTS), near, tasks)
    assert derived.grpo.max_new == 5
    given = read_settings(None, {**whole_table, "grpo.max_new": 6}, LANGUAGE_MODEL_DEFAULTS)
    with pytest.raises(
        TrainerError, match=r"leaves 5 of the model's context of \d+, and grpo\.max_new is 6: lower"
    ):
        with_limits(given, near, tasks)


def test_word_level_policy_has_room_for_its_longest_answer(shipped, policy):
    prompts, counter = prompts_of(shipped.heldout, MAX_TABLE, Codec.NAMES), TokenCounter.of_policy(policy)
    room = room_for(ANSWER_TOKENS, prompts, counter)
    assert room < ANSWER_TOKENS
    check_context(prompts, room, counter, "max_tokens")
    with pytest.raises(TrainerError, match="and max_tokens is"):
        check_context(prompts, room + 1, counter, "max_tokens")


@pytest.mark.hf
def test_smollm2_can_write_the_shipped_plans_within_the_default_of_every_model(shipped, smollm2):
    counter = replace(TokenCounter.of_policy(smollm2), codec=Codec.JSON)
    limits = Limits(MAX_TABLE, ANSWER_TOKENS)
    for tasks in (shipped.train, shipped.heldout):
        assert expressibility(tasks, limits, counter).inexpressible == 0
    former = expressibility(shipped.train, Limits(28, 96), counter)
    assert former.share > 0.5
    assert Obstacle.LENGTH in former.obstacles


@pytest.mark.hf
def test_estimate_for_endpoints_is_not_below_smollm2_s_tokens(shipped, smollm2):
    estimate = TokenCounter.of_endpoint(Codec.JSON)
    for task in shipped.heldout:
        text = plan_of(task, MAX_TABLE, Codec.JSON)
        assert estimate.plan_tokens(text) >= len(smollm2.encode_plan(text))
