"""TRL's GRPO steps on a load, as a program for an environment that has TRL and none of our packages.

    PYTHON trl_steps.py LOAD

It writes the CPU seconds of each step, on a GPU the wall seconds, as JSON on the last line of standard output. Groups,
lengths, loss, batch, model and reward are those of our own steps.
"""

import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("HF_HUB_OFFLINE", "1")


def measure(load: dict[str, Any]) -> list[float]:
    """CPU seconds of each measured step, on a GPU wall seconds."""
    import torch
    from datasets import Dataset
    from transformers import TrainerCallback
    from trl import GRPOTrainer

    on_gpu = load["device"] != "cpu"

    def now_s() -> float:
        if not on_gpu:
            return time.process_time()
        torch.cuda.synchronize()
        return time.perf_counter()

    class Clock(TrainerCallback):
        """Reads the clock around each step."""

        def __init__(self) -> None:
            self.began_s = 0.0
            self.spent_s: list[float] = []

        def on_step_begin(self, *_: Any, **__: Any) -> None:
            self.began_s = now_s()

        def on_step_end(self, *_: Any, **__: Any) -> None:
            self.spent_s.append(now_s() - self.began_s)

    torch.set_num_threads(1)
    torch.manual_seed(load["seed"])
    clock = Clock()
    with tempfile.TemporaryDirectory() as folder:
        GRPOTrainer(
            model=model_of(load),
            processing_class=tokenizer_of(load["words"]),
            reward_funcs=_by_length,
            args=_settings(load, folder),
            train_dataset=Dataset.from_list([{"prompt": prompt} for prompt in load["prompts"]]),
            callbacks=[clock],
        ).train()
    return clock.spent_s[load["unmeasured"] :]


def _by_length(completions: list[str], **_: Any) -> list[float]:
    return [float(len(text)) for text in completions]


def tokenizer_of(words: list[str]) -> Any:
    """Whitespace tokenizer over the words: the first stands for unknown ones, the second ends a text."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    inner = Tokenizer(models.WordLevel({word: at for at, word in enumerate(words)}, unk_token=words[0]))
    inner.pre_tokenizer = pre_tokenizers.WhitespaceSplit()
    words_only: Any = PreTrainedTokenizerFast  # transformers leaves it untyped
    return words_only(
        tokenizer_object=inner,
        unk_token=words[0],
        eos_token=words[1],
        pad_token=words[1],
        padding_side="left",
    )


def model_of(load: dict[str, Any]) -> Any:
    """Random Llama of the load's shape."""
    from transformers import LlamaConfig, LlamaForCausalLM

    return LlamaForCausalLM(
        LlamaConfig(
            vocab_size=len(load["words"]),
            hidden_size=load["width"],
            intermediate_size=load["inner"],
            num_hidden_layers=load["layers"],
            num_attention_heads=load["heads"],
            num_key_value_heads=load["key_value_heads"],
            max_position_embeddings=2048,
            tie_word_embeddings=True,
            eos_token_id=1,
            pad_token_id=1,
        )
    )


def _settings(load: dict[str, Any], folder: str) -> Any:
    from trl import GRPOConfig

    plans, on_gpu = load["tasks"] * load["group"], load["device"] != "cpu"
    at_once = load["microbatch"] or plans
    return GRPOConfig(
        output_dir=folder,
        per_device_train_batch_size=at_once,
        gradient_accumulation_steps=plans // at_once,
        num_generations=load["group"],
        max_completion_length=load["new"],
        max_steps=load["unmeasured"] + load["steps"],
        loss_type="dapo",
        beta=0.0,
        temperature=1.0,
        use_cpu=not on_gpu,
        bf16=on_gpu,
        gradient_checkpointing=False,
        save_strategy="no",
        report_to="none",
        disable_tqdm=True,
        seed=load["seed"],
    )


if __name__ == "__main__":
    found = measure(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
    sys.stdout.write("\n" + json.dumps({"step_s": found}) + "\n")
