"""Bytes that a policy's weights, activations, scores and caches take, from its sizes alone.

The counts are those of the tensors that autograd saves in the code of ``hf`` and ``decoder``. Shapes: Q prompts of P tokens,
R = Q * group plans of T tokens, V words, width C, feed-forward width I, L layers, H heads.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Protocol

from embomatrix.trainer.config.settings import ComputeDtype, LoraSettings, TrainSettings
from embomatrix.trainer.policy.decoder import DecoderShape
from embomatrix.trainer.policy.token_scores import SCORES_PER_CHUNK

FLOAT32: Final = 4
"""Bytes of a float32."""
BFLOAT16: Final = 2
"""Bytes of a bfloat16."""
SAMPLED_SCORES: Final = 5
"""Tensors of all scores of a token that are alive while it is drawn: scaled scores, log-probabilities, their sums."""
LEARNT_SCORES: Final = 3
"""Tensors of a chunk's scores that are alive in its backward pass: log-probabilities and two gradients."""
REFERENCE_SCORES: Final = 3
"""Tensors of a chunk's scores that are alive without a backward pass: log-probabilities and two factors of the entropy."""


@dataclass(frozen=True, slots=True)
class Batch:
    """``group`` plans of at most ``new`` tokens for each of ``prompts`` prompts with ``prompt`` tokens."""

    prompts: int
    group: int
    prompt: int
    new: int

    @property
    def rows(self) -> int:
        """Number of plans."""
        return self.prompts * self.group


@dataclass(frozen=True, slots=True)
class Usage:
    """Bytes of one pass beside the model: copies of weights, transient gradients, activations, scores, key-value cache."""

    copies: int = 0
    gradients: int = 0
    activations: int = 0
    logits: int = 0
    cache: int = 0

    @property
    def total(self) -> int:
        """Sum of all parts, in bytes."""
        return self.copies + self.gradients + self.activations + self.logits + self.cache


class Footprint(Protocol):
    """Memory of one policy under the settings of a run."""

    @property
    def weights(self) -> int:
        """Bytes of all weights."""
        ...

    @property
    def learning(self) -> int:
        """Number of weights that learn."""
        ...

    @property
    def matrices(self) -> int:
        """Number of learning weights in matrices of linear layers: those that Muon moves."""
        ...

    @property
    def largest(self) -> int:
        """Number of weights in the largest tensor that learns."""
        ...

    @property
    def reference(self) -> int:
        """Bytes of the reference policy that it does not share."""
        ...

    @property
    def saving(self) -> int:
        """Bytes of a second model that exists while a checkpoint is saved."""
        ...

    def sampled(self, batch: Batch) -> Usage:
        """Peak of sampling a batch."""
        ...

    def scored(self, batch: Batch) -> Usage:
        """Peak of scoring a batch under the reference policy."""
        ...

    def learnt(self, batch: Batch, *, entropy: bool) -> Usage:
        """Peak of a forward and backward pass over a batch. ``entropy``: the entropy has a gradient."""
        ...


class Precision(StrEnum):
    """Data types of a language model during training."""

    FLOAT32 = "float32"
    CAST = "cast"  # weights in float32, linear layers multiply in bfloat16: a CPU
    MIXED = "mixed"  # weights in float32, torch's automatic mixed precision: a GPU
    BFLOAT16 = "bfloat16"  # frozen weights in bfloat16 under float32 adapters: a GPU


@dataclass(frozen=True, slots=True)
class LayerBytes:
    """Bytes that autograd saves in a layer for each token, by the width of the tensors.

    ``residual`` (C): inputs of the norms. ``inputs`` (C): outputs of the norms, once or once for each linear layer that
    casts them. ``attention`` (H * head width): queries and outputs. ``inner`` (I): feed-forward. ``key_value`` is for one
    number of the keys or values that attention saves, ``cached`` for a key and a value in the cache.
    """

    residual: int
    inputs: int
    attention: int
    inner: int
    key_value: int
    cached: int


FULL_BYTES: Final = {
    Precision.FLOAT32: LayerBytes(16, 8, 8, 16, 4, 8),
    Precision.CAST: LayerBytes(16, 10, 10, 14, 4, 8),
    Precision.MIXED: LayerBytes(16, 10, 4, 8, 2, 6),
}
"""All weights learn."""
LORA_BYTES: Final = {
    # Frozen norms don't save their normalised input.
    Precision.FLOAT32: LayerBytes(8, 8, 8, 16, 4, 8),
    Precision.CAST: LayerBytes(8, 8, 8, 16, 4, 8),
    # Every adapter casts its input to float32.
    Precision.BFLOAT16: LayerBytes(8, 20, 8, 10, 2, 4),
}
"""Adapters learn, on all linear layers."""


@dataclass(frozen=True, slots=True)
class Matrix:
    """Weight of a linear layer. ``name`` is the last part of the layer's name."""

    name: str
    inputs: int
    outputs: int


@dataclass(frozen=True, slots=True)
class LanguageModelShape:
    """Sizes of a causal language model with gated feed-forward layers. ``matrices`` leaves out the output layer."""

    parameters: int
    vocabulary: int
    layers: int
    width: int
    inner: int
    heads: int
    key_value_heads: int
    head_width: int
    matrices: tuple[Matrix, ...]
    tied: bool = False
    """True if the output layer shares the weights of the embedding."""

    @property
    def head(self) -> int:
        """Number of weights of the output layer."""
        return self.vocabulary * self.width

    def adapter_parameters(self, lora: LoraSettings) -> int:
        """Number of weights of adapters: rank times the sum of each matrix's sides."""
        adapted = [each for each in self.matrices if not lora.targets or each.name in lora.targets]
        return lora.rank * sum(each.inputs + each.outputs for each in adapted)


@dataclass(frozen=True, slots=True)
class LanguageModelFootprint:
    """Memory of a Hugging Face model: float32 or mixed precision, all weights or adapters, with or without recomputation."""

    shape: LanguageModelShape
    precision: Precision
    lora: LoraSettings
    recomputes: bool

    @property
    def weights(self) -> int:
        size = BFLOAT16 if self.precision is Precision.BFLOAT16 else FLOAT32
        return self.shape.parameters * size + self._adapters * FLOAT32

    @property
    def learning(self) -> int:
        return self._adapters or self.shape.parameters

    @property
    def matrices(self) -> int:
        return self._adapters or sum(each.inputs * each.outputs for each in self.shape.matrices)

    @property
    def largest(self) -> int:
        """An adapter's largest tensor is small: it counts as 0."""
        return 0 if self._adapters else self.shape.head

    @property
    def reference(self) -> int:
        return self.learning * FLOAT32

    @property
    def saving(self) -> int:
        return self.weights if self._adapters else 0

    @property
    def _adapters(self) -> int:
        return self.shape.adapter_parameters(self.lora)

    @property
    def _bytes(self) -> LayerBytes:
        return (LORA_BYTES if self._adapters else FULL_BYTES)[self.precision]

    @property
    def _compute(self) -> int:
        """Bytes of a number that a linear layer computes."""
        return FLOAT32 if self.precision is Precision.FLOAT32 else BFLOAT16

    @property
    def _copies(self) -> int:
        """Bytes of bfloat16 copies of float32 weights. On a CPU the output layer has none."""
        if self.precision not in (Precision.CAST, Precision.MIXED):
            return 0
        linear = sum(each.inputs * each.outputs for each in self.shape.matrices)
        return BFLOAT16 * (linear + (self.shape.head if self.precision is Precision.MIXED else 0))

    def sampled(self, batch: Batch) -> Usage:
        shape, cache = self.shape, self._cache(batch)
        prompts = Batch(batch.prompts, 1, batch.prompt, 0)
        reading = Usage(
            copies=self._copies,
            activations=self._layer_in_passing(batch.prompts * batch.prompt),
            cache=self._cache(prompts),
        )
        writing = Usage(
            copies=self._copies,
            logits=SAMPLED_SCORES * FLOAT32 * batch.rows * shape.vocabulary,
            # A layer's longer keys or values exist beside the shorter ones.
            cache=cache + cache // (2 * shape.layers),
        )
        return max(reading, writing, key=lambda usage: usage.total)

    def scored(self, batch: Batch) -> Usage:
        shape, size = self.shape, self._bytes.key_value
        tokens, length = batch.rows * batch.new, batch.prompt + batch.new
        states = tokens * shape.width * FLOAT32
        repeated = 2 * size * batch.rows * length * self._query if self._query > self._keys else 0
        layer = max(
            self._layer_in_passing(batch.prompts * batch.prompt),
            self._layer_in_passing(tokens),
            repeated + 4 * states,
        )
        masks = size * tokens * length
        forward = Usage(activations=states + layer + masks, cache=self._cache(batch))
        # The cache is freed before the scores are computed.
        scoring = Usage(activations=2 * states, logits=REFERENCE_SCORES * FLOAT32 * self._scores(batch))
        return max(forward, scoring, key=lambda usage: usage.total)

    def learnt(self, batch: Batch, *, entropy: bool) -> Usage:
        saved = self._saved_recomputed(batch) if self.recomputes else self._saved(batch)
        scores = LEARNT_SCORES + (2 if entropy else 0)
        states = batch.rows * batch.new * self.shape.width * FLOAT32
        copies, logits = self._copies, scores * FLOAT32 * self._scores(batch)
        # The gradient of the output layer is complete before it is added to the sum of earlier microbatches.
        head = 0 if self._adapters else self.shape.head * FLOAT32
        layers = self._one_layer(batch) if self.recomputes else 0
        forward = Usage(copies, 0, saved + (0 if self.recomputes else self._unsaved_cache(batch)), 0)
        scoring = Usage(copies, head, saved + states, logits)
        backward = Usage(copies, head, saved + layers + self._gradients_of_layer(batch), 0)
        # Every weight has a gradient from the plans that waits for the one from the prompts.
        prompts = Usage() if self.recomputes else self._before_prompts(batch)
        return max(forward, scoring, backward, prompts, key=lambda usage: usage.total)

    def _before_prompts(self, batch: Batch) -> Usage:
        """Usage between the backward passes of the plans and of the prompts."""
        shape = self.shape
        waiting = self.learning * self._gradient
        if not self._adapters:
            # A tied output layer has two more: the embedding's gradient and the sum. Another one waits for no other pass.
            waiting += shape.head * FLOAT32 * (2 if shape.tied else -1)
        keys = (
            2 * FLOAT32 * shape.layers * batch.prompts * batch.prompt * self._keys
        )  # gradients of keys, values
        return Usage(self._copies, waiting, self._saved_of_prompts(batch) + keys)

    @property
    def _gradient(self) -> int:
        """Bytes of a gradient before it is added to the weight's: mixed precision adds up those of its bfloat16 copies."""
        return BFLOAT16 if self.precision is Precision.MIXED else FLOAT32

    @property
    def _query(self) -> int:
        """Width of all heads together."""
        return self.shape.heads * self.shape.head_width

    @property
    def _keys(self) -> int:
        """Width of all keys together."""
        return self.shape.key_value_heads * self.shape.head_width

    def _scores(self, batch: Batch) -> int:
        """Number of scores that exist at once."""
        vocabulary = self.shape.vocabulary
        return min(batch.rows * batch.new, max(1, SCORES_PER_CHUNK // vocabulary)) * vocabulary

    def _cache(self, batch: Batch) -> int:
        positions = batch.rows * (batch.prompt + batch.new)
        return self.shape.layers * positions * self._keys * self._bytes.cached

    def _unsaved_cache(self, batch: Batch) -> int:
        """Bytes of the cache at the end of a forward pass that autograd does not hold anyway."""
        repeats = self._query > self._keys
        held = 0 if repeats else 2 * self._bytes.key_value
        return self._cache(batch) * (self._bytes.cached - held) // self._bytes.cached

    def _layer_in_passing(self, tokens: int) -> int:
        """Bytes of a layer that keeps nothing."""
        return tokens * (3 * FLOAT32 * self.shape.width + 3 * self._compute * self.shape.inner)

    def _per_token(self) -> int:
        """Bytes that a layer saves for a token, without keys, values and masks."""
        shape, layer = self.shape, self._bytes
        by_width = (layer.residual + layer.inputs) * shape.width
        return by_width + layer.attention * self._query + layer.inner * shape.inner

    def _prompt_attention(self, prompts: int, length: int) -> int:
        """Bytes that a layer saves for keys, values and masks of prompts. One prompt needs no padding, so no mask."""
        size = self._bytes.key_value
        if prompts == 1:
            return 2 * size * length * self._keys
        return 2 * size * prompts * length * self._query + size * prompts * length**2

    def _saved(self, batch: Batch) -> int:
        """Bytes that autograd saves if each prompt runs once and its keys and values are repeated for the plans."""
        size, new = self._bytes.key_value, batch.new - 1
        length = batch.prompt + new
        attention = 2 * size * batch.rows * length * self._query + size * batch.rows * new * length
        plans = self._saved_in_layers(batch.rows * new, attention)
        return self._saved_of_prompts(batch) + plans

    def _saved_of_prompts(self, batch: Batch) -> int:
        attention = self._prompt_attention(batch.prompts, batch.prompt)
        return self._saved_in_layers(batch.prompts * batch.prompt, attention)

    def _saved_in_layers(self, tokens: int, attention: int) -> int:
        """Bytes of all layers and the last norm. ``attention``: bytes of a layer's keys, values and masks."""
        shape = self.shape
        return shape.layers * (tokens * self._per_token() + attention) + 2 * FLOAT32 * shape.width * tokens

    def _saved_recomputed(self, batch: Batch) -> int:
        """Bytes that autograd saves if layers keep only their inputs. Each plan runs with its own prompt."""
        residual = BFLOAT16 if self.precision is Precision.BFLOAT16 else FLOAT32
        tokens = batch.rows * (batch.prompt + batch.new - 1)
        return tokens * self.shape.width * (self.shape.layers * residual + 2 * FLOAT32)

    def _gradients_of_layer(self, batch: Batch) -> int:
        """Bytes of gradients of a feed-forward layer's activations."""
        tokens = batch.rows * (batch.new - 1 + (batch.prompt if self.recomputes else 0))
        return 2 * FLOAT32 * tokens * self.shape.inner

    def _one_layer(self, batch: Batch) -> int:
        """Bytes of a layer that is computed again for its backward pass."""
        length = batch.prompt + batch.new - 1
        attention = self._prompt_attention(batch.prompts, length) * batch.group
        return batch.rows * length * self._per_token() + attention


@dataclass(frozen=True, slots=True)
class WordLevelFootprint:
    """Memory of the word-level policy. ``casts``: its linear layers multiply in bfloat16.

    Scores are planned for the whole vocabulary. The policy scores a shortlist, which the plan does not know.
    """

    shape: DecoderShape
    casts: bool

    @property
    def weights(self) -> int:
        return self.learning * FLOAT32

    @property
    def learning(self) -> int:
        shape = self.shape
        norms = 2 * shape.width + 2 * shape.width // shape.heads
        # embedding, share of the previous word, norm, weights and biases of gate and coverage
        rest = (shape.vocabulary + 4) * shape.width + 2
        return self.matrices + shape.layers * norms + rest

    @property
    def matrices(self) -> int:
        shape = self.shape
        return shape.layers * (4 * shape.width**2 + 3 * shape.width * shape.inner) + 2 * shape.width**2

    @property
    def largest(self) -> int:
        return max(self.shape.vocabulary, 2 * self.shape.inner, 3 * self.shape.width) * self.shape.width

    @property
    def reference(self) -> int:
        return self.weights

    @property
    def saving(self) -> int:
        return 0

    @property
    def _copies(self) -> int:
        return BFLOAT16 * self.matrices if self.casts else 0

    @property
    def _per_token(self) -> int:
        """Bytes of a layer's activations for a token."""
        inner = BFLOAT16 if self.casts else FLOAT32
        return 16 * FLOAT32 * self.shape.width + 4 * inner * self.shape.inner

    def sampled(self, batch: Batch) -> Usage:
        shape, rows = self.shape, batch.rows
        cached = FLOAT32 * (2 * shape.layers + 1) * shape.width  # keys, values and keys of the pointers
        prompts = batch.prompts * batch.prompt
        reading = Usage(copies=self._copies, activations=prompts * self._per_token, cache=prompts * cached)
        writing = Usage(
            copies=self._copies,
            activations=rows * (batch.prompt + batch.new) * (3 * FLOAT32 * shape.heads + 13),
            logits=2 * SAMPLED_SCORES * FLOAT32 * rows * shape.vocabulary,
            # The longer cache of the plans exists beside the shorter one.
            cache=(prompts + 2 * rows * batch.new) * cached,
        )
        return max(reading, writing, key=lambda usage: usage.total)

    def scored(self, batch: Batch) -> Usage:
        """Return the larger of a pass over all prompts and what learning keeps of the quarter of the plans scored at once."""
        learnt = self.learnt(batch, entropy=False)
        reading = batch.prompts * batch.prompt * self._per_token
        return Usage(activations=max(reading, learnt.activations // 4), logits=learnt.logits // 4)

    def learnt(self, batch: Batch, *, entropy: bool) -> Usage:
        shape, rows, positions = self.shape, batch.rows, batch.prompt + batch.new
        tokens = batch.prompts * batch.prompt + rows * batch.new
        # Plans of a bucket differ in their prompts, so each has a copy of its prompt's keys and values.
        attention = rows * (2 * batch.prompt * shape.width + shape.heads * batch.new * positions)
        pointing = rows * (batch.prompt * shape.width * FLOAT32 + batch.new * positions * (FLOAT32 + 9))
        layers = shape.layers * (tokens * self._per_token + attention * FLOAT32)
        widths = 7 * FLOAT32 * rows * batch.new * shape.width
        # Probabilities of generation and pointing, their mixture and its logarithm, and masks of one byte.
        scores = (5 + (2 if entropy else 0)) * FLOAT32 + 2
        return Usage(
            copies=self._copies,
            activations=layers + pointing + widths,
            logits=scores * rows * batch.new * shape.vocabulary,
        )


def precision_of(settings: TrainSettings, *, casts: bool) -> Precision:
    """Data types of a language model under these settings. ``casts``: linear layers of a CPU multiply in bfloat16."""
    if settings.device == "cpu":
        return Precision.CAST if casts else Precision.FLOAT32
    if settings.compute_dtype is ComputeDtype.FLOAT32:
        return Precision.FLOAT32
    return Precision.BFLOAT16 if settings.lora.rank else Precision.MIXED
