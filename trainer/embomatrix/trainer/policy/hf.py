"""Any causal language model of Hugging Face, by name or folder. transformers is imported when one is asked for.

A group's prompt runs once, in sampling and in the update: its cache is repeated for the samples inside autograd, which gives
the gradients of the plain computation at a third of the time.
"""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import torch

from embomatrix.skills.prompt import Codec
from embomatrix.trainer.config.errors import TrainerError, reason_of
from embomatrix.trainer.config.settings import Products
from embomatrix.trainer.policy.compute_dtype import multiply_in, type_of, unchanged
from embomatrix.trainer.policy.drawing import draw
from embomatrix.trainer.policy.lora import adapt, load_adapters, merged, save_adapters
from embomatrix.trainer.policy.protocol import Samples, Scored
from embomatrix.trainer.policy.recompute import recomputing

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from torch import Tensor, nn

    from embomatrix.skills.prompt import Prompt
    from embomatrix.trainer.policy.lora import LoraShape
    from embomatrix.trainer.policy.protocol import Tokens

LOOK_UP_S: Final = 10.0
TOKENIZERS: Final = (
    "tokenizer.json",
    "tokenizer_config.json",
    "tokenizer.model",
    "spiece.model",
    "vocab.json",
    "vocab.txt",
)
"""Files of which a folder with a tokenizer has at least one."""
CONFIG: Final = "config.json"
CODEC_KEY: Final = "embomatrix_codec"
"""What a model's configuration says of the codec that it was taught in."""
REMEDY: Final = "pass `tiny`, a folder with config.json, or a Hugging Face name; `embomatrix model import-gguf` makes a folder"


class HfPolicy:
    """``model`` and ``tokenizer`` as transformers loads them; plans are written in ``codec``.

    ``recompute`` trades time for memory in the update: layers are computed twice, and the prompt once for each plan.
    """

    def __init__(
        self, model: Any, tokenizer: Any, codec: Codec, name: str, *, recompute: bool = False
    ) -> None:
        self._model = model.eval()
        self._recompute = recompute
        self._lora: LoraShape | None = None
        self._tokenizer = tokenizer
        self._codec = codec
        self._name = name
        self._end = _end_tokens(model, tokenizer)
        self._pad = self._end[0] if tokenizer.pad_token_id is None else int(tokenizer.pad_token_id)

    @classmethod
    def load(
        cls,
        name: str | Path,
        codec: Codec,
        *,
        device: str = "cpu",
        products: Products = Products.AUTO,
        label: str = "",
        recompute: bool = False,
    ) -> HfPolicy:
        """Read a model by name or folder; on a processor its layers multiply in ``products``.

        Raises TrainerError with a remedy where that fails.
        """
        try:
            _look_up(str(name))
            from transformers import AutoModelForCausalLM, AutoTokenizer
            from transformers.utils import logging as transformers_logging
        except ImportError as error:
            absent = "" if Path(name).is_dir() else " is no folder here, and one by a Hugging Face name"
            raise TrainerError(
                f"the model {str(name)!r}{absent} needs transformers: `pip install 'embomatrix[hf]'`, or --model tiny"
            ) from error
        # Its bars would be drawn into ours.
        transformers_logging.disable_progress_bar()  # type: ignore[no-untyped-call]
        dtype = torch.float32 if device == "cpu" else torch.bfloat16
        try:
            tokenizer = AutoTokenizer.from_pretrained(str(name))
            model: Any = AutoModelForCausalLM.from_pretrained(str(name), dtype=dtype)
            model.to(device)
        except Exception as error:  # the readers of weights and of tokenizers have errors of their own
            raise TrainerError(
                f"the model {str(name)!r} can't be loaded ({reason_of(error)}): {REMEDY}"
            ) from error
        multiplied = type_of(products, device)
        if multiplied is not dtype and device == "cpu":
            multiply_in(model, multiplied, model.get_output_embeddings())
        return cls(model, tokenizer, codec, label or str(name), recompute=recompute)

    def adapt(self, shape: LoraShape, *, seed: int, saved: Path | None = None) -> None:
        """From now on adapters learn and the model does not. ``saved``: a folder to take them from. Raises TrainerError."""
        adapt(self._model, shape, seed=seed, head=self._model.get_output_embeddings())
        self._lora = shape
        if saved is not None:
            load_adapters(self._model, shape, saved)

    @property
    def name(self) -> str:
        return self._name

    @property
    def codec(self) -> Codec:
        return self._codec

    @property
    def module(self) -> nn.Module:
        return self._model  # type: ignore[no-any-return]

    def parameters(self) -> Iterator[nn.Parameter]:
        """Those that learn; of a frozen copy, all."""
        learning = [parameter for parameter in self.module.parameters() if parameter.requires_grad]
        return iter(learning or self.module.parameters())

    def encode(self, prompt: Prompt) -> Tokens:
        """The chat template's text where the model has one, else system and user text and a cue."""
        if getattr(self._tokenizer, "chat_template", None):
            messages = [
                {"role": "system", "content": prompt.system},
                {"role": "user", "content": prompt.user},
            ]
            text = self._tokenizer.apply_chat_template(messages, tokenize=False, add_generation_prompt=True)
        else:
            text = f"{prompt.system}\n\n{prompt.user}\nPlan:\n"
        return self._tokens(text)

    def encode_plan(self, text: str) -> Tokens:
        return (*self._tokens(text), self._end[0])

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
        with unchanged(self._model):
            cache, mask, scores = self._read(prompts, group)
            rows = scores.shape[0]
            lengths = mask.sum(dim=1)  # (rows,)
            end = torch.tensor(self._end, device=scores.device)
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
                scores = self._extend(choice[:, None], mask, (lengths + at)[:, None], cache)[:, -1]
        drawn, own = torch.stack(tokens, dim=1), torch.stack(masks, dim=1)
        return Samples(drawn, own, torch.stack(logprobs, dim=1), self._texts(drawn, own))

    def logprobs(
        self, prompts: Sequence[Tokens], tokens: Tensor, mask: Tensor, group: int, temperature: float
    ) -> Scored:
        again = self._recompute and torch.is_grad_enabled()
        scores = (self._scores_recomputed if again else self._scores)(prompts, tokens, group)
        spread = torch.log_softmax(scores / (temperature or 1.0), dim=-1)  # (rows, T, V)
        chosen = spread.gather(-1, tokens[..., None])[..., 0]
        entropy = -(spread.exp() * spread).sum(dim=-1)
        return Scored(chosen * mask, entropy * mask)

    def _scores(self, prompts: Sequence[Tokens], tokens: Tensor, group: int) -> Tensor:
        """Scores (rows, T, V) of each of the tokens (rows, T), a group's prompt run once."""
        cache, prompt_mask, first = self._read(prompts, group)
        scores = first[:, None]  # (rows, 1, V)
        length = tokens.shape[1]
        if length > 1:
            seen = torch.cat([prompt_mask, prompt_mask.new_ones(tokens.shape[0], length - 1)], dim=1)
            begin = prompt_mask.sum(dim=1, keepdim=True)
            positions = begin + torch.arange(length - 1, device=tokens.device)
            scores = torch.cat([scores, self._extend(tokens[:, :-1], seen, positions, cache)], dim=1)
        return scores

    def _scores_recomputed(self, prompts: Sequence[Tokens], tokens: Tensor, group: int) -> Tensor:
        """The same without a cache, in memory for each layer's input alone."""
        ids, mask = self._padded(prompts)
        rest = tokens[:, :-1]
        whole = torch.cat([ids.repeat_interleave(group, dim=0), rest], dim=1)  # (rows, P + T - 1)
        seen = torch.cat([mask.repeat_interleave(group, dim=0), mask.new_ones(rest.shape)], dim=1)
        with recomputing(self._model):
            result = self._model(
                whole,
                attention_mask=seen,
                position_ids=(seen.cumsum(dim=1) - 1).clamp(min=0),
                use_cache=False,
                logits_to_keep=tokens.shape[1],
            )
        return result.logits.float()  # type: ignore[no-any-return]

    def _padded(self, prompts: Sequence[Tokens]) -> tuple[Tensor, Tensor]:
        """Prompts as rows of tokens that end together, and the mask that is 1 on them; both (prompts, P)."""
        longest = max(len(prompt) for prompt in prompts)
        ids = torch.full((len(prompts), longest), self._pad)
        mask = torch.zeros(len(prompts), longest, dtype=torch.long)
        for row, prompt in enumerate(prompts):
            ids[row, longest - len(prompt) :] = torch.tensor(prompt)
            mask[row, longest - len(prompt) :] = 1
        return ids.to(self._model.device), mask.to(self._model.device)

    def _read(self, prompts: Sequence[Tokens], group: int) -> tuple[Any, Tensor, Tensor]:
        """Run the prompts once; cache, mask (rows, P) and next-token scores (rows, V) are repeated for the samples."""
        from transformers import DynamicCache

        ids, mask = self._padded(prompts)
        cache = DynamicCache(config=self._model.config)
        result = self._model(
            ids,
            attention_mask=mask,
            position_ids=(mask.cumsum(dim=1) - 1).clamp(min=0),
            past_key_values=cache,
            use_cache=True,
            logits_to_keep=1,
        )
        cache.batch_repeat_interleave(group)
        scores = result.logits[:, -1].float().repeat_interleave(group, dim=0)
        return cache, mask.repeat_interleave(group, dim=0), scores

    def _extend(self, tokens: Tensor, mask: Tensor, positions: Tensor, cache: Any) -> Tensor:
        """Scores (rows, T, V) after tokens (rows, T) that follow what is cached."""
        result = self._model(
            tokens, attention_mask=mask, position_ids=positions, past_key_values=cache, use_cache=True
        )
        return result.logits.float()  # type: ignore[no-any-return]

    def _texts(self, tokens: Tensor, mask: Tensor) -> tuple[str, ...]:
        """Text of each sample without special tokens. The end is found by the mask: it may equal the padding."""
        return tuple(
            self._tokenizer.decode(row[own].tolist(), skip_special_tokens=True)
            for row, own in zip(tokens, mask, strict=True)
        )

    def frozen_copy(self) -> HfPolicy:
        """What never learns is shared, not copied: beside adapters the model itself."""
        twin = copy.copy(self)
        still = {id(each): each for each in self._model.parameters() if not each.requires_grad}
        twin._model = copy.deepcopy(self._model, still).requires_grad_(False)
        return twin

    def save(self, folder: Path) -> None:
        """The model with its adapters merged in, which anyone can load, and the adapters beside it to go on with.

        Raises OSError.
        """
        from safetensors import SafetensorError

        folder.mkdir(parents=True, exist_ok=True)
        setattr(self._model.config, CODEC_KEY, self._codec.value)
        try:
            with merged(self._model):
                self._model.save_pretrained(folder)
        except SafetensorError as error:
            raise OSError(str(error)) from error
        self._tokenizer.save_pretrained(folder)
        if self._lora is not None:
            save_adapters(self._model, self._lora, folder)

    @staticmethod
    def is_saved_in(folder: Path) -> bool:
        return (folder / CONFIG).is_file()

    @staticmethod
    def codec_in(folder: Path) -> Codec | None:
        """The codec that the model of a folder was taught here; None for any other model."""
        try:
            config = json.loads((folder / CONFIG).read_text(encoding="utf-8"))
            return Codec(config[CODEC_KEY])
        except (OSError, ValueError, TypeError, KeyError):
            return None


def _end_tokens(model: Any, tokenizer: Any) -> list[int]:
    """Tokens that end a plan, the tokenizer's own first."""
    configured = getattr(getattr(model, "generation_config", None), "eos_token_id", None)
    others = configured if isinstance(configured, list) else [configured]
    found = dict.fromkeys(token for token in (tokenizer.eos_token_id, *others) if token is not None)
    if not found:
        raise TrainerError(
            "the model has no end-of-text token: a plan could never end; set one in its tokenizer"
        )
    return [int(token) for token in found]


def _look_up(name: str) -> None:
    """Raise TrainerError unless the model is a folder with a tokenizer, was downloaded before, or is known to the hub.

    The hub is asked once and briefly: the loaders of transformers would try for a minute.
    """
    if Path(name).is_dir():
        if not any((Path(name) / file).is_file() for file in TOKENIZERS):
            raise TrainerError(
                f"the model folder {name} has no tokenizer: copy the model's tokenizer.json and tokenizer_config.json into it"
            )
        return
    from huggingface_hub import HfApi, try_to_load_from_cache

    try:
        if isinstance(try_to_load_from_cache(name, "config.json"), str):
            return
        HfApi().model_info(name, timeout=LOOK_UP_S)
    except Exception as error:  # the hub's HTTP library, and with it its errors, differs by version
        raise TrainerError(
            f"the model {name!r} is no folder here, and the Hugging Face hub does not give it "
            f"({reason_of(error)}): {REMEDY}"
        ) from error
