"""Episodes that a language model plays side by side, as rows of tokens: its answers, and the observations between them.

Tokens are appended and never encoded again. The key-value cache stays from turn to turn; where a row has fewer new tokens than
others, the cache has a gap that nothing attends to.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from embomatrix.trainer.policy.episode_rows import EpisodeRow, samples_of_rows
from embomatrix.trainer.policy.protocol import Samples, Tokens, draw

if TYPE_CHECKING:
    from embomatrix.trainer.policy.hf import HfPolicy


class ChatRows:
    """``group`` episodes for each prompt: row q * group + i is episode i of prompt q. Each is answered, then told, in turn.

    An answer has at most ``longest`` tokens. One that is cut off there is ended before the policy is told what happened.
    """

    @torch.no_grad()
    def __init__(
        self,
        policy: HfPolicy,
        prompts: Sequence[Tokens],
        group: int,
        temperature: float,
        generator: torch.Generator,
        longest: int,
    ) -> None:
        self._policy = policy
        self._temperature = temperature
        self._generator = generator
        self._longest = longest
        self._rows = [EpisodeRow() for _ in range(len(prompts) * group)]
        self._prompt_lengths = [len(prompt) for prompt in prompts for _ in range(group)]
        with policy.computing():
            self._cache, self._mask, states = policy.read(prompts, group)  # mask (rows, P)
            self._scores = policy.next_scores(states).repeat_interleave(group, dim=0)  # (rows, V)
        self._device = self._mask.device
        self._playing = torch.arange(len(self._rows), device=self._device)
        """Row of each row of the tensors below. Finished ones leave."""
        self._lengths = self._mask.sum(dim=1)  # (rows,)
        self._ends = torch.tensor(policy.answer_ends, device=self._device)

    @torch.no_grad()
    def answer(self, rows: Sequence[int]) -> list[str | None]:
        """Sample the next answer of each of these rows. All others have ended.

        An answer is None if the context has no room for another one; then the row has ended.
        """
        room = {row for row in rows if self._room(row) >= self._longest + 1}
        for row in set(rows) - room:
            self._rows[row].is_full = True
        if room:
            self._keep_only(room)
            self._sample()
        return [self._rows[row].answers[-1] if row in room else None for row in rows]

    def _room(self, row: int) -> int:
        """Return the number of tokens that fit behind a row."""
        used = self._prompt_lengths[row] + len(self._rows[row].tokens)
        return (self._policy.context or used + self._longest + 1) - used

    def _keep_only(self, rows: set[int]) -> None:
        """Leave out all other rows."""
        kept = torch.isin(self._playing, torch.tensor(sorted(rows), device=self._device)).nonzero()[:, 0]
        if len(kept) < len(self._playing):
            self._cache.batch_select_indices(kept)
            self._playing, self._mask = self._playing[kept], self._mask[kept]
            self._lengths, self._scores = self._lengths[kept], self._scores[kept]

    def _sample(self) -> None:
        """Sample an answer for each row that plays."""
        going = torch.ones_like(self._playing, dtype=torch.bool)
        tokens, logprobs, own = [], [], []
        with self._policy.computing():
            for _ in range(self._longest):
                choice, logprob = draw(self._scores, self._temperature, self._generator)
                tokens.append(torch.where(going, choice, self._policy.pad))
                logprobs.append(logprob)
                own.append(going)
                self._extend(tokens[-1][:, None], going[:, None])
                going = going & ~torch.isin(choice, self._ends)
                if not bool(going.any()):
                    break
        lengths = torch.stack(own, dim=1).sum(dim=1).tolist()
        for row, words, scores, length, is_open in zip(
            self._playing.tolist(),
            torch.stack(tokens, dim=1).tolist(),
            torch.stack(logprobs, dim=1).tolist(),
            lengths,
            going.tolist(),
            strict=True,
        ):
            self._rows[row].add(words[:length], scores[:length])
            self._rows[row].answers.append(self._policy.text_of(words[:length]))
            self._rows[row].is_open = is_open

    def _extend(self, tokens: Tensor, real: Tensor) -> None:
        """Run the model on further tokens (rows, T), of which only the ``real`` ones count."""
        self._mask = torch.cat([self._mask, real.long()], dim=1)
        positions = self._lengths[:, None] + (real.cumsum(dim=1) - 1).clamp(min=0)
        states = self._policy.extend(tokens, self._mask, positions, self._cache)
        count = real.sum(dim=1)
        at = (count - 1).clamp(min=0)[:, None, None].expand(-1, 1, states.shape[2])
        scores = self._policy.next_scores(states.gather(1, at))
        self._scores = torch.where((count > 0)[:, None], scores, self._scores)
        self._lengths = self._lengths + count

    @torch.no_grad()
    def observe(self, rows: Sequence[int], texts: Sequence[str]) -> None:
        """Append the observation that follows its answer to each of these rows."""
        self._keep_only(set(rows))
        observations = dict(zip(rows, texts, strict=True))
        encoded = []
        for row in self._playing.tolist():
            ending = (self._policy.answer_end,) if self._rows[row].is_open else ()
            words = (*ending, *self._policy.encode_observation(observations[row]))[: max(0, self._room(row))]
            self._rows[row].add(words, None)
            encoded.append(torch.tensor(words, dtype=torch.long))
        if not any(map(len, encoded)):
            return
        tokens = pad_sequence(encoded, True, self._policy.pad).to(self._device)
        lengths = torch.tensor([len(words) for words in encoded], device=self._device)
        with self._policy.computing():
            self._extend(tokens, torch.arange(tokens.shape[1], device=self._device) < lengths[:, None])

    def samples(self) -> Samples:
        """Return all rows as samples."""
        return samples_of_rows(self._rows, self._device)
