"""The default policy: a from-scratch word-level transformer that learns on two CPU cores within minutes."""

from __future__ import annotations

import copy
import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import torch
from torch.nn import functional

from embomatrix.skills.prompt import Codec
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.policy.compute_dtype import unchanged
from embomatrix.trainer.policy.decoder import Decoder, DecoderShape
from embomatrix.trainer.policy.drawing import draw
from embomatrix.trainer.policy.grammar import PlanGrammar
from embomatrix.trainer.policy.protocol import Samples, Scored
from embomatrix.trainer.policy.vocabulary import END, GO, PAD, Vocabulary

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from torch import Tensor, nn

    from embomatrix.skills.prompt import Prompt
    from embomatrix.trainer.policy.decoder import DecoderCache, PromptMemory
    from embomatrix.trainer.policy.grammar import Cursor, Names
    from embomatrix.trainer.policy.protocol import Tokens

_COMPACT_SHARE = 0.6
"""Rows that have ended are dropped from the sampling loop once so few go on: most plans are much shorter than the longest."""
_LENGTH_CLASSES = 4
"""Plans are scored in this many batches of like length, each padded to its own longest."""
NETWORK = 2
"""Version of the network: weights of another one mean something else."""
_UNLIKELY = -80.0
"""Log-probabilities below this add nothing to an entropy, and their exponentials take ten times as long."""
_WEIGHTS = "weights.pt"
_DESCRIPTION = "tiny.json"


@dataclass(frozen=True, slots=True, eq=False)
class _Writing:
    """Plans under way: their rows in the result, which of them go on, and what the next word of each follows from."""

    rows: Tensor
    going: Tensor
    memory: PromptMemory
    names: Names
    cursor: Cursor
    own: DecoderCache | None

    def after(self, choice: Tensor, grammar: PlanGrammar) -> _Writing:
        """With one more word of each plan (rows,)."""
        return replace(self, going=self.going & (choice != END), cursor=grammar.advanced(self.cursor, choice))

    def kept(self) -> Tensor:
        """Indices of the plans that go on, with ended ones among them so that every prompt left has as many."""
        going = self.going.view(len(self.memory.lengths), -1)  # (Q, G)
        left = going.sum(dim=1)
        prompts = left.nonzero()[:, 0]
        first = going[prompts].argsort(dim=1, descending=True, stable=True)[:, : int(left.max())]
        return (prompts[:, None] * going.shape[1] + first).flatten()

    def of_rows(self, kept: Tensor) -> _Writing:
        """The plans that ``kept`` named alone."""
        of_prompt = kept * len(self.memory.lengths) // len(self.going)
        prompts = torch.unique(of_prompt)
        return _Writing(
            self.rows[kept],
            self.going[kept],
            self.memory if len(prompts) == len(self.memory.lengths) else self.memory.of_rows(prompts),
            self.names.of_rows(kept),
            self.cursor.of_rows(kept),
            self.own.of_rows(kept) if self.own else None,
        )


class TinyPolicy:
    """A ``Decoder`` over a ``Vocabulary``, which multiplies in ``products``; plans are written in the ``names`` codec."""

    def __init__(
        self,
        vocabulary: Vocabulary,
        shape: DecoderShape,
        *,
        seed: int,
        device: str = "cpu",
        products: torch.dtype = torch.float32,
    ) -> None:
        self.vocabulary = vocabulary
        self.network = Decoder(shape, torch.Generator().manual_seed(seed), products).to(device)
        self.device = torch.device(device)
        self._grammar = PlanGrammar(vocabulary, self.device)

    @property
    def name(self) -> str:
        return "tiny"

    @property
    def codec(self) -> Codec:
        return Codec.NAMES

    @property
    def module(self) -> nn.Module:
        return self.network

    def parameters(self) -> Iterator[nn.Parameter]:
        return self.network.parameters()

    def encode(self, prompt: Prompt) -> Tokens:
        """Tokens of the prompt; its beginning is cut where it exceeds what the network can read."""
        tokens = self.vocabulary.encode(prompt.user)
        longest = self.network.shape.longest * 3 // 4
        return (*tokens[-longest:], GO)

    def encode_plan(self, text: str) -> Tokens:
        return (*self.vocabulary.encode(text), END)

    @torch.no_grad()
    def sample(
        self,
        prompts: Sequence[Tokens],
        group: int,
        temperature: float,
        max_new: int,
        generator: torch.Generator,
    ) -> Samples:
        writing = self._begun(prompts, group)
        state = writing.memory.last.repeat_interleave(group, dim=0)  # (rows, 1, C)
        count = len(writing.rows)
        tokens = torch.full((count, max_new), PAD, device=self.device)
        logprobs = torch.zeros(count, max_new, device=self.device)
        mask = torch.zeros(count, max_new, dtype=torch.bool, device=self.device)
        length = 0
        with unchanged(self.network):
            for at in range(max_new):
                barred = self._grammar.barred(writing.cursor, writing.names)[:, None]
                scores = self.network.scores(state, writing.memory, writing.own, barred)[:, 0]
                choice, logprob = draw(scores, temperature, generator)
                rows, going = writing.rows, writing.going
                tokens[rows, at] = torch.where(going, choice, PAD)
                logprobs[rows, at] = torch.where(going, logprob, 0.0)
                mask[rows, at] = going
                length = at + 1
                writing = writing.after(choice, self._grammar)
                kept = writing.kept()
                if len(kept) == 0:
                    break
                if len(kept) <= _COMPACT_SHARE * len(writing.going):
                    writing, choice = writing.of_rows(kept), choice[kept]
                state, own = self.network.extend(writing.memory, choice[:, None], writing.own)
                writing = replace(writing, own=own)
        drawn = tokens[:, :length]
        texts = tuple(self.vocabulary.decode(row) for row in drawn.tolist())
        return Samples(drawn, mask[:, :length], logprobs[:, :length], texts)

    def _begun(self, prompts: Sequence[Tokens], group: int) -> _Writing:
        """``group`` plans of each prompt, of which nothing is written."""
        memory = self.network.read(*self._padded(prompts))
        rows = torch.arange(len(prompts) * group, device=self.device)
        names = self._grammar.names(memory.tokens).of_rows(rows // group)
        going = torch.ones(len(rows), dtype=torch.bool, device=self.device)
        return _Writing(rows, going, memory, names, self._grammar.start(len(rows)), None)

    def logprobs(
        self, prompts: Sequence[Tokens], tokens: Tensor, mask: Tensor, group: int, temperature: float
    ) -> Scored:
        memory = self.network.read(*self._padded(prompts))
        of_prompt = torch.arange(len(tokens), device=self.device) // group
        barred = self._grammar.barred_along(
            tokens, self._grammar.names(memory.tokens).of_rows(of_prompt)
        )  # (rows, T, V)
        lengths = mask.sum(dim=1)
        order = torch.argsort(lengths, stable=True)
        scored = []
        for rows in order.tensor_split(min(_LENGTH_CLASSES, len(order))):
            size = max(1, int(lengths[rows].max()))
            apart = memory.of_rows(of_prompt[rows])
            scored.append(self._scored(apart, tokens[rows, :size], barred[rows, :size], temperature))
        back = torch.argsort(order)
        size = tokens.shape[1]
        chosen, entropy = (
            torch.cat([functional.pad(part, (0, size - part.shape[1])) for part in column])[back]
            for column in zip(*scored, strict=True)
        )
        return Scored(chosen * mask, entropy * mask)

    def _scored(
        self, memory: PromptMemory, tokens: Tensor, barred: Tensor, temperature: float
    ) -> tuple[Tensor, Tensor]:
        """Log-probability and entropy (rows, T) of each token (rows, T), where ``barred`` words (rows, T, V) get none."""
        states, written = memory.last, None  # (rows, 1, C)
        if tokens.shape[1] > 1:
            rest, written = self.network.extend(memory, tokens[:, :-1], None)
            states = torch.cat([states, rest], dim=1)  # (rows, T, C)
        scores = torch.log_softmax(
            self.network.scores(states, memory, written, barred) / (temperature or 1.0), dim=-1
        )  # (rows, T, V)
        chosen = scores.gather(-1, tokens[..., None])[..., 0]
        likely = scores.clamp(min=_UNLIKELY)
        entropy = -(likely.exp() * likely).sum(dim=-1)
        return chosen, entropy

    def _padded(self, prompts: Sequence[Tokens]) -> tuple[Tensor, Tensor]:
        longest = max(len(prompt) for prompt in prompts)
        tokens = torch.full((len(prompts), longest), PAD)
        hidden = torch.ones(len(prompts), longest, dtype=torch.bool)
        for row, prompt in enumerate(prompts):
            tokens[row, longest - len(prompt) :] = torch.tensor(prompt)
            hidden[row, longest - len(prompt) :] = False
        return tokens.to(self.device), hidden.to(self.device)

    def frozen_copy(self) -> TinyPolicy:
        twin = copy.copy(self)
        twin.network = copy.deepcopy(self.network).requires_grad_(False)
        return twin

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        torch.save(self.network.state_dict(), folder / _WEIGHTS)
        described = {
            "network": NETWORK,
            "shape": self.network.shape.as_dict(),
            "words": self.vocabulary.words,
            "things": self.vocabulary.thing_words,
            "rooms": self.vocabulary.room_words,
        }
        (folder / _DESCRIPTION).write_text(json.dumps(described))

    @classmethod
    def load(cls, folder: Path, *, device: str = "cpu", products: torch.dtype = torch.float32) -> Self:
        """Read what ``save`` wrote. Raises TrainerError where another version did, OSError, ValueError or RuntimeError where it
        is not that."""
        described = json.loads((folder / _DESCRIPTION).read_text())
        found = described.get("network", 1)
        if found != NETWORK:
            raise TrainerError(
                f"the policy in {folder} is a network of version {found}, this program runs {NETWORK}: imitate anew, or "
                "use the version of embomatrix that wrote it"
            )
        shape = DecoderShape(**described["shape"])
        words, things, rooms = (tuple(described[part]) for part in ("words", "things", "rooms"))
        policy = cls(Vocabulary(words, things, rooms), shape, seed=0, device=device, products=products)
        policy.network.load_state_dict(torch.load(folder / _WEIGHTS, map_location=device, weights_only=True))
        return policy

    @staticmethod
    def is_saved_in(folder: Path) -> bool:
        return (folder / _DESCRIPTION).is_file()
