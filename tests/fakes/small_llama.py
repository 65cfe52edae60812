"""Llama with a few thousand random weights and a whole-word tokenizer, for tests of Hugging Face policies."""

import torch

from embomatrix.skills.prompt import Codec, prompt_for
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.prompts import plan_text


def word_tokenizer(tasks):
    """Build a word-level tokenizer over the tasks' prompts and plans."""
    import tokenizers
    from transformers import PreTrainedTokenizerFast

    texts = []
    for task in tasks:
        prompt = prompt_for(task.situation, Codec.LINES)
        texts += [prompt.system, prompt.user, plan_text(task.oracle, task.situation, Codec.LINES)]
    inner = tokenizers.Tokenizer(tokenizers.models.WordLevel(unk_token="<unk>"))
    inner.pre_tokenizer = tokenizers.pre_tokenizers.WhitespaceSplit()
    inner.train_from_iterator(texts, tokenizers.trainers.WordLevelTrainer(special_tokens=["<unk>", "<end>"]))
    return PreTrainedTokenizerFast(tokenizer_object=inner, unk_token="<unk>", eos_token="<end>")


def random_llama(tokenizer, seed=0):
    from transformers import LlamaConfig, LlamaForCausalLM

    torch.set_num_threads(1)
    torch.manual_seed(seed)
    config = LlamaConfig(
        vocab_size=len(tokenizer),
        hidden_size=32,
        intermediate_size=64,
        num_hidden_layers=2,
        num_attention_heads=4,
        num_key_value_heads=2,
        max_position_embeddings=1024,
        tie_word_embeddings=True,
        eos_token_id=tokenizer.eos_token_id,
    )
    model = LlamaForCausalLM(config)
    with torch.no_grad():
        for parameter in model.parameters():  # far from uniform, so that differences would show
            parameter.mul_(6 if parameter.dim() > 1 else 1)
    return model


def save_small_llama(tasks, folder):
    """Save a random Llama whose tokenizer knows the words of these tasks."""
    tokenizer = word_tokenizer(tasks)
    HfPolicy(random_llama(tokenizer), tokenizer, Codec.LINES, "random llama").save(folder)
