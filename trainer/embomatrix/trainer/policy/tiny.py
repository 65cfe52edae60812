"""The default policy: a from-scratch word-level transformer that learns on two CPU cores within minutes."""

from __future__ import annotations

import copy
import json
from typing import TYPE_CHECKING, Self

import torch

from embomatrix.skills.prompt import Codec
from embomatrix.trainer.policy.decoder import Decoder, DecoderShape
from embomatrix.trainer.policy.drawing import draw
from embomatrix.trainer.policy.protocol import Samples, Scored
from embomatrix.trainer.policy.words import END, GO, PAD, Vocabulary

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from torch import Tensor, nn

    from embomatrix.skills.prompt import Prompt
    from embomatrix.trainer.policy.decoder import PromptMemory
    from embomatrix.trainer.policy.protocol import Tokens

_WEIGHTS = "weights.pt"
_DESCRIPTION = "tiny.json"


class TinyPolicy:
    """A ``Decoder`` over a ``Vocabulary``; plans are written in the ``names`` codec."""

    def __init__(
        self, vocabulary: Vocabulary, shape: DecoderShape, *, seed: int, device: str = "cpu"
    ) -> None:
        self.vocabulary = vocabulary
        self.network = Decoder(shape, torch.Generator().manual_seed(seed)).to(device)
        self.device = torch.device(device)

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
        memory = self.network.read(*self._padded(prompts))
        state = memory.states[:, -1:].repeat_interleave(group, dim=0)  # (rows, 1, C)
        rows = state.shape[0]
        own = None
        done = torch.zeros(rows, dtype=torch.bool, device=self.device)
        tokens, masks, logprobs = [], [], []
        for at in range(max_new):
            choice, logprob = draw(self._scores(state, memory)[:, 0], temperature, generator)
            choice = torch.where(done, PAD, choice)
            tokens.append(choice)
            masks.append(~done)
            logprobs.append(torch.where(done, 0.0, logprob))
            done = done | (choice == END)
            if bool(done.all()):
                break
            state, own = self.network.extend(memory, choice[:, None], own, at)
        drawn = torch.stack(tokens, dim=1)
        texts = tuple(self.vocabulary.decode(row) for row in drawn.tolist())
        return Samples(drawn, torch.stack(masks, dim=1), torch.stack(logprobs, dim=1), texts)

    def logprobs(
        self, prompts: Sequence[Tokens], tokens: Tensor, mask: Tensor, group: int, temperature: float
    ) -> Scored:
        memory = self.network.read(*self._padded(prompts))
        first = memory.states[:, -1:].repeat_interleave(group, dim=0)  # (rows, 1, C)
        states = first
        if tokens.shape[1] > 1:
            rest, _ = self.network.extend(memory, tokens[:, :-1], None, 0)
            states = torch.cat([first, rest], dim=1)  # (rows, T, C)
        scores = torch.log_softmax(
            self._scores(states, memory) / (temperature or 1.0), dim=-1
        )  # (rows, T, V)
        chosen = scores.gather(-1, tokens[..., None])[..., 0]
        entropy = -(scores.exp() * scores.clamp(min=-1e4)).sum(dim=-1)
        return Scored(chosen * mask, entropy * mask)

    def _scores(self, states: Tensor, memory: PromptMemory) -> Tensor:
        """Log-probabilities without padding and prompt marks: tokens that no plan holds."""
        barred = torch.zeros(len(self.vocabulary), dtype=torch.bool, device=self.device)
        barred[[PAD, GO]] = True
        return self.network.scores(states, memory, barred)

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
        described = {"shape": self.network.shape.as_dict(), "words": self.vocabulary.words}
        (folder / _DESCRIPTION).write_text(json.dumps(described))

    @classmethod
    def load(cls, folder: Path, *, device: str = "cpu") -> Self:
        """Read what ``save`` wrote. Raises OSError, ValueError or RuntimeError where it is not that."""
        described = json.loads((folder / _DESCRIPTION).read_text())
        shape = DecoderShape(**described["shape"])
        policy = cls(Vocabulary(tuple(described["words"])), shape, seed=0, device=device)
        policy.network.load_state_dict(torch.load(folder / _WEIGHTS, map_location=device, weights_only=True))
        return policy

    @staticmethod
    def is_saved_in(folder: Path) -> bool:
        return (folder / _DESCRIPTION).is_file()
