"""Causal language models of Hugging Face, by name or folder. transformers is imported on first use.

A group's prompt runs once, in sampling and in the update. Its key-value cache is repeated for the samples inside
autograd, which gives the gradients of the plain computation in a third of the time.
"""

from __future__ import annotations

import contextlib
import copy
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from embomatrix.skills.prompt import Codec, Prompt
from embomatrix.trainer.config.errors import TrainerError, reason_of
from embomatrix.trainer.config.settings import ComputeDtype, LoraSettings, TrainSettings
from embomatrix.trainer.policy.compute_dtype import frozen_weights, torch_dtype, use_compute_dtype
from embomatrix.trainer.policy.lora import ADAPTERS, add_adapters, load_adapters, save_adapters
from embomatrix.trainer.policy.protocol import Samples, Tokens, TokenScores, draw, pad_left
from embomatrix.trainer.policy.token_scores import chunked_scores, has_plain_head
from embomatrix.world.json_text import parse_json

HUB_TIMEOUT_S: Final = 10.0
TOKENIZERS: Final = (
    "tokenizer.json",
    "tokenizer_config.json",
    "tokenizer.model",
    "spiece.model",
    "vocab.json",
    "vocab.txt",
)
"""Tokenizer files. A model folder holds at least one of them."""
CONFIG: Final = "config.json"
CODEC_KEY: Final = "embomatrix_codec"
"""Key in the model's config.json for the codec that it was trained in."""
EPISODES_KEY: Final = "embomatrix_episodes"
"""Key in the model's config.json that says whether it was trained in episodes."""
_ANSWER: Final = "an-answer-in-the-middle"
"""Text that no chat template contains."""
REMEDY: Final = "pass `tiny`, a folder with config.json, or a Hugging Face name; `embomatrix model import-gguf` makes a folder"


class HfPolicy:
    """Policy over a transformers model and tokenizer.

    ``gradient_checkpointing`` trades time for memory in the update: each layer is computed twice, and a group's prompt once
    per plan. ``autocast``: the data type of torch's automatic mixed precision, in which the model computes although its
    weights are in float32.
    """

    def __init__(
        self,
        model: Any,
        tokenizer: Any,
        codec: Codec,
        name: str,
        *,
        gradient_checkpointing: bool = False,
        autocast: torch.dtype | None = None,
    ) -> None:
        self.name = name
        self._autocast = autocast
        self.codec = codec
        self.module = model.eval()
        self._has_plain_head = has_plain_head(model)
        self._gradient_checkpointing = gradient_checkpointing
        self.has_adapters = False
        self.in_episodes = False
        """True if the policy answers call by call in episodes, instead of with whole plans."""
        self._tokenizer = tokenizer
        self.context = _context_of(model)
        self.end_tokens = _end_tokens(model, tokenizer)
        self._pad = self.end_tokens[0] if tokenizer.pad_token_id is None else int(tokenizer.pad_token_id)

    @classmethod
    def load(
        cls, name: str | Path, settings: TrainSettings, *, label: str = "", learns: bool = True
    ) -> HfPolicy:
        """Load a model by name or folder, without adapters. Raises TrainerError with a remedy.

        On a CPU its linear layers multiply in the ``compute_dtype`` of the settings. On another device weights that stay
        fixed, because adapters learn or because the model is only evaluated (``learns`` is False), are bfloat16 unless
        ``compute_dtype`` is float32. Weights that learn are float32 everywhere: a step of 1e-5 is lost in the 8 significant
        bits of a bfloat16.
        """
        device = settings.device
        try:
            _check_available(str(name))
            from transformers import AutoModelForCausalLM, AutoTokenizer
            from transformers.utils import logging as transformers_logging
        except ImportError as error:
            absent = "" if Path(name).is_dir() else " is not a folder, and a Hugging Face model"
            raise TrainerError(
                f"the model {str(name)!r}{absent} needs transformers: `pip install 'embomatrix[hf]'`, or --model tiny"
            ) from error
        # Its progress bars would mix with ours.
        transformers_logging.disable_progress_bar()  # type: ignore[no-untyped-call]
        all_learn = learns and not settings.lora.rank
        exact = settings.compute_dtype is ComputeDtype.FLOAT32
        dtype = torch.float32 if device == "cpu" or all_learn or exact else torch.bfloat16
        try:
            tokenizer = AutoTokenizer.from_pretrained(str(name))
            model: Any = AutoModelForCausalLM.from_pretrained(str(name), dtype=dtype)
            model.to(device)
        except Exception as error:  # readers of weights and tokenizers raise their own errors
            raise TrainerError(
                f"the model {str(name)!r} can't be loaded ({reason_of(error)}): {REMEDY}"
            ) from error
        cast_to = torch_dtype(settings.compute_dtype, device)
        if cast_to is not dtype and device == "cpu":
            use_compute_dtype(model, cast_to, model.get_output_embeddings())
        mixed = device != "cpu" and all_learn and not exact
        policy = cls(
            model,
            tokenizer,
            settings.codec,
            label or str(name),
            gradient_checkpointing=settings.gradient_checkpointing,
            autocast=torch.bfloat16 if mixed else None,
        )
        policy.in_episodes = bool(getattr(model.config, EPISODES_KEY, False))
        return policy

    def adapt(self, lora: LoraSettings, *, seed: int, saved: Path | None = None) -> None:
        """Freeze the model and train low-rank adapters, new ones or those in the folder ``saved``. Raises TrainerError."""
        self.module = add_adapters(self.module, lora, seed=seed)
        self.has_adapters = True
        if saved is not None:
            load_adapters(self.module, saved)

    def parameters(self) -> Iterator[nn.Parameter]:
        """Trainable parameters. For a frozen copy: all parameters."""
        learning = [parameter for parameter in self.module.parameters() if parameter.requires_grad]
        return iter(learning or self.module.parameters())

    def encode(self, prompt: Prompt) -> Tokens:
        """Apply the chat template if the model has one, else join system text, user text and "Plan:"."""
        if self._has_template:
            return self._tokens(self._chat(prompt))
        return self._tokens(
            f"{prompt.system}\n\n{prompt.user}\n{'Answer' if self.in_episodes else 'Plan'}:\n"
        )

    def _chat(self, prompt: Prompt) -> str:
        """Text of the chat template. A template without a system role gets the system text in the user's message."""
        from jinja2 import TemplateError

        user = {"role": "user", "content": prompt.user}
        # Gemma's template refuses the role, and some others leave the message out.
        with contextlib.suppress(TemplateError):
            text = self._render([{"role": "system", "content": prompt.system}, user])
            if prompt.system.strip() in text:
                return text
        return self._render([{**user, "content": f"{prompt.system}\n\n{prompt.user}"}])

    def encode_plan(self, text: str) -> Tokens:
        return (*self._tokens(text), self.end_tokens[0])

    @functools.cached_property
    def answer_end(self) -> int:
        """Token that ends an answer in an episode: the one that the chat template puts there, else the one that ends a plan."""
        first = self._tokens(self._between("")) if self._has_template else ()
        special = {*self._tokenizer.all_special_ids, *self._tokenizer.added_tokens_decoder}
        ends = first[:1] if first and first[0] in special - {self._tokenizer.unk_token_id} else ()
        return next(iter(ends), self.end_tokens[0])

    @property
    def answer_ends(self) -> tuple[int, ...]:
        """Tokens after which an answer is over."""
        return tuple(dict.fromkeys((self.answer_end, *self.end_tokens)))

    def encode_answer(self, text: str) -> Tokens:
        """Return the tokens of an answer in an episode, with its end token."""
        return (*self._tokens(text), self.answer_end)

    def encode_observation(self, text: str) -> Tokens:
        """Return the tokens after the end of an answer: the rest of its turn, the user's turn, and the start of the next.

        Raises TrainerError for a chat template that leaves earlier answers out.
        """
        if not self._has_template:
            return self._tokens(f"\n{text}\nAnswer:\n")
        tokens = self._tokens(self._between(text))
        return tokens[1:] if tokens[0] == self.answer_end else tokens

    @property
    def _has_template(self) -> bool:
        return bool(getattr(self._tokenizer, "chat_template", None))

    def _between(self, text: str) -> str:
        """Text of the chat template from the end of an answer to the beginning of the next. Raises TrainerError."""
        turns = [
            {"role": "user", "content": "begin"},
            {"role": "assistant", "content": _ANSWER},
            {"role": "user", "content": text},
        ]
        _, answer, rest = self._render(turns).partition(_ANSWER)
        if not answer:
            raise TrainerError(
                f"the chat template of {self.name} leaves earlier answers out: expected one that keeps them; pass another model"
            )
        return rest.lstrip(" ")

    def _render(self, turns: list[dict[str, str]]) -> str:
        """Apply the chat template. Templates that can leave thoughts out do so, because plans and calls are short."""
        rendered = self._tokenizer.apply_chat_template(
            turns, tokenize=False, add_generation_prompt=True, enable_thinking=False
        )
        return str(rendered)

    def unknown_words(self, text: str) -> frozenset[str]:
        unknown = self._tokenizer.unk_token_id
        if unknown is None or unknown not in self._tokens(text):
            return frozenset()
        return frozenset(word for word in text.split() if unknown in self._tokens(word))

    def _tokens(self, text: str) -> Tokens:
        return tuple(self._tokenizer(text, add_special_tokens=False)["input_ids"])

    @torch.no_grad()
    def sample(
        self,
        prompts: Sequence[Tokens],
        group: int,
        temperature: float,
        max_new: int,
        generator: torch.Generator,
    ) -> Samples:
        with self.computing():
            cache, mask, states = self.read(prompts, group)
            scores = self.next_scores(states).repeat_interleave(group, dim=0)  # (rows, V)
            rows = scores.shape[0]
            lengths = mask.sum(dim=1)  # (rows,)
            end = torch.tensor(self.end_tokens, device=scores.device)
            done = torch.zeros(rows, dtype=torch.bool, device=scores.device)
            tokens, masks, logprobs = [], [], []
            for at in range(max_new):
                choice, logprob = draw(scores, temperature, generator)
                choice = torch.where(done, self._pad, choice)
                tokens.append(choice)
                masks.append(~done)
                logprobs.append(torch.where(done, 0.0, logprob))
                done = done | torch.isin(choice, end)
                if bool(done.all()) or at == max_new - 1:
                    break
                mask = torch.cat([mask, mask.new_ones(rows, 1)], dim=1)
                states = self.extend(choice[:, None], mask, (lengths + at)[:, None], cache)
                scores = self.next_scores(states)
        drawn, own = torch.stack(tokens, dim=1), torch.stack(masks, dim=1)
        return Samples(drawn, own, torch.stack(logprobs, dim=1), self._texts(drawn, own), ~done)

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
        recompute = self._gradient_checkpointing and torch.is_grad_enabled()
        with self._precision():
            states = (self._states_recomputed if recompute else self._states)(prompts, tokens, group)
            chosen, entropy = chunked_scores(
                self._head, states[mask], tokens[mask], temperature, entropy_gradient=entropy_gradient
            )
        empty = chosen.new_zeros(mask.shape)
        return TokenScores(empty.masked_scatter(mask, chosen), empty.masked_scatter(mask, entropy))

    @contextlib.contextmanager
    def computing(self) -> Iterator[None]:
        """Context for passes without gradients, between which the weights do not change."""
        with frozen_weights(self.module), self._precision():
            yield

    def next_scores(self, states: Tensor) -> Tensor:
        """Scores (rows, V) of the tokens that follow the last of some states (rows, T, C)."""
        scores: Tensor = self._head(states)[:, -1].float()
        return scores

    def text_of(self, tokens: Sequence[int]) -> str:
        """Decode the tokens of an answer without special tokens."""
        return str(self._tokenizer.decode(list(tokens), skip_special_tokens=True))

    @property
    def pad(self) -> int:
        """Token that fills rows."""
        return self._pad

    @property
    def _head(self) -> Any:
        """Layer from the states of ``_run`` to scores."""
        return self.module.get_output_embeddings() if self._has_plain_head else nn.Identity()

    def _precision(self) -> contextlib.AbstractContextManager[object]:
        """Context in which the model computes. It casts each weight that learns once, for all passes in it."""
        if self._autocast is None:
            return contextlib.nullcontext()
        return torch.autocast(self.module.device.type, dtype=self._autocast)

    def _run(self, ids: Tensor, *, keep: int, **inputs: Any) -> Tensor:
        """Hidden states (rows, keep, C) of the last positions, or their scores (rows, keep, V) without a plain head."""
        if self._has_plain_head:
            states: Tensor = self.module.get_decoder()(ids, **inputs).last_hidden_state
            return states[:, -keep:]
        scores: Tensor = self.module(ids, logits_to_keep=keep, **inputs).logits
        return scores

    def _states(self, prompts: Sequence[Tokens], tokens: Tensor, group: int) -> Tensor:
        """States (rows, T, C) before each token (rows, T). The prompt of a group runs once."""
        cache, prompt_mask, first = self.read(prompts, group)
        states = first.repeat_interleave(group, dim=0)  # (rows, 1, C)
        length = tokens.shape[1]
        if length > 1:
            seen = torch.cat([prompt_mask, prompt_mask.new_ones(tokens.shape[0], length - 1)], dim=1)
            begin = prompt_mask.sum(dim=1, keepdim=True)
            positions = begin + torch.arange(length - 1, device=tokens.device)
            states = torch.cat([states, self.extend(tokens[:, :-1], seen, positions, cache)], dim=1)
        return states

    def _states_recomputed(self, prompts: Sequence[Tokens], tokens: Tensor, group: int) -> Tensor:
        """The same states without a cache, storing only each layer's input."""
        ids, padding = pad_left(prompts, self._pad, self.module.device)
        mask = (~padding).long()
        rest = tokens[:, :-1]
        whole = torch.cat([ids.repeat_interleave(group, dim=0), rest], dim=1)  # (rows, P + T - 1)
        seen = torch.cat([mask.repeat_interleave(group, dim=0), mask.new_ones(rest.shape)], dim=1)
        with _checkpointed_layers(self.module):
            return self._run(
                whole,
                keep=tokens.shape[1],
                attention_mask=seen,
                position_ids=(seen.cumsum(dim=1) - 1).clamp(min=0),
                use_cache=False,
            )

    def read(self, prompts: Sequence[Tokens], group: int) -> tuple[Any, Tensor, Tensor]:
        """Run the prompts once.

        Return cache and mask (rows, P), repeated for the samples, and the last state of each prompt (prompts, 1, C).
        """
        from transformers import DynamicCache

        ids, padding = pad_left(prompts, self._pad, self.module.device)
        mask = (~padding).long()
        cache = DynamicCache(config=self.module.config)
        states = self._run(
            ids,
            keep=1,
            attention_mask=mask,
            position_ids=(mask.cumsum(dim=1) - 1).clamp(min=0),
            past_key_values=cache,
            use_cache=True,
        )
        cache.batch_repeat_interleave(group)
        return cache, mask.repeat_interleave(group, dim=0), states

    def extend(self, tokens: Tensor, mask: Tensor, positions: Tensor, cache: Any) -> Tensor:
        """States (rows, T, C) after tokens (rows, T) that continue the cache."""
        return self._run(
            tokens,
            keep=tokens.shape[1],
            attention_mask=mask,
            position_ids=positions,
            past_key_values=cache,
            use_cache=True,
        )

    def _texts(self, tokens: Tensor, mask: Tensor) -> tuple[str, ...]:
        """Decode the samples without special tokens. The mask marks the end, because end and padding tokens may be equal."""
        return tuple(
            self._tokenizer.decode(row[own].tolist(), skip_special_tokens=True)
            for row, own in zip(tokens, mask, strict=True)
        )

    def samples_of(self, plans: Sequence[Tokens], logprobs: Sequence[Sequence[float]]) -> Samples:
        """Return plans that a model server sampled, with their log-probabilities. Tokens after an end token are dropped."""
        device, end = self.module.device, set(self.end_tokens)
        lengths = [
            next((at for at, token in enumerate(plan, 1) if token in end), len(plan)) for plan in plans
        ]
        shape = len(plans), max(lengths)
        tokens = torch.full(shape, self._pad, device=device)
        mask = torch.arange(shape[1], device=device) < torch.tensor(lengths, device=device)[:, None]
        scores = torch.zeros(shape, device=device)
        for row, (plan, own, length) in enumerate(zip(plans, logprobs, lengths, strict=True)):
            tokens[row, :length] = torch.tensor(plan[:length], device=device)
            scores[row, :length] = torch.tensor(own[:length], device=device)
        cut_off = torch.tensor(
            [plan[length - 1] not in end for plan, length in zip(plans, lengths, strict=True)], device=device
        )
        return Samples(tokens, mask, scores, self._texts(tokens, mask), cut_off)

    def frozen_copy(self) -> HfPolicy:
        """Return a frozen copy that shares all frozen parameters: with adapters, the whole base model."""
        twin = copy.copy(self)
        still = {id(each): each for each in self.module.parameters() if not each.requires_grad}
        twin.module = copy.deepcopy(self.module, still).requires_grad_(False)
        return twin

    def save(self, folder: Path) -> None:
        """Save the model with merged adapters, loadable by transformers, and the adapters in peft's format beside it.

        Raises OSError.
        """
        from safetensors import SafetensorError

        folder.mkdir(parents=True, exist_ok=True)
        setattr(self.module.config, CODEC_KEY, self.codec.value)
        setattr(self.module.config, EPISODES_KEY, self.in_episodes)
        try:
            model = self.module
            if self.has_adapters:
                model = copy.deepcopy(model).merge_and_unload()
            model.save_pretrained(folder)
        except SafetensorError as error:
            raise OSError(str(error)) from error
        self._tokenizer.save_pretrained(folder)
        if self.has_adapters:
            save_adapters(self.module, folder)

    def save_for_server(self, folder: Path) -> Path:
        """Save the adapters, or the whole model if it has none. Return the folder that a model server loads.

        Raises OSError.
        """
        if not self.has_adapters:
            self.save(folder)
            return folder
        save_adapters(self.module, folder)
        return folder / ADAPTERS

    @staticmethod
    def is_saved_in(folder: Path) -> bool:
        return (folder / CONFIG).is_file()

    @staticmethod
    def codec_in(folder: Path) -> Codec | None:
        """Return the codec that a folder's model was trained in, None for other models."""
        try:
            config = parse_json((folder / CONFIG).read_bytes())
            return Codec(config[CODEC_KEY])
        except (OSError, ValueError, TypeError, KeyError):
            return None


@contextlib.contextmanager
def _checkpointed_layers(model: nn.Module) -> Iterator[None]:
    """Checkpoint the layers of one forward pass without a cache (gradient checkpointing, Chen et al. 2016).

    transformers' own switch is not used: it works in training mode alone, which also turns on dropout.
    """
    stacks = [module for module in model.modules() if isinstance(module, torch.nn.ModuleList)]
    if not stacks:
        raise TrainerError("gradient_checkpointing: the model has no list of layers: leave the setting out")
    layers = max(stacks, key=len)
    try:
        for layer in layers:
            # No random state to preserve: policies run without dropout.
            layer.forward = functools.partial(
                checkpoint, layer.forward, use_reentrant=False, preserve_rng_state=False
            )
        yield
    finally:
        for layer in layers:
            layer.__dict__.pop("forward", None)


def _context_of(model: Any) -> int | None:
    """Return the longest sequence of a model, None if its configuration has no limit. A model with images has it for texts."""
    longest = getattr(model.config.get_text_config(), "max_position_embeddings", None)
    return None if longest is None else int(longest)


def attention_window(model: Any) -> int | None:
    """Return the number of tokens that some layers of a model attend to, None if all attend to all."""
    config = model.config.get_text_config()
    window, kinds = getattr(config, "sliding_window", None), getattr(config, "layer_types", None)
    is_off = getattr(config, "use_sliding_window", True) is False
    if window is None or is_off or (kinds is not None and "sliding_attention" not in kinds):
        return None
    return int(window)


def _end_tokens(model: Any, tokenizer: Any) -> list[int]:
    """Tokens that end a plan, the tokenizer's own first."""
    configured = getattr(getattr(model, "generation_config", None), "eos_token_id", None)
    others = configured if isinstance(configured, list) else [configured]
    found = dict.fromkeys(token for token in (tokenizer.eos_token_id, *others) if token is not None)
    if not found:
        raise TrainerError(
            "the model has no end-of-text token, so plans would never end: set one in its tokenizer"
        )
    return [int(token) for token in found]


def _check_available(name: str) -> None:
    """Raise TrainerError unless the model is a folder with a tokenizer, is cached, or is known to the hub.

    The hub is asked once with a short timeout: the loaders of transformers would retry for a minute.
    """
    if Path(name).is_dir():
        if not any((Path(name) / file).is_file() for file in TOKENIZERS):
            raise TrainerError(
                f"the model folder {name} has no tokenizer: copy the model's tokenizer.json and tokenizer_config.json into it"
            )
        return
    check_on_hub(name)


def check_on_hub(name: str) -> None:
    """Raise TrainerError unless the configuration of a model is cached, or the hub knows the model."""
    from huggingface_hub import HfApi, try_to_load_from_cache

    try:
        if isinstance(try_to_load_from_cache(name, "config.json"), str):
            return
        HfApi().model_info(name, timeout=HUB_TIMEOUT_S)
    except Exception as error:  # the hub's HTTP library, and so its errors, differ by version
        raise TrainerError(
            f"the model {name!r} is not a folder, and can't be fetched from the Hugging Face hub "
            f"({reason_of(error)}): {REMEDY}"
        ) from error
