"""Limits of prompts and plans: derived from oracle plans, and the tasks that a model can't express within them.

A task is *expressible* if its oracle plan can be written: the prompt lists the plan's objects, the plan is short enough, and
the model knows its skills and words. A task that is not expressible can only fail.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from embomatrix.skills.episode_text import opening
from embomatrix.skills.prompt import Codec, Prompt, limited, prompt_for, ranked_rows, subset
from embomatrix.skills.syntax import Skill
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.data.variation import used_rows
from embomatrix.trainer.policy.prompts import plan_text
from embomatrix.trainer.policy.tiny import longest_prompt

if TYPE_CHECKING:
    from embomatrix.trainer.config.settings import TrainSettings
    from embomatrix.trainer.data.tasks import TaskSet, TrainingTask
    from embomatrix.trainer.policy.decoder import DecoderShape
    from embomatrix.trainer.policy.protocol import Policy
    from embomatrix.trainer.policy.vocabulary import Vocabulary

MARGIN: Final = 1.5
"""``grpo.max_new`` is by default the longest oracle plan of the training tasks times this: a policy's plans vary around it."""
ANSWER_TOKENS: Final = 1024
"""Maximum tokens of an answer for every model that was not trained here, in this process or behind an endpoint.

Enough for a plan of 46 steps in JSON (764 tokens of SmolLM2) and some reasoning before it.
"""
WARNING_SHARE: Final = 0.05
"""Share of inexpressible tasks above which a warning is printed."""
CHARACTERS_PER_TOKEN: Final = 2.0
"""Estimate for an endpoint, whose tokenizer is unknown. SmolLM2 needs a token for 2.6 characters of a plan in JSON."""

CHARACTERS_PER_PROMPT_TOKEN: Final = 2.9
"""Fewest characters of a token of SmolLM2 in the prompts of the shipped tasks. Larger vocabularies have more."""
CHARACTERS_PER_PLAN_TOKEN: Final = {Codec.LINES: 1.6, Codec.JSON: 2.5}
"""The same in their oracle plans."""


class Obstacle(StrEnum):
    """Reason for which a task's oracle plan can't be written."""

    SKILLS = "skills"
    VOCABULARY = "vocabulary"
    ROWS = "rows"
    LENGTH = "length"


@dataclass(frozen=True, slots=True)
class Limits:
    """Maximum rows of the object table in a prompt, and maximum tokens of a plan with its end token."""

    rows: int
    max_new: int


@dataclass(frozen=True, slots=True)
class TokenCounter:
    """Measures of texts for one model: tokens of prompts and of plans with their end token, and words that it can't write.

    ``context`` is the maximum number of tokens of a prompt and a plan together, None if there is no limit or none is known.
    """

    codec: Codec
    context: int | None
    prompt_tokens: Callable[[Prompt], int]
    plan_tokens: Callable[[str], int]
    unknown_words: Callable[[str], frozenset[str]]

    @staticmethod
    def of_policy(policy: Policy) -> TokenCounter:
        """Measure with the tokenizer of a policy in this process."""
        return TokenCounter(
            policy.codec,
            policy.context,
            lambda prompt: len(policy.encode(prompt)),
            lambda text: len(policy.encode_plan(text)),
            policy.unknown_words,
        )

    @staticmethod
    def of_vocabulary(vocabulary: Vocabulary, shape: DecoderShape) -> TokenCounter:
        """Measure with the vocabulary of a word-level policy, without the policy."""
        return TokenCounter(
            Codec.NAMES,
            shape.longest,
            lambda prompt: min(len(vocabulary.encode(prompt.user)), longest_prompt(shape)) + 1,
            lambda text: len(vocabulary.encode_plan(text)) + 1,
            vocabulary.unknown_words,
        )

    @staticmethod
    def of_unread_tokenizer(codec: Codec) -> TokenCounter:
        """Estimate the tokens of a language model from the characters: rather too many than too few."""
        return TokenCounter(
            codec,
            None,
            lambda prompt: math.ceil(len(prompt.system + prompt.user) / CHARACTERS_PER_PROMPT_TOKEN),
            lambda text: math.ceil(len(text) / CHARACTERS_PER_PLAN_TOKEN[codec]),
            lambda _: frozenset(),
        )

    @staticmethod
    def of_endpoint(codec: Codec) -> TokenCounter:
        """Estimate the tokens from the characters, because an endpoint's tokenizer and context are unknown."""

        def estimate(text: str) -> int:
            return math.ceil(len(text) / CHARACTERS_PER_TOKEN)

        return TokenCounter(
            codec, None, lambda prompt: estimate(prompt.system + prompt.user), estimate, lambda _: frozenset()
        )


@dataclass(frozen=True, slots=True)
class Expressibility:
    """Tasks with an oracle plan, their obstacles by number of tasks, and the limits that all of their plans need.

    A task counts once, for its first obstacle in the order of ``Obstacle``. ``words`` are those that the model can't write.
    """

    tasks: int
    obstacles: Mapping[Obstacle, int]
    needed: Limits
    words: frozenset[str] = frozenset()

    @property
    def inexpressible(self) -> int:
        """Number of tasks that can't be expressed."""
        return sum(self.obstacles.values())

    @property
    def share(self) -> float:
        """Share of the tasks that can't be expressed, from 0 to 1."""
        return self.inexpressible / self.tasks if self.tasks else 0.0


def rows_needed(task: TrainingTask) -> int:
    """Return the smallest limit of rows with which a task's prompt lists all objects of its oracle plan."""
    used = used_rows(task.oracle)
    places = [place for place, row in enumerate(ranked_rows(task.situation), start=1) if row.index in used]
    return max(places, default=1)


def plan_of(task: TrainingTask, rows: int, codec: Codec) -> str:
    """Return the oracle plan as text, as if all objects that it uses were in the prompt."""
    kept = {row.index for row in limited(task.situation, rows).rows}
    return plan_text(task.oracle, subset(task.situation, kept | used_rows(task.oracle)), codec)


def with_limits(settings: TrainSettings, policy: Policy, tasks: TaskSet) -> TrainSettings:
    """Return settings whose unset limits follow from the oracle plans of the training tasks.

    ``prompt.rows``: the fewest rows that hold the objects of every plan. ``grpo.max_new``: the longest plan in tokens times
    ``MARGIN``, at most what the longest prompt leaves of the model's context. Without oracle plans, settings keep their
    defaults. In episodes nothing follows from them. Raises TrainerError if a prompt leaves no room for a plan or an answer.
    """
    if settings.episodes.visibility is not None:
        check_openings(settings.episodes.answer_tokens, TokenCounter.of_policy(policy), tasks)
        return settings
    return with_measured_limits(settings, TokenCounter.of_policy(policy), tasks)


def with_measured_limits(settings: TrainSettings, counter: TokenCounter, tasks: TaskSet) -> TrainSettings:
    """Return the settings of ``with_limits`` for a model that is known by its ruler alone."""
    taught = [task for task in tasks.train if task.oracle]
    if taught and "rows" not in settings.prompt.model_fields_set:
        rows = max(map(rows_needed, taught))
        settings = settings.model_copy(update={"prompt": settings.prompt.model_copy(update={"rows": rows})})
    rows = settings.prompt.rows
    prompts = prompts_of((*tasks.train, *tasks.heldout), rows, counter.codec)
    if taught and "max_new" not in settings.grpo.model_fields_set:
        longest = max(counter.plan_tokens(plan_of(task, rows, counter.codec)) for task in taught)
        max_new = room_for(math.ceil(MARGIN * longest), prompts, counter)
        settings = settings.model_copy(update={"grpo": settings.grpo.model_copy(update={"max_new": max_new})})
    check_context(prompts, settings.grpo.max_new, counter, "grpo.max_new")
    return settings


def check_openings(answer_tokens: int, counter: TokenCounter, tasks: TaskSet) -> None:
    """Raise TrainerError if an episode's opening that tells of all objects leaves no room for an answer."""
    if counter.context is None:
        return
    openings = {
        task.task.task_id: opening(task.situation, counter.codec, seen=False, at_once=1)
        for task in (*tasks.train, *tasks.heldout)
    }
    task_id, tokens = _longest(openings, counter)
    if tokens + answer_tokens >= counter.context:
        raise TrainerError(
            f"the opening of an episode of the task {task_id!r} has {tokens} tokens, and episodes.answer_tokens is "
            f"{answer_tokens}: both must fit into the model's context of {counter.context}; lower episodes.answer_tokens, or "
            "pass a model with a longer context"
        )


def prompts_of(tasks: Iterable[TrainingTask], rows: int, codec: Codec) -> dict[str, Prompt]:
    """Return the prompts of tasks by their ids."""
    return {task.task.task_id: prompt_for(limited(task.situation, rows), codec) for task in tasks}


def room_for(wanted: int, prompts: Mapping[str, Prompt], counter: TokenCounter) -> int:
    """Return the tokens that are left of the context beside the longest prompt, at most ``wanted``.

    Raises TrainerError if there are none.
    """
    if counter.context is None or not prompts:
        return wanted
    task_id, tokens = _longest(prompts, counter)
    if tokens >= counter.context:
        raise TrainerError(
            f"the prompt of the task {task_id!r} has {tokens} tokens, but the model's context has {counter.context}: lower "
            "prompt.rows, or pass a model with a longer context"
        )
    return min(wanted, counter.context - tokens)


def check_context(prompts: Mapping[str, Prompt], max_new: int, counter: TokenCounter, setting: str) -> None:
    """Raise TrainerError if a prompt and the longest plan allowed exceed the model's context. ``setting`` names ``max_new``."""
    room = room_for(max_new, prompts, counter)
    if room < max_new:
        task_id, tokens = _longest(prompts, counter)
        raise TrainerError(
            f"the prompt of the task {task_id!r} has {tokens} tokens, which leaves {room} of the model's context of "
            f"{counter.context}, and {setting} is {max_new}: lower one of {setting} and prompt.rows, or pass a model with "
            "a longer context"
        )


def _longest(prompts: Mapping[str, Prompt], counter: TokenCounter) -> tuple[str, int]:
    """Return the task with the longest prompt, and its tokens."""
    lengths = {task_id: counter.prompt_tokens(prompt) for task_id, prompt in prompts.items()}
    task_id = max(lengths, key=lengths.__getitem__)
    return task_id, lengths[task_id]


def expressibility(
    tasks: Sequence[TrainingTask], limits: Limits, counter: TokenCounter, *, refused: int = 0
) -> Expressibility:
    """Examine tasks. Those without an oracle plan are left out. ``refused`` further tasks need skills that are not offered."""
    known = [task for task in tasks if task.oracle]
    obstacles = Counter({Obstacle.SKILLS: refused} if refused else {})
    words: set[str] = set()
    most_rows = max(map(rows_needed, known), default=1)
    most_tokens = 1
    for task in known:
        text = plan_of(task, limits.rows, counter.codec)
        unknown, rows, tokens = counter.unknown_words(text), rows_needed(task), counter.plan_tokens(text)
        words |= unknown
        # Names get numbers when more rows of their category are listed, so plans grow with the rows.
        with_all = counter.plan_tokens(plan_of(task, most_rows, counter.codec))
        most_tokens = max(most_tokens, tokens, with_all)
        if unknown & set(Skill):
            obstacles[Obstacle.SKILLS] += 1
        elif unknown:
            obstacles[Obstacle.VOCABULARY] += 1
        elif rows > limits.rows:
            obstacles[Obstacle.ROWS] += 1
        elif tokens > limits.max_new:
            obstacles[Obstacle.LENGTH] += 1
    return Expressibility(len(known) + refused, obstacles, Limits(most_rows, most_tokens), frozenset(words))


SHOWN_WORDS: Final = 3


def sentence_about(found: Expressibility, named: str, limits: Limits, setting: str) -> str:
    """Return the share of inexpressible tasks, and the setting to change for each obstacle.

    ``named`` says which tasks, ``setting`` names the limit of tokens. Above ``WARNING_SHARE`` the sentence is a warning.
    """
    if not found.tasks:
        return f"{named}: no oracle plans, so it is unknown which tasks can be expressed"
    start = "warning: " if found.share > WARNING_SHARE else ""
    counted = f"{start}{found.inexpressible} of {found.tasks} {named} ({found.share:.1%}) can't be expressed"
    words = ", ".join(sorted(found.words)[:SHOWN_WORDS])
    missing = f" ({words})" if words else ""
    remedies = {
        Obstacle.SKILLS: f"need skills that the model is not offered{missing}: change `profile` or `model`",
        Obstacle.VOCABULARY: f"need words that the model can't write{missing}: train a `model` on these tasks",
        Obstacle.ROWS: f"need objects beyond prompt.rows = {limits.rows}: {found.needed.rows} rows hold all",
        Obstacle.LENGTH: f"need plans beyond {setting} = {limits.max_new} tokens: {found.needed.max_new} hold all",
    }
    reasons = [f"{found.obstacles[kind]} {remedies[kind]}" for kind in Obstacle if found.obstacles.get(kind)]
    return ": ".join([counted, "; ".join(reasons)] if reasons else [counted])
