"""A small transformer in plain torch, whose prompt is read at once and runs once for all samples of its group.

Llama-like: RMS norms, rotary positions, gated feed-forward, tied embedding; queries and keys are normed before they meet (Henry
et al. 2020). A word comes in with a share of the word before it, so that already the first layer can look for what follows an
equal word. The last layer may also *point*: a part of the probability goes to words of the prompt, and to those of the plan so
far, by attention (pointer networks; See et al. 2017, eq. 9). Naming an object that the instruction names, or the one that the
plan went to, is then a matter of looking, for words seldom met as for frequent ones.

Shapes: Q prompts, G samples of each, P prompt tokens, T new tokens, H heads of width D, C = H * D.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import nn
from torch.nn import functional

from embomatrix.trainer.policy.compute_dtype import Product

if TYPE_CHECKING:
    from torch import Tensor

_HIDDEN_KEY = -1e9
_LEAST = 1e-9
_OF_BEFORE = 0.3
"""The share of the word before a word, at first."""


@dataclass(frozen=True, slots=True)
class DecoderShape:
    """Sizes of the network. ``width`` is a multiple of ``heads``."""

    vocabulary: int
    layers: int = 4
    width: int = 128
    heads: int = 4
    inner: int = 384
    longest: int = 1024

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True, slots=True)
class LayerMemory:
    """What one layer keeps of tokens it has seen: keys and values, both (rows, H, tokens, D)."""

    keys: Tensor
    values: Tensor

    def of_rows(self, rows: Tensor) -> LayerMemory:
        return LayerMemory(self.keys[rows], self.values[rows])


@dataclass(frozen=True, slots=True)
class PromptMemory:
    """A batch of prompts, run. ``tokens`` (Q, P); ``hidden`` (Q, P) is true on padding; ``lengths`` (Q,); ``last`` (Q, 1, C),
    the last layer's state after the last token; ``pointers`` (Q, P, C), what a word is pointed at by."""

    layers: tuple[LayerMemory, ...]
    tokens: Tensor
    hidden: Tensor
    lengths: Tensor
    last: Tensor
    pointers: Tensor

    def of_rows(self, prompts: Tensor) -> PromptMemory:
        """The prompts with these indices (rows,), each as often as it is named.

        Rows that end at different lengths can then be run apart, as groups of one, without the padding of the longest.
        """
        return PromptMemory(
            tuple(layer.of_rows(prompts) for layer in self.layers),
            self.tokens[prompts],
            self.hidden[prompts],
            self.lengths[prompts],
            self.last[prompts],
            self.pointers[prompts],
        )


@dataclass(frozen=True, slots=True)
class DecoderCache:
    """Plans as far as they are run: what each layer keeps of them; ``tokens`` (rows, S); ``pointers`` (rows, S, C), what their
    words are pointed at by."""

    layers: tuple[LayerMemory, ...]
    tokens: Tensor
    pointers: Tensor

    def of_rows(self, rows: Tensor) -> DecoderCache:
        layers = tuple(layer.of_rows(rows) for layer in self.layers)
        return DecoderCache(layers, self.tokens[rows], self.pointers[rows])


class _Block(nn.Module):
    def __init__(self, shape: DecoderShape, products: torch.dtype) -> None:
        super().__init__()
        self.heads = shape.heads
        self.before_attention = nn.RMSNorm(shape.width)
        self.qkv = Product(shape.width, 3 * shape.width, products)
        self.of_query = nn.RMSNorm(shape.width // shape.heads)
        self.of_key = nn.RMSNorm(shape.width // shape.heads)
        self.out = Product(shape.width, shape.width, products)
        self.before_inner = nn.RMSNorm(shape.width)
        self.gate_up = Product(shape.width, 2 * shape.inner, products)
        self.down = Product(shape.inner, shape.width, products)

    def project(self, x: Tensor, rope: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Queries, keys and values (rows, H, T, D) of x (rows, T, C)."""
        rows, length, width = x.shape
        product = self.qkv(self.before_attention(x)).to(x.dtype)
        split = product.view(rows, length, 3, self.heads, width // self.heads).permute(2, 0, 3, 1, 4)
        normed = torch.stack([self.of_query(split[0]), self.of_key(split[1])])
        q, k = _rotated(normed, rope)  # each (rows, H, T, D)
        return q, k, split[2]

    def finish(self, x: Tensor, attended: Tensor) -> Tensor:
        """Add attention's result (rows, H, T, D) and the feed-forward to x (rows, T, C)."""
        x = x + self.out(attended.transpose(1, 2).reshape(x.shape))
        gate, up = self.gate_up(self.before_inner(x)).chunk(2, dim=-1)
        return x + self.down(functional.silu(gate) * up)  # type: ignore[no-any-return]


def _rotated(x: Tensor, rope: tuple[Tensor, Tensor]) -> Tensor:
    cos, sin = rope
    left, right = x.chunk(2, dim=-1)
    return x * cos + torch.cat([-right, left], dim=-1) * sin


class Decoder(nn.Module):
    """The network. ``read`` runs prompts, ``extend`` runs samples that continue them."""

    cos: Tensor
    sin: Tensor

    def __init__(
        self, shape: DecoderShape, generator: torch.Generator, products: torch.dtype = torch.float32
    ) -> None:
        super().__init__()
        self.shape = shape
        self.embedding = nn.Embedding(shape.vocabulary, shape.width)
        self.of_before = nn.Parameter(torch.full((shape.width,), _OF_BEFORE))
        self.blocks = nn.ModuleList(_Block(shape, products) for _ in range(shape.layers))
        self.norm = nn.RMSNorm(shape.width)
        self.point_from = nn.Linear(shape.width, shape.width, bias=False)
        self.point_to = nn.Linear(shape.width, shape.width, bias=False)
        self.point_share = nn.Linear(shape.width, 1)
        half = shape.width // shape.heads // 2
        angles = torch.outer(torch.arange(shape.longest).float(), 10000.0 ** (-torch.arange(half) / half))
        self.register_buffer("cos", angles.cos().repeat(1, 2), persistent=False)
        self.register_buffer("sin", angles.sin().repeat(1, 2), persistent=False)
        for name, parameter in self.named_parameters():
            if parameter.dim() > 1:
                nn.init.normal_(parameter, std=0.02, generator=generator)
            if name.endswith(("out.weight", "down.weight")):
                parameter.data /= (2 * shape.layers) ** 0.5
        nn.init.zeros_(self.point_share.bias)

    def scores(
        self, states: Tensor, prompt: PromptMemory, written: DecoderCache | None, barred: Tensor
    ) -> Tensor:
        """Scores (Q * G, T, V), whose softmax says what comes after hidden states (Q * G, T, C); words in ``barred``, of that
        shape, get none.

        The states are the last T of those after the prompt and after each word that is ``written``.
        """
        x = self.norm(states)
        generated = torch.softmax((x @ self.embedding.weight.t()).masked_fill(barred, _HIDDEN_KEY), dim=-1)
        attention, words = self._pointed(x, prompt, written, barred)
        pointed = torch.zeros_like(generated).scatter_add(2, words, attention)
        share = torch.sigmoid(self.point_share(x))  # (Q G, T, 1)
        mixed = torch.lerp(generated, pointed, share)
        return mixed.clamp(min=_LEAST).log().masked_fill(barred, _HIDDEN_KEY)

    def _pointed(
        self, x: Tensor, prompt: PromptMemory, written: DecoderCache | None, barred: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Where normed states point: probabilities of places, those of the prompt first, and the words there; both
        (Q * G, T, P + S). Where all words are barred, nowhere."""
        rows, length, width = x.shape
        prompts, prompt_length = prompt.tokens.shape
        asked = self.point_from(x) * width**-0.5  # (Q G, T, C)
        looked = (asked.view(prompts, -1, width) @ prompt.pointers.transpose(1, 2)).view(rows, length, -1)
        group = rows // prompts
        words = prompt.tokens.repeat_interleave(group, dim=0)[:, None].expand(rows, length, prompt_length)
        hidden = prompt.hidden.repeat_interleave(group, dim=0)[:, None].expand(rows, length, prompt_length)
        if written:
            count = written.tokens.shape[1]
            later = torch.ones(length, count, dtype=torch.bool, device=x.device).triu(count - length + 1)
            looked = torch.cat([looked, asked @ written.pointers.transpose(1, 2)], dim=2)
            words = torch.cat([words, written.tokens[:, None].expand(rows, length, count)], dim=2)
            hidden = torch.cat([hidden, later.expand(rows, length, count)], dim=2)
        nowhere = hidden | barred.gather(2, words)
        # Nothing, rather than everything alike, where no place is left: the softmax of the scores makes up for it.
        attention = torch.softmax(looked.masked_fill(nowhere, _HIDDEN_KEY), dim=-1)
        return attention.masked_fill(nowhere, 0.0), words

    def _rope(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """positions: (rows, T)."""
        return self.cos[positions][:, None], self.sin[positions][:, None]

    def _in_line(self, words: Tensor, before: Tensor) -> Tensor:
        """What comes in (rows, T, C) of words, of that shape, where the first of each row follows ``before`` (rows, 1, C)."""
        return words + self.of_before * torch.cat([before, words[:, :-1]], dim=1)

    def read(self, tokens: Tensor, hidden: Tensor) -> PromptMemory:
        """tokens (Q, P), padded on the left; hidden (Q, P) is true on the padding."""
        lengths = (~hidden).sum(dim=1)
        positions = ((~hidden).cumsum(dim=1) - 1).clamp(min=0)
        rope = self._rope(positions)
        bias = (hidden.float() * _HIDDEN_KEY)[:, None, None]  # (Q, 1, 1, P): a token sees the whole prompt
        words = self.embedding(tokens).masked_fill(hidden[..., None], 0.0)
        x = self._in_line(words, torch.zeros_like(words[:, :1]))
        memories = []
        for block in self.blocks:
            q, k, v = block.project(x, rope)  # type: ignore[operator]
            attended = functional.scaled_dot_product_attention(q, k, v, attn_mask=bias)
            x = block.finish(x, attended)  # type: ignore[operator]
            memories.append(LayerMemory(k, v))
        pointers = self.point_to(self.norm(x))
        return PromptMemory(tuple(memories), tokens, hidden, lengths, x[:, -1:], pointers)

    def extend(
        self, prompt: PromptMemory, tokens: Tensor, written: DecoderCache | None
    ) -> tuple[Tensor, DecoderCache]:
        """Hidden states (Q * G, T, C) of tokens (Q * G, T) that follow what is ``written`` after their prompts.

        ``written`` is what ``extend`` gave for the samples' own earlier tokens, None at the first.
        """
        rows, length = tokens.shape
        start = written.tokens.shape[1] if written else 0
        group = rows // prompt.lengths.shape[0]
        begin = prompt.lengths.repeat_interleave(group)[:, None] + start
        rope = self._rope(begin + torch.arange(length, device=tokens.device))
        bias = prompt.hidden[:, None, None, None, :].float() * _HIDDEN_KEY
        later = torch.ones(length, length, dtype=torch.bool, device=tokens.device).triu(1)
        last = written.tokens[:, -1] if written else prompt.tokens[:, -1].repeat_interleave(group)
        x = self._in_line(self.embedding(tokens), self.embedding(last)[:, None])
        memories = []
        for index, (block, shared) in enumerate(zip(self.blocks, prompt.layers, strict=True)):
            q, k, v = block.project(x, rope)  # type: ignore[operator]
            if written:
                own = written.layers[index]
                k, v = torch.cat([own.keys, k], dim=2), torch.cat([own.values, v], dim=2)
            attended = _attend(q, shared, k, v, bias, later)
            x = block.finish(x, attended)  # type: ignore[operator]
            memories.append(LayerMemory(k, v))
        pointers = self.point_to(self.norm(x))
        if written:
            tokens = torch.cat([written.tokens, tokens], dim=1)
            pointers = torch.cat([written.pointers, pointers], dim=1)
        return x, DecoderCache(tuple(memories), tokens, pointers)


def _attend(
    q: Tensor, shared: LayerMemory, keys: Tensor, values: Tensor, bias: Tensor, later: Tensor
) -> Tensor:
    """Attention over the group's prompt and the sample's own tokens; the prompt's keys are never repeated.

    q: (Q G, H, T, D); keys, values: (Q G, H, S, D) with the T newest last; result as q.
    """
    rows, heads, length, depth = q.shape
    prompts, _, prompt_length, _ = shared.keys.shape
    group = rows // prompts
    asked = (q * depth**-0.5).view(prompts, group, heads, length, depth).transpose(1, 2)  # (Q, H, G, T, D)
    flat = asked.reshape(prompts, heads, group * length, depth)
    to_prompt = (flat @ shared.keys.transpose(-1, -2)).view(
        prompts, heads, group, length, prompt_length
    ) + bias
    own_keys = keys.view(prompts, group, heads, -1, depth).transpose(1, 2)  # (Q, H, G, S, D)
    own_values = values.view(prompts, group, heads, -1, depth).transpose(1, 2)
    to_own = asked @ own_keys.transpose(-1, -2)  # (Q, H, G, T, S)
    if length > 1:
        to_own = to_own.masked_fill(later, _HIDDEN_KEY)
    weights = torch.softmax(torch.cat([to_prompt, to_own], dim=-1), dim=-1)
    over_prompt = weights[..., :prompt_length].reshape(prompts, heads, group * length, prompt_length)
    result = (over_prompt @ shared.values).view(prompts, heads, group, length, depth)
    result = result + weights[..., prompt_length:] @ own_values
    return result.transpose(1, 2).reshape(rows, heads, length, depth)
