"""Default policy: a word-level transformer that learns from scratch on two CPU cores within minutes."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from embomatrix.skills.parse import DONE
from embomatrix.skills.prompt import Codec, Prompt
from embomatrix.trainer.policy.compute_dtype import frozen_weights
from embomatrix.trainer.policy.decoder import (
    Decoder,
    DecoderShape,
    PlanCache,
    PromptCache,
    Shortlist,
    check_weights,
)
from embomatrix.trainer.policy.grammar import GrammarState, PlanGrammar, PromptNames
from embomatrix.trainer.policy.protocol import (
    Samples,
    Tokens,
    TokenScores,
    draw,
    pad_left,
    token_entropy,
    written_lengths,
)
from embomatrix.trainer.policy.tensor_file import read_tensors
from embomatrix.trainer.policy.vocabulary import END, GO, PAD, Vocabulary
from embomatrix.world.json_text import parse_json

_COMPACTION_THRESHOLD = 0.6
"""Finished rows leave the sampling loop when this share or less is active: most plans are much shorter than the longest."""
_LENGTH_BUCKETS = 4
"""Plans are scored in this many buckets by length, each padded to its own longest plan."""
_MIN_LOGPROB = -80.0
"""Lower log-probabilities do not change an entropy, and their exponentials (denormal floats) take ten times as long."""
_WEIGHTS = "weights.pt"
_DESCRIPTION = "tiny.json"
_FORMAT: Final = 3
"""Version of a saved policy. Plans of version 1 had a word between two calls; version 2 had no coverage."""
EPISODE_CONTEXT: Final = 2048
"""Tokens of the context of a new policy for episodes."""
MAX_CONTEXT: Final = 65_536
"""Tokens of the longest context of a saved policy."""


def longest_prompt(shape: DecoderShape) -> int:
    """Return the tokens that a prompt may have before GO."""
    return shape.longest * 3 // 4


@dataclass(frozen=True, slots=True, eq=False)
class _SamplingState:
    """Plans during sampling: their rows in the result, a mask of active rows, and the model's and the grammar's state."""

    rows: Tensor
    active: Tensor
    prompts: PromptCache
    shortlist: Shortlist
    names: PromptNames
    grammar_state: GrammarState
    plan: PlanCache | None

    def advance(self, choice: Tensor, grammar: PlanGrammar) -> _SamplingState:
        """Append one word to each plan (rows,)."""
        return replace(
            self,
            active=self.active & (choice != END),
            grammar_state=grammar.advance(self.grammar_state, choice, self.names),
        )

    def select(self, kept: Tensor) -> _SamplingState:
        """State of the given rows only."""
        prompt_of_row = kept * len(self.prompts.lengths) // len(self.active)
        prompts = torch.unique(prompt_of_row)
        return _SamplingState(
            self.rows[kept],
            self.active[kept],
            self.prompts if len(prompts) == len(self.prompts.lengths) else self.prompts.select(prompts),
            self.shortlist,
            self.names.select(kept),
            self.grammar_state.select(kept),
            self.plan.select(kept) if self.plan else None,
        )


def rows_to_keep(active: Tensor, prompts: int) -> Tensor:
    """Return indices of the active rows (rows,). Finished ones are added so that each remaining prompt keeps equally many."""
    grouped = active.view(prompts, -1)  # (Q, G)
    left = grouped.sum(dim=1)
    remaining = left.nonzero()[:, 0]
    first = grouped[remaining].argsort(dim=1, descending=True, stable=True)[:, : int(left.max())]
    return (remaining[:, None] * grouped.shape[1] + first).flatten()


class TinyPolicy:
    """Policy with a ``Decoder`` over a ``Vocabulary``. It writes plans in the ``names`` codec, or with ``single_calls`` the
    answers of an episode, each with at most one call.
    """

    name = "tiny"
    codec = Codec.NAMES

    def __init__(
        self,
        vocabulary: Vocabulary,
        shape: DecoderShape,
        *,
        seed: int,
        device: str = "cpu",
        compute_dtype: torch.dtype = torch.float32,
        single_calls: bool = False,
    ) -> None:
        self.vocabulary = vocabulary
        self.module = Decoder(shape, torch.Generator().manual_seed(seed), compute_dtype).to(device)
        self.device = torch.device(device)
        self.single_calls = single_calls
        self.grammar = PlanGrammar(vocabulary, self.device, single_calls=single_calls)

    @property
    def context(self) -> int:
        return self.module.shape.longest

    def parameters(self) -> Iterator[nn.Parameter]:
        return self.module.parameters()

    def encode(self, prompt: Prompt) -> Tokens:
        """Return the prompt's tokens. Prompts beyond three quarters of the context lose their beginning."""
        tokens = self.vocabulary.encode(prompt.user)
        return (*tokens[-longest_prompt(self.module.shape) :], GO)

    def encode_plan(self, text: str) -> Tokens:
        return (*self.vocabulary.encode_plan(text), END)

    def encode_answer(self, text: str) -> Tokens:
        """Return the tokens of an answer in an episode. The policy says that it is done by an answer without words."""
        return self.encode_plan("" if text == DONE else text)

    def encode_observation(self, text: str) -> Tokens:
        """Return the tokens of an observation in an episode."""
        return tuple(self.vocabulary.encode(text))

    def unknown_words(self, text: str) -> frozenset[str]:
        return self.vocabulary.unknown_words(text)

    @torch.no_grad()
    def sample(
        self,
        prompts: Sequence[Tokens],
        group: int,
        temperature: float,
        max_new: int,
        generator: torch.Generator,
    ) -> Samples:
        state = self._initial_state(prompts, group)
        hidden = state.prompts.last.repeat_interleave(group, dim=0)  # (rows, 1, C)
        count = len(state.rows)
        tokens = torch.full((count, max_new), PAD, device=self.device)
        logprobs = torch.zeros(count, max_new, device=self.device)
        mask = torch.zeros(count, max_new, dtype=torch.bool, device=self.device)
        length = 0
        with frozen_weights(self.module):
            for at in range(max_new):
                words = state.shortlist.words
                token_mask = self.grammar.token_mask(state.grammar_state, state.names)[:, None, words]
                coverage = self.grammar.coverage(state.grammar_state, state.names, state.shortlist)[:, None]
                scores = self.module.scores(
                    hidden, state.prompts, state.plan, state.shortlist, token_mask, coverage
                )
                column, logprob = draw(scores[:, 0], temperature, generator)
                choice = words[column]
                rows, active = state.rows, state.active
                tokens[rows, at] = torch.where(active, choice, PAD)
                logprobs[rows, at] = torch.where(active, logprob, 0.0)
                mask[rows, at] = active
                length = at + 1
                state = state.advance(choice, self.grammar)
                kept = rows_to_keep(state.active, len(state.prompts.lengths))
                if len(kept) == 0:
                    break
                if len(kept) <= _COMPACTION_THRESHOLD * len(state.active):
                    state, choice = state.select(kept), choice[kept]
                hidden, plan = self.module.extend(state.prompts, choice[:, None], state.plan)
                state = replace(state, plan=plan)
        tokens, mask = tokens[:, :length], mask[:, :length]
        texts = tuple(self.vocabulary.decode_plan(row) for row in tokens.tolist())
        cut_off = mask[:, -1] & (tokens[:, -1] != END)
        return Samples(tokens, mask, logprobs[:, :length], texts, cut_off)

    def _initial_state(self, prompts: Sequence[Tokens], group: int) -> _SamplingState:
        """Start ``group`` empty plans per prompt."""
        cache = self.module.encode_prompts(*pad_left(prompts, PAD, self.device))
        rows = torch.arange(len(prompts) * group, device=self.device)
        names = self.grammar.prompt_names(cache.tokens)
        shortlist = Shortlist.of(self.grammar.words(names))
        active = torch.ones(len(rows), dtype=torch.bool, device=self.device)
        return _SamplingState(
            rows, active, cache, shortlist, names.select(rows // group), self.grammar.start(len(rows)), None
        )

    def logprobs(
        self,
        prompts: Sequence[Tokens],
        tokens: Tensor,
        mask: Tensor,
        group: int,
        temperature: float,
        *,
        entropy_gradient: bool = False,
    ) -> TokenScores:
        cache = self.module.encode_prompts(*pad_left(prompts, PAD, self.device))
        prompt_of_row = torch.arange(len(tokens), device=self.device) // group
        names = self.grammar.prompt_names(cache.tokens)
        included = self.grammar.words(names)
        included[tokens] = True  # other sources' plans may break the grammar
        shortlist = Shortlist.of(included)
        lengths = written_lengths(mask)
        observed = ~mask & (torch.arange(tokens.shape[1], device=self.device) < lengths[:, None])  # (rows, T)
        in_episodes = bool(observed.any())
        places = _own_places(mask) if in_episodes else _all_places(tokens)
        token_masks, coverages = self.grammar.rules_of_plans(
            tokens, names.select(prompt_of_row), shortlist, places, observed if in_episodes else None
        )
        order = torch.argsort(lengths, stable=True)
        scores = []
        for rows in order.tensor_split(min(_LENGTH_BUCKETS, len(order))):
            length = max(1, int(lengths[rows].max()))
            count = max(1, int(mask[rows].sum(dim=1).max())) if in_episodes else length
            scores.append(
                self._score(
                    cache.select(prompt_of_row[rows]),
                    tokens[rows, :length],
                    shortlist,
                    places[rows, :count] if in_episodes else None,
                    token_masks[rows, :count],
                    coverages[rows, :count],
                    temperature,
                    entropy_gradient,
                )
            )
        restore_order = torch.argsort(order)
        length = tokens.shape[1]
        chosen, entropy = (
            torch.cat([functional.pad(part, (0, length - part.shape[1])) for part in column])[restore_order]
            for column in zip(*scores, strict=True)
        )
        return TokenScores(chosen * mask, entropy * mask)

    def _score(
        self,
        prompts: PromptCache,
        tokens: Tensor,
        shortlist: Shortlist,
        places: Tensor | None,
        token_masks: Tensor,
        coverages: Tensor,
        temperature: float,
        entropy_gradient: bool,
    ) -> tuple[Tensor, Tensor]:
        """Return log-probability and entropy (rows, T) of tokens (rows, T). token_masks, coverages: (rows, M, K).

        Only tokens at ``places`` (rows, M) are scored, all if it is None.
        """
        hidden, plan = prompts.last, None  # (rows, 1, C)
        if tokens.shape[1] > 1:
            rest, plan = self.module.extend(prompts, tokens[:, :-1], None)
            hidden = torch.cat([hidden, rest], dim=1)  # (rows, T, C)
        if places is not None:
            hidden = hidden.gather(1, places[..., None].expand(-1, -1, hidden.shape[2]))  # (rows, M, C)
        scores = torch.log_softmax(
            self.module.scores(hidden, prompts, plan, shortlist, token_masks, coverages, places)
            / (temperature or 1.0),
            dim=-1,
        )  # (rows, M, K)
        scored = tokens if places is None else tokens.gather(1, places)
        chosen = scores.gather(-1, shortlist.columns[scored][..., None])[..., 0]
        entropy = token_entropy(scores, gradient=entropy_gradient, minimum=_MIN_LOGPROB)
        if places is None:
            return chosen, entropy
        empty = chosen.new_zeros(tokens.shape)
        return empty.scatter(1, places, chosen), empty.scatter(1, places, entropy)

    def frozen_copy(self) -> TinyPolicy:
        twin = copy.copy(self)
        twin.module = copy.deepcopy(self.module).requires_grad_(False)
        return twin

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        torch.save(self.module.state_dict(), folder / _WEIGHTS)
        description = {
            "format": _FORMAT,
            "shape": asdict(self.module.shape),
            "words": self.vocabulary.words,
            "objects": self.vocabulary.object_words,
            "rooms": self.vocabulary.room_words,
            "single_calls": self.single_calls,
        }
        (folder / _DESCRIPTION).write_text(json.dumps(description))

    @classmethod
    def load(cls, folder: Path, *, device: str = "cpu", compute_dtype: torch.dtype = torch.float32) -> Self:
        """Load a policy that ``save`` wrote. Raises OSError, ValueError or RuntimeError if it is damaged."""
        vocabulary, shape, single_calls = cls.described_in(folder)
        weights = read_tensors(folder / _WEIGHTS, device=device)
        check_weights(shape, weights)
        policy = cls(
            vocabulary, shape, seed=0, device=device, compute_dtype=compute_dtype, single_calls=single_calls
        )
        policy.module.load_state_dict(weights)
        return policy

    @staticmethod
    def described_in(folder: Path) -> tuple[Vocabulary, DecoderShape, bool]:
        """Read the vocabulary and the shape of a saved policy, and whether it writes single calls, not its weights.

        Raises OSError, ValueError, TypeError or LookupError if the description is damaged.
        """
        description = parse_json((folder / _DESCRIPTION).read_bytes())
        if not isinstance(description, dict):
            raise ValueError(f"{_DESCRIPTION} holds {type(description).__name__}: expected a table")
        if (found := description.get("format")) != _FORMAT:
            raise ValueError(
                f"{_DESCRIPTION} has the format {found or 1}, of an older version: expected {_FORMAT}; train the "
                "policy again"
            )
        shape = DecoderShape(**description["shape"])
        words, objects, rooms = (tuple(map(str, description[part])) for part in ("words", "objects", "rooms"))
        vocabulary = Vocabulary(words, objects, rooms)
        if len(vocabulary) != shape.vocabulary or not 0 < shape.longest <= MAX_CONTEXT:
            raise ValueError(
                f"{_DESCRIPTION} has {len(vocabulary)} words and a context of {shape.longest}: expected {shape.vocabulary} "
                f"words, and 1 to {MAX_CONTEXT}"
            )
        return vocabulary, shape, bool(description.get("single_calls", False))

    @staticmethod
    def is_saved_in(folder: Path) -> bool:
        return (folder / _DESCRIPTION).is_file()


def _all_places(tokens: Tensor) -> Tensor:
    """Return every place of the rows (rows, T)."""
    return torch.arange(tokens.shape[1], device=tokens.device).expand(tokens.shape)


def _own_places(mask: Tensor) -> Tensor:
    """Return the places of each row's own tokens (rows, M), then others up to the largest number M of own tokens."""
    order = torch.argsort((~mask).int(), dim=1, stable=True)
    return order[:, : max(1, int(mask.sum(dim=1).max()))]
