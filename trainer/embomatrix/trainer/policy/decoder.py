"""Small transformer in plain torch. A group's prompt is encoded once for all of its samples.

Llama-like: RMS norms, rotary positions, gated feed-forward, tied embedding, and normalised queries and keys (Henry et al.
2020). The prompt is a prefix: its tokens attend to each other in both directions. Each word's embedding contains a share
of the previous word's, so the first layer can already match repeated contexts. The output layer can also *point*: part of
the probability goes to words of the prompt and of the plan so far by attention (pointer networks; See et al. 2017,
eq. 9). Copying an object name is then an attention lookup, for rare and frequent words alike.

Shapes: Q prompts, G samples of each, P prompt tokens, T new tokens, S plan tokens so far, H heads of width D, C = H * D,
V words, K of them on a shortlist.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from embomatrix.trainer.policy.compute_dtype import MixedLinear

_MASKED = -1e9
_MIN_PROBABILITY = 1e-9
_INITIAL_PREVIOUS_SHARE = 0.3
"""Initial share of the previous word's embedding."""
_INITIAL_COVERAGE_WEIGHT = -1.0
"""Initial change of the score of words for things that the plan has picked up before: once is usually enough."""


@dataclass(frozen=True, slots=True)
class DecoderShape:
    """Sizes of the network. ``width`` must be a multiple of ``heads``."""

    vocabulary: int
    layers: int = 4
    width: int = 128
    heads: int = 4
    inner: int = 384
    longest: int = 1024


def check_weights(shape: DecoderShape, weights: Mapping[str, Tensor]) -> None:
    """Raise ValueError or KeyError unless the weights have this shape, before a network of it is built."""
    vocabulary, width = weights["embedding.weight"].shape
    layers = len({name.split(".")[1] for name in weights if name.startswith("blocks.")})
    found = replace(
        shape,
        vocabulary=vocabulary,
        layers=layers,
        width=width,
        inner=weights["blocks.0.down.weight"].shape[1],
    )
    if found != shape or shape.heads < 1 or width % (2 * shape.heads):
        raise ValueError(
            f"the weights have the shape {found}: expected {shape}, with heads that divide its width"
        )


@dataclass(frozen=True, slots=True)
class Shortlist:
    """Words that plans of a batch can contain, a small part of the vocabulary (Jean et al. 2015). Only they get scores.

    ``words`` (K,), ascending; ``columns`` (V,), each word's place among them, -1 for all others.
    """

    words: Tensor
    columns: Tensor

    @staticmethod
    def of(included: Tensor) -> Shortlist:
        """Return the words that a mask (V,) includes."""
        words = included.nonzero()[:, 0]
        columns = torch.full_like(included, -1, dtype=torch.long)
        columns[words] = torch.arange(len(words), device=words.device)
        return Shortlist(words, columns)


@dataclass(frozen=True, slots=True)
class LayerCache:
    """Key-value cache of one layer. Keys and values: (rows, H, tokens, D)."""

    keys: Tensor
    values: Tensor

    def select(self, rows: Tensor) -> LayerCache:
        return LayerCache(self.keys[rows], self.values[rows])


@dataclass(frozen=True, slots=True)
class PromptCache:
    """Encoded prompts.

    ``tokens`` (Q, P); ``padding`` (Q, P), true on padding; ``lengths`` (Q,); ``last`` (Q, 1, C), hidden state of the last
    layer at the last token; ``pointer_keys`` (Q, P, C), keys of the pointer attention.
    """

    layers: tuple[LayerCache, ...]
    tokens: Tensor
    padding: Tensor
    lengths: Tensor
    last: Tensor
    pointer_keys: Tensor

    def select(self, prompts: Tensor) -> PromptCache:
        """Return the prompts with these indices (rows,), which may repeat.

        Rows of different lengths can then be scored as groups of one, without padding to the longest.
        """
        return PromptCache(
            tuple(layer.select(prompts) for layer in self.layers),
            self.tokens[prompts],
            self.padding[prompts],
            self.lengths[prompts],
            self.last[prompts],
            self.pointer_keys[prompts],
        )


@dataclass(frozen=True, slots=True)
class PlanCache:
    """Cache of the plans so far: layer caches, ``tokens`` (rows, S) and ``pointer_keys`` (rows, S, C).

    ``gaps`` (rows, S) is true where a row has no token, because it was extended by fewer than the others. None: nowhere.
    """

    layers: tuple[LayerCache, ...]
    tokens: Tensor
    pointer_keys: Tensor
    gaps: Tensor | None = None

    def select(self, rows: Tensor) -> PlanCache:
        layers = tuple(layer.select(rows) for layer in self.layers)
        gaps = None if self.gaps is None else self.gaps[rows]
        return PlanCache(layers, self.tokens[rows], self.pointer_keys[rows], gaps)

    def lengths(self) -> Tensor:
        """Return the number of tokens of each row (rows,)."""
        rows, length = self.tokens.shape
        if self.gaps is None:
            return self.tokens.new_full((rows,), length)
        return length - self.gaps.sum(dim=1)

    def closed(self) -> PlanCache:
        """Return the same cache with all gaps at the end of the rows, and no longer than the longest row."""
        if self.gaps is None:
            return self
        order = torch.argsort(self.gaps.int(), dim=1, stable=True)[
            :, : int(self.lengths().max())
        ]  # (rows, S)
        gaps = self.gaps.gather(1, order)
        wide = order[..., None].expand(-1, -1, self.pointer_keys.shape[2])
        _, heads, _, depth = self.layers[0].keys.shape
        deep = order[:, None, :, None].expand(-1, heads, -1, depth)
        return PlanCache(
            tuple(
                LayerCache(layer.keys.gather(2, deep), layer.values.gather(2, deep)) for layer in self.layers
            ),
            self.tokens.gather(1, order),
            self.pointer_keys.gather(1, wide),
            gaps if bool(gaps.any()) else None,
        )


class _Block(nn.Module):
    def __init__(self, shape: DecoderShape, compute_dtype: torch.dtype) -> None:
        super().__init__()
        self.heads = shape.heads
        self.attention_norm = nn.RMSNorm(shape.width)
        self.qkv = MixedLinear(shape.width, 3 * shape.width, compute_dtype)
        self.query_norm = nn.RMSNorm(shape.width // shape.heads)
        self.key_norm = nn.RMSNorm(shape.width // shape.heads)
        self.out = MixedLinear(shape.width, shape.width, compute_dtype)
        self.mlp_norm = nn.RMSNorm(shape.width)
        self.gate_up = MixedLinear(shape.width, 2 * shape.inner, compute_dtype)
        self.down = MixedLinear(shape.inner, shape.width, compute_dtype)

    def project(self, x: Tensor, rope: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Queries, keys and values (rows, H, T, D) of x (rows, T, C)."""
        rows, length, width = x.shape
        product = self.qkv(self.attention_norm(x)).to(x.dtype)
        split = product.view(rows, length, 3, self.heads, width // self.heads).permute(2, 0, 3, 1, 4)
        normed = torch.stack([self.query_norm(split[0]), self.key_norm(split[1])])
        q, k = _rotate(normed, rope)  # each (rows, H, T, D)
        return q, k, split[2]

    def finish(self, x: Tensor, attended: Tensor) -> Tensor:
        """Add the attention output (rows, H, T, D) and the feed-forward output to x (rows, T, C)."""
        x = x + self.out(attended.transpose(1, 2).reshape(x.shape))
        gate, up = self.gate_up(self.mlp_norm(x)).chunk(2, dim=-1)
        return x + self.down(functional.silu(gate) * up)  # type: ignore[no-any-return]


def _rotate(x: Tensor, rope: tuple[Tensor, Tensor]) -> Tensor:
    cos, sin = rope
    left, right = x.chunk(2, dim=-1)
    return x * cos + torch.cat([-right, left], dim=-1) * sin


class Decoder(nn.Module):
    """Network with two passes: ``encode_prompts``, and ``extend`` for the samples that continue them."""

    cos: Tensor
    sin: Tensor

    def __init__(
        self, shape: DecoderShape, generator: torch.Generator, compute_dtype: torch.dtype = torch.float32
    ) -> None:
        super().__init__()
        self.shape = shape
        self.embedding = nn.Embedding(shape.vocabulary, shape.width)
        self.previous_share = nn.Parameter(torch.full((shape.width,), _INITIAL_PREVIOUS_SHARE))
        self.blocks = nn.ModuleList(_Block(shape, compute_dtype) for _ in range(shape.layers))
        self.norm = nn.RMSNorm(shape.width)
        self.pointer_query = nn.Linear(shape.width, shape.width, bias=False)
        self.pointer_key = nn.Linear(shape.width, shape.width, bias=False)
        self.pointer_gate = nn.Linear(shape.width, 1)
        self.coverage_weight = nn.Linear(shape.width, 1)
        half = shape.width // shape.heads // 2
        angles = torch.outer(torch.arange(shape.longest).float(), 10000.0 ** (-torch.arange(half) / half))
        self.register_buffer("cos", angles.cos().repeat(1, 2), persistent=False)
        self.register_buffer("sin", angles.sin().repeat(1, 2), persistent=False)
        for name, parameter in self.named_parameters():
            if parameter.dim() > 1:
                nn.init.normal_(parameter, std=0.02, generator=generator)
            if name.endswith(("out.weight", "down.weight")):
                parameter.data /= (2 * shape.layers) ** 0.5
        nn.init.zeros_(self.pointer_gate.bias)
        nn.init.constant_(self.coverage_weight.bias, _INITIAL_COVERAGE_WEIGHT)

    def scores(
        self,
        states: Tensor,
        prompt: PromptCache,
        plan: PlanCache | None,
        shortlist: Shortlist,
        token_mask: Tensor,
        coverage: Tensor,
        places: Tensor | None = None,
    ) -> Tensor:
        """Log scores (Q * G, T, K) of the shortlist as next words for hidden states (Q * G, T, C).

        The hidden states are the last T of those after the prompt and after each word of ``plan``. ``token_mask``
        (Q * G, T, K) is true on words to exclude. ``coverage`` (Q * G, T, K) is 1 on words that lead to things which the plan
        has picked up before; each state decides how much that counts. ``places`` (Q * G, T) are the places in the plans of the
        words to come, if they are not the last T.
        """
        x = self.norm(states)
        weight = self.embedding.weight[shortlist.words]
        generated = torch.softmax((x @ weight.t()).masked_fill(token_mask, _MASKED), dim=-1)
        attention, columns = self._point(x, prompt, plan, shortlist, token_mask, places)
        pointed = torch.zeros_like(generated).scatter_add(2, columns, attention)
        gate = torch.sigmoid(self.pointer_gate(x))  # (Q G, T, 1)
        mixed = torch.lerp(generated, pointed, gate)
        penalty: Tensor = self.coverage_weight(x) * coverage
        scores = mixed.clamp(min=_MIN_PROBABILITY).log() + penalty
        return scores.masked_fill(token_mask, _MASKED)

    def _point(
        self,
        x: Tensor,
        prompt: PromptCache,
        plan: PlanCache | None,
        shortlist: Shortlist,
        token_mask: Tensor,
        places: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Pointer attention of normalised states: probabilities of positions, prompt first, and their words' columns.

        Both have shape (Q * G, T, P + S). All probabilities are 0 if every word is masked.
        """
        rows, length, width = x.shape
        prompts, prompt_length = prompt.tokens.shape
        query = self.pointer_query(x) * width**-0.5  # (Q G, T, C)
        logits = (query.view(prompts, -1, width) @ prompt.pointer_keys.transpose(1, 2)).view(rows, length, -1)
        group = rows // prompts
        columns = shortlist.columns[prompt.tokens]  # (Q, P)
        absent = prompt.padding | (columns < 0)
        columns = columns.repeat_interleave(group, dim=0)[:, None].expand(rows, length, prompt_length)
        absent = absent.repeat_interleave(group, dim=0)[:, None].expand(rows, length, prompt_length)
        if plan:
            count = plan.tokens.shape[1]
            if places is None:
                future = torch.ones(length, count, dtype=torch.bool, device=x.device).triu(count - length + 1)
            else:
                future = torch.arange(count, device=x.device) >= places[..., None]  # (Q G, T, S)
            logits = torch.cat([logits, query @ plan.pointer_keys.transpose(1, 2)], dim=2)
            own = shortlist.columns[plan.tokens]  # (Q G, S)
            columns = torch.cat([columns, own[:, None].expand(rows, length, count)], dim=2)
            # Observations may have words that plans can't contain.
            nowhere = own < 0 if plan.gaps is None else plan.gaps | (own < 0)
            absent = torch.cat([absent, future | nowhere[:, None]], dim=2)
        columns = columns.clamp(min=0)
        excluded = absent | token_mask.gather(2, columns)
        # If no position is left: zeros, not a uniform distribution. The softmax over the scores renormalises.
        attention = torch.softmax(logits.masked_fill(excluded, _MASKED), dim=-1)
        return attention.masked_fill(excluded, 0.0), columns

    def _rope(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Cosines and sines for positions (rows, T)."""
        return self.cos[positions][:, None], self.sin[positions][:, None]

    def _embed(self, words: Tensor, before: Tensor) -> Tensor:
        """Mix each word (rows, T, C) with the previous one. ``before`` (rows, 1, C) precedes the first."""
        return words + self.previous_share * torch.cat([before, words[:, :-1]], dim=1)

    def encode_prompts(self, tokens: Tensor, padding: Tensor) -> PromptCache:
        """Encode tokens (Q, P), padded on the left. padding (Q, P) is true on the padding."""
        lengths = (~padding).sum(dim=1)
        positions = ((~padding).cumsum(dim=1) - 1).clamp(min=0)
        rope = self._rope(positions)
        bias = (padding.float() * _MASKED)[
            :, None, None
        ]  # (Q, 1, 1, P): no causal mask, the prompt is a prefix
        words = self.embedding(tokens).masked_fill(padding[..., None], 0.0)
        x = self._embed(words, torch.zeros_like(words[:, :1]))
        caches = []
        for block in self.blocks:
            q, k, v = block.project(x, rope)  # type: ignore[operator]
            attended = functional.scaled_dot_product_attention(q, k, v, attn_mask=bias)
            x = block.finish(x, attended)  # type: ignore[operator]
            caches.append(LayerCache(k, v))
        pointer_keys = self.pointer_key(self.norm(x))
        return PromptCache(tuple(caches), tokens, padding, lengths, x[:, -1:], pointer_keys)

    def extend(
        self, prompt: PromptCache, tokens: Tensor, plan: PlanCache | None, gaps: Tensor | None = None
    ) -> tuple[Tensor, PlanCache]:
        """Return hidden states (Q * G, T, C) of tokens (Q * G, T) that follow ``plan``, and the extended plan cache.

        ``plan`` is the cache from the previous call, None for the first tokens. ``gaps`` (Q * G, T) is true at the end of
        rows with fewer tokens than the others; states there mean nothing.
        """
        rows, length = tokens.shape
        start = plan.lengths()[:, None] if plan else 0
        group = rows // prompt.lengths.shape[0]
        begin = prompt.lengths.repeat_interleave(group)[:, None] + start
        rope = self._rope(begin + torch.arange(length, device=tokens.device))
        absent = _joined_gaps(plan, tokens, gaps)
        visible = _visible(prompt, plan, length, absent, group) if length > 1 else None
        last = _last_tokens(prompt.tokens[:, -1].repeat_interleave(group), plan)
        x = self._embed(self.embedding(tokens), self.embedding(last)[:, None])
        caches = []
        for index, (block, prompt_cache) in enumerate(zip(self.blocks, prompt.layers, strict=True)):
            q, k, v = block.project(x, rope)  # type: ignore[operator]
            if plan:
                own = plan.layers[index]
                k, v = torch.cat([own.keys, k], dim=2), torch.cat([own.values, v], dim=2)
            if visible is None:
                attended = _attend_to_next(q, prompt_cache, k, v, prompt.padding, absent)
            else:
                attended = _attend(q, prompt_cache, k, v, visible)
            x = block.finish(x, attended)  # type: ignore[operator]
            caches.append(LayerCache(k, v))
        pointer_keys = self.pointer_key(self.norm(x))
        if plan:
            tokens = torch.cat([plan.tokens, tokens], dim=1)
            pointer_keys = torch.cat([plan.pointer_keys, pointer_keys], dim=1)
        return x, PlanCache(tuple(caches), tokens, pointer_keys, absent)


def _joined_gaps(plan: PlanCache | None, tokens: Tensor, gaps: Tensor | None) -> Tensor | None:
    """Return the gaps (rows, S + T) of a cache with further tokens (rows, T), None if there are none."""
    before = None if plan is None else plan.gaps
    if before is None and gaps is None:
        return None
    if before is None:
        before = torch.zeros(
            len(tokens), plan.tokens.shape[1] if plan else 0, dtype=torch.bool, device=tokens.device
        )
    if gaps is None:
        gaps = torch.zeros_like(tokens, dtype=torch.bool)
    return torch.cat([before, gaps], dim=1)


def _last_tokens(before: Tensor, plan: PlanCache | None) -> Tensor:
    """Return the last token of each row (rows,), that ``before`` the plan if it has none."""
    if plan is None:
        return before
    if plan.gaps is None:
        return plan.tokens[:, -1]
    at = torch.arange(plan.tokens.shape[1], device=plan.tokens.device).masked_fill(plan.gaps, -1).amax(dim=1)
    return torch.where(at >= 0, plan.tokens.gather(1, at.clamp(min=0)[:, None])[:, 0], before)


def _visible(
    prompt: PromptCache, plan: PlanCache | None, length: int, gaps: Tensor | None, group: int
) -> Tensor:
    """Return which tokens of prompt and plan each of ``length`` further tokens sees: (Q * G, 1, length, P + S)."""
    padding = prompt.padding.repeat_interleave(group, dim=0)[:, None]  # (Q G, 1, P)
    total = (plan.tokens.shape[1] if plan else 0) + length
    future = torch.ones(length, total, dtype=torch.bool, device=padding.device).triu(total - length + 1)
    hidden = future.expand(len(padding), length, total)
    if gaps is not None:
        hidden = hidden | gaps[:, None]
    return ~torch.cat([padding.expand(-1, length, -1), hidden], dim=2)[:, None]


def _attend(q: Tensor, prompt_cache: LayerCache, keys: Tensor, values: Tensor, visible: Tensor) -> Tensor:
    """Attention over the group's prompt and the sample's own tokens, for several tokens at once.

    q: (Q G, H, T, D); keys, values: (Q G, H, S, D) with the T newest last. Returns the shape of q. The prompt's keys are
    repeated for each sample: torch's fused attention then takes half the time of one that keeps them apart.
    """
    group = len(q) // len(prompt_cache.keys)
    all_keys = torch.cat([prompt_cache.keys.repeat_interleave(group, dim=0), keys], dim=2)
    all_values = torch.cat([prompt_cache.values.repeat_interleave(group, dim=0), values], dim=2)
    return functional.scaled_dot_product_attention(q, all_keys, all_values, attn_mask=visible)


def _attend_to_next(
    q: Tensor,
    prompt_cache: LayerCache,
    keys: Tensor,
    values: Tensor,
    padding: Tensor,
    gaps: Tensor | None,
) -> Tensor:
    """Attention as ``_attend``, for one token of each sample, without repeating the prompt's keys.

    q: (Q G, H, 1, D); keys, values: (Q G, H, S, D), none at the gaps (Q G, S). padding: (Q, P). Returns the shape of q.
    """
    rows, heads, _, depth = q.shape
    prompts, _, prompt_length, _ = prompt_cache.keys.shape
    group = rows // prompts
    query = q * depth**-0.5
    grouped = query.view(prompts, group, heads, depth).transpose(1, 2)  # (Q, H, G, D)
    to_prompt = grouped @ prompt_cache.keys.transpose(-1, -2)  # (Q, H, G, P)
    to_prompt = to_prompt + padding[:, None, None].float() * _MASKED
    # The sample's own keys and values stay in place: weights are reordered instead, which are D times smaller.
    to_own = query @ keys.transpose(-1, -2)  # (Q G, H, 1, S)
    if gaps is not None:
        to_own = to_own.masked_fill(gaps[:, None, None], _MASKED)
    to_own = to_own.view(prompts, group, heads, -1).transpose(1, 2)  # (Q, H, G, S)
    weights = torch.softmax(torch.cat([to_prompt, to_own], dim=-1), dim=-1)
    from_prompt = (weights[..., :prompt_length] @ prompt_cache.values).transpose(1, 2)  # (Q, G, H, D)
    over_own = weights[..., prompt_length:].transpose(1, 2).reshape(rows, heads, 1, -1)
    return from_prompt.reshape(rows, heads, 1, depth) + over_own @ values
