"""Episodes that the word-level policy plays side by side: answers are sampled, observations appended.

Tokens are appended and never encoded again, so those that are trained on are those that were sampled. Each episode is one row
of tokens behind its prompt, as a plan is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from embomatrix.skills.parse import DONE
from embomatrix.trainer.policy.compute_dtype import frozen_weights
from embomatrix.trainer.policy.decoder import PlanCache, Shortlist
from embomatrix.trainer.policy.protocol import Samples, Tokens, draw, pad_left
from embomatrix.trainer.policy.tiny import TinyPolicy, rows_to_keep
from embomatrix.trainer.policy.vocabulary import END, PAD

_LONGEST_ANSWER: Final = 16
"""Words of an answer. The grammar ends every answer with one call before."""


@dataclass(slots=True)
class EpisodeRow:
    """Tokens of one episode behind its prompt, which of them the policy wrote, and their log-probabilities."""

    tokens: list[int] = field(default_factory=list)
    own: list[bool] = field(default_factory=list)
    logprobs: list[float] = field(default_factory=list)
    answers: list[str] = field(default_factory=list)
    is_full: bool = False
    """True if the context had no room for another answer."""
    is_open: bool = False
    """True if the last answer was cut off before its end."""

    def add(self, tokens: Sequence[int], logprobs: Sequence[float] | None) -> None:
        """Append tokens. Those of observations have no log-probabilities."""
        self.tokens += tokens
        self.own += [logprobs is not None] * len(tokens)
        self.logprobs += [0.0] * len(tokens) if logprobs is None else logprobs


class EpisodeRows:
    """``group`` episodes for each prompt: row q * group + i is episode i of prompt q. Each is answered, then told, in turn."""

    def __init__(
        self,
        policy: TinyPolicy,
        prompts: Sequence[Tokens],
        group: int,
        temperature: float,
        generator: torch.Generator,
    ) -> None:
        self._policy = policy
        self._temperature = temperature
        self._generator = generator
        self._rows = [EpisodeRow() for _ in range(len(prompts) * group)]
        self._prompt_lengths = [len(prompt) for prompt in prompts]
        with torch.no_grad(), frozen_weights(policy.module):
            self._prompts = policy.module.encode_prompts(*pad_left(prompts, PAD, policy.device))
        self._playing = torch.arange(len(self._rows), device=policy.device)
        """Row of each row of the tensors below. Finished ones leave, as far as each prompt keeps equally many."""
        self._group = group
        names = policy.grammar.prompt_names(self._prompts.tokens)
        self._names = names.select(self._playing // group)
        self._grammar_state = policy.grammar.start(len(self._rows))
        self._plan: PlanCache | None = None
        self._states = self._prompts.last.repeat_interleave(group, dim=0)  # (rows, 1, C)

    @torch.no_grad()
    def answer(self, rows: Sequence[int]) -> list[str | None]:
        """Sample the next answer of each of these rows. All others have ended.

        An answer is None if the context has no room for another one; then the row has ended.
        """
        room = {row for row in rows if self._room(row) >= _LONGEST_ANSWER}
        for row in set(rows) - room:
            self._rows[row].is_full = True
        if not room:
            return [None] * len(rows)
        answers = dict(zip(sorted(room), self._sample(sorted(room)), strict=True))
        return [answers.get(row) for row in rows]

    def _room(self, row: int) -> int:
        """Return the number of tokens that fit behind a row."""
        return self._policy.context - self._prompt_lengths[row // self._group] - len(self._rows[row].tokens)

    def _sample(self, rows: Sequence[int]) -> list[str]:
        self._drop_all_but(rows)
        policy, going = (
            self._policy,
            torch.isin(self._playing, torch.tensor(rows, device=self._playing.device)),
        )
        shortlist = Shortlist.of(policy.grammar.words(self._names))
        tokens, logprobs, own = [], [], []
        with frozen_weights(policy.module):
            for _ in range(_LONGEST_ANSWER):
                choice, logprob = self._draw(shortlist)
                tokens.append(torch.where(going, choice, PAD))
                logprobs.append(logprob)
                own.append(going)
                self._extend(tokens[-1][:, None], ~going[:, None])
                advanced = policy.grammar.advance(self._grammar_state, tokens[-1], self._names)
                self._grammar_state = advanced
                going = going & (choice != END)
                if not bool(going.any()):
                    break
        return self._keep(
            torch.stack(tokens, dim=1), torch.stack(logprobs, dim=1), torch.stack(own, dim=1), rows
        )

    def _draw(self, shortlist: Shortlist) -> tuple[Tensor, Tensor]:
        """Draw the next word of each row; return words and log-probabilities (rows,)."""
        policy, state, names = self._policy, self._grammar_state, self._names
        token_mask = policy.grammar.token_mask(state, names)[:, None, shortlist.words]
        coverage = policy.grammar.coverage(state, names, shortlist)[:, None]
        scores = policy.module.scores(
            self._states, self._prompts, self._plan, shortlist, token_mask, coverage
        )
        column, logprob = draw(scores[:, 0], self._temperature, self._generator)
        return shortlist.words[column], logprob

    def _extend(self, tokens: Tensor, gaps: Tensor) -> None:
        """Run the network on further tokens (rows, T), and keep the state at each row's last one."""
        states, self._plan = self._policy.module.extend(self._prompts, tokens, self._plan, gaps)
        count = (~gaps).sum(dim=1)
        at = (count - 1).clamp(min=0)[:, None, None].expand(-1, 1, states.shape[2])
        self._states = torch.where((count > 0)[:, None, None], states.gather(1, at), self._states)

    def _keep(self, tokens: Tensor, logprobs: Tensor, own: Tensor, rows: Sequence[int]) -> list[str]:
        """Append the answers to their rows. Return their texts in the order of ``rows``."""
        lengths = own.sum(dim=1).tolist()
        for row, words, scores, length in zip(
            self._playing.tolist(), tokens.tolist(), logprobs.tolist(), lengths, strict=True
        ):
            if length:
                self._rows[row].add(words[:length], scores[:length])
                self._rows[row].answers.append(self._policy.vocabulary.decode_plan(words[:length]) or DONE)
        return [self._rows[row].answers[-1] for row in rows]

    @torch.no_grad()
    def observe(self, rows: Sequence[int], texts: Sequence[str]) -> None:
        """Append the observation that follows its answer to each of these rows."""
        policy, observations = self._policy, dict(zip(rows, texts, strict=True))
        encoded = [
            policy.encode_observation(observations[row])[: max(0, self._room(row))]
            if row in observations
            else ()
            for row in self._playing.tolist()
        ]
        if not any(encoded):
            return
        for row, words in zip(self._playing.tolist(), encoded, strict=True):
            self._rows[row].add(words, None)
        tokens = pad_sequence([torch.tensor(words, dtype=torch.long) for words in encoded], True, PAD)
        lengths = torch.tensor([len(words) for words in encoded])
        gaps = torch.arange(tokens.shape[1]) >= lengths[:, None]
        tokens, gaps = tokens.to(policy.device), gaps.to(policy.device)
        policy.grammar.observe(self._names, tokens, ~gaps)
        self._grammar_state = policy.grammar.after_observation(
            self._grammar_state, lengths.to(policy.device) > 0
        )
        with frozen_weights(policy.module):
            self._extend(tokens, gaps)
        self._plan = self._plan.closed() if self._plan else None

    def _drop_all_but(self, rows: Sequence[int]) -> None:
        """Leave out ended rows. Some are kept, so that each remaining prompt has equally many."""
        active = torch.isin(self._playing, torch.tensor(rows, device=self._playing.device))
        count = len(self._prompts.lengths)
        kept = rows_to_keep(active, count)
        if len(kept) == len(self._playing):
            return
        prompts = torch.unique(kept * count // len(active))
        if len(prompts) < count:
            self._prompts = self._prompts.select(prompts)
        self._playing, self._names = self._playing[kept], self._names.select(kept)
        self._grammar_state, self._states = self._grammar_state.select(kept), self._states[kept]
        self._plan = self._plan.select(kept) if self._plan else None

    def samples(self) -> Samples:
        """Return all rows as samples."""
        return samples_of_rows(self._rows, self._policy.device)


def samples_of_rows(rows: Sequence[EpisodeRow], device: torch.device) -> Samples:
    """Return episodes as samples, without what they were told at their end. Texts are answers, one a line.

    Cut-off rows are those whose context had no room for another answer. There is at least one column.
    """
    for row in rows:
        last = max((at for at, own in enumerate(row.own, 1) if own), default=0)
        del row.tokens[last:], row.own[last:], row.logprobs[last:]

    def padded(values: Sequence[Sequence[float]], kind: torch.dtype) -> Tensor:
        longest = [0] * max(1, *map(len, values))
        filled = pad_sequence([torch.tensor(each, dtype=kind) for each in (*values, longest)], True)
        return filled[:-1].to(device)

    return Samples(
        padded([row.tokens for row in rows], torch.long),
        padded([row.own for row in rows], torch.bool),
        padded([row.logprobs for row in rows], torch.float32),
        tuple("\n".join(row.answers) for row in rows),
        torch.tensor([row.is_full for row in rows], device=device),
    )
