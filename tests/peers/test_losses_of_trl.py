"""Losses and gradients equal TRL's. Skipped without TRL, whose pinned versions need a separate environment:

python3.11 -m venv trl && trl/bin/pip install "torch==2.13.0" "trl==1.16.0" pytest pytest-asyncio pytest-timeout hypothesis -e .
HF_HUB_OFFLINE=1 trl/bin/python -m pytest tests/peers
"""

import itertools

import pytest
import torch

from embomatrix.trainer.config.settings import GrpoSettings, LossKind, RatioLevel
from embomatrix.trainer.learning.objective import (
    LossInputs,
    LossTotals,
    group_advantages,
    surrogate_loss,
)

pytest.importorskip("trl")

GROUP, TASKS, LENGTH, WORDS, TEMPERATURE = 4, 2, 12, 50, 0.9
CASES = list(
    itertools.product(
        (LossKind.GRPO, LossKind.BNPO, LossKind.DR_GRPO, LossKind.DAPO),
        (RatioLevel.TOKEN, RatioLevel.MEAN),
        (0.0, 0.04),
    )
)


class Case:
    """Small model and a batch whose plans end early, whose old log-probabilities differ, and of which one was lost."""

    def __init__(self, folder):
        from transformers import LlamaConfig, LlamaForCausalLM

        torch.manual_seed(0)
        shape = LlamaConfig(
            vocab_size=WORDS,
            hidden_size=32,
            intermediate_size=64,
            num_hidden_layers=2,
            num_attention_heads=4,
            bos_token_id=1,
            eos_token_id=2,
            pad_token_id=2,
        )
        LlamaForCausalLM(shape).save_pretrained(folder / "model")
        # With a KL term TRL loads its reference from the folder that the configuration names.
        self.model = LlamaForCausalLM.from_pretrained(folder / "model")
        self.prompts = torch.randint(3, WORDS, (TASKS, 9)).repeat_interleave(GROUP, 0)
        self.plans = torch.randint(3, WORDS, (TASKS * GROUP, LENGTH))
        lengths = torch.randint(3, LENGTH + 1, (TASKS * GROUP, 1))
        self.mask = torch.arange(LENGTH)[None, :] < lengths
        rewards = 3 * torch.randn(TASKS, GROUP)
        rewards[1, 1] = torch.nan
        self.advantages = group_advantages(rewards).values.view(-1)
        now = self.logprobs().detach()
        self.old = now + 0.3 * torch.randn_like(now)
        self.reference = now + 0.2 * torch.randn_like(now)

    def logprobs(self):
        tokens = torch.cat([self.prompts, self.plans], dim=1)
        scores = self.model(tokens).logits[:, -LENGTH - 1 : -1] / TEMPERATURE
        return torch.log_softmax(scores, dim=-1).gather(-1, self.plans[..., None])[..., 0]

    def gradient(self, loss):
        self.model.zero_grad(set_to_none=True)
        loss.backward()
        return torch.cat([parameter.grad.flatten() for parameter in self.model.parameters()])


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return Case(tmp_path_factory.mktemp("model"))


def tokenizer():
    from tokenizers import Tokenizer
    from tokenizers.models import WordLevel
    from transformers import PreTrainedTokenizerFast

    words = Tokenizer(WordLevel({f"w{number}": number for number in range(WORDS)}, unk_token="w0"))
    return PreTrainedTokenizerFast(tokenizer_object=words, eos_token="w2", pad_token="w2", unk_token="w0")


def their_loss(case, folder, kind, level, kl_coef):
    from datasets import Dataset
    from trl import GRPOConfig, GRPOTrainer

    arguments = GRPOConfig(
        output_dir=str(folder),
        per_device_train_batch_size=TASKS * GROUP,
        num_generations=GROUP,
        max_completion_length=LENGTH,
        loss_type=kind.value,
        importance_sampling_level="token" if level is RatioLevel.TOKEN else "sequence",
        beta=kl_coef,
        use_bias_correction_kl=False,
        epsilon=0.2,
        epsilon_high=0.28,
        temperature=TEMPERATURE,
        report_to="none",
        use_cpu=True,
        bf16=False,
        gradient_checkpointing=False,
    )
    trainer = GRPOTrainer(
        model=case.model,
        processing_class=tokenizer(),
        reward_funcs=[lambda completions, **_: [0.0] * len(completions)],
        args=arguments,
        train_dataset=Dataset.from_list([{"prompt": "w3"}] * TASKS),
    )
    trainer.current_gradient_accumulation_steps = 1
    trainer.model.train()
    return trainer._compute_loss(
        trainer.model,
        {
            "prompt_ids": case.prompts,
            "prompt_mask": torch.ones_like(case.prompts),
            "completion_ids": case.plans,
            "completion_mask": case.mask.long(),
            "advantages": case.advantages,
            "num_items_in_batch": case.mask.sum(),
            "old_per_token_logps": case.old,
            "ref_per_token_logps": case.reference,
        },
    )


@pytest.mark.parametrize(("kind", "level", "kl_coef"), CASES)
def test_loss_and_gradient_equal_those_of_trl(case, tmp_path, kind, level, kl_coef):
    theirs = their_loss(case, tmp_path, kind, level, kl_coef)
    their_gradient = case.gradient(theirs)
    inputs = LossInputs(case.logprobs(), case.old, case.mask, case.advantages[:, None], case.reference)
    settings = GrpoSettings(loss=kind, ratio=level, clip_low=0.2, clip_high=0.28, kl_coef=kl_coef)
    totals = LossTotals(TASKS * GROUP, int(case.mask.sum()), LENGTH)
    ours, _ = surrogate_loss(inputs, settings, totals)
    assert ours.item() == pytest.approx(theirs.item(), rel=1e-5, abs=1e-7)
    assert float((case.gradient(ours) - their_gradient).norm() / their_gradient.norm()) < 1e-5
