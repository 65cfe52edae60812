"""Memory plan of a run: against the tensors of real steps, and as the command prints it."""

import json
from pathlib import Path

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.symbolic_household import make_tasks

from embomatrix.bench.trainer.memory import plan_error
from embomatrix.starter.shipped import unpack_part
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import LANGUAGE_MODEL_DEFAULTS, LoraSettings, read_settings
from embomatrix.trainer.data.tasks import load_tasks
from embomatrix.trainer.policy.footprint import LanguageModelFootprint, Precision, WordLevelFootprint
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.limits import TokenCounter, with_limits
from embomatrix.trainer.policy.loading import new_policy
from embomatrix.trainer.policy.memory_plan import GB, Phase
from embomatrix.trainer.policy.model_shape import language_model_shape
from embomatrix.trainer.run.memory import forecast, lengths_of, memory_text

TASKS = make_tasks(6, 2, objects=8)
CPU = {"device": "cpu", "compute_dtype": "float32", "threads": 1}
TOLERANCE = 0.15
PAGE = Path(__file__).parents[3] / "docs" / "training.md"


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    return write_kitchen_dataset(tmp_path_factory.mktemp("kitchen"))


@pytest.fixture
def llama_8b(tmp_path):
    """Folder with the configuration of a Llama of 8 billion weights, and nothing else."""
    pytest.importorskip("transformers")
    config = {
        "model_type": "llama",
        "hidden_size": 4096,
        "intermediate_size": 14336,
        "num_hidden_layers": 32,
        "num_attention_heads": 32,
        "num_key_value_heads": 8,
        "vocab_size": 128256,
        "tie_word_embeddings": False,
        "max_position_embeddings": 131072,
    }
    folder = tmp_path / "llama-8b"
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps(config))
    return folder


def test_word_level_steps_need_the_planned_memory():
    changes = {
        **CPU,
        "grpo.tasks_per_step": 4,
        "grpo.chunk": 2,
        "grpo.max_new": 40,
        "grpo.zero_variance": "keep",
    }
    settings = read_settings(None, changes)
    policy = new_policy(settings, TASKS)
    footprint = WordLevelFootprint(policy.module.shape, casts=False)
    assert abs(plan_error(policy, footprint, settings, TASKS.train)) < TOLERANCE


@pytest.mark.hf
def test_smollm2_steps_need_the_planned_memory(smollm2_folder):
    pytest.importorskip("transformers")
    changes = {**CPU, "grpo.tasks_per_step": 2, "grpo.group": 4, "grpo.max_new": 24}
    settings = read_settings(None, changes, LANGUAGE_MODEL_DEFAULTS)
    shape = language_model_shape(str(smollm2_folder))
    footprint = LanguageModelFootprint(shape, Precision.FLOAT32, LoraSettings(), recomputes=False)
    policy = HfPolicy.load(smollm2_folder, settings)
    assert footprint.learning == sum(parameter.numel() for parameter in policy.parameters())
    assert abs(plan_error(policy, footprint, settings, TASKS.train)) < TOLERANCE


def test_word_level_plan_measures_texts_as_the_policy_does(kitchen):
    found = forecast(kitchen, "tiny", None, CPU)
    tasks = load_tasks(kitchen)
    policy = new_policy(found.settings, tasks)
    assert found.settings == with_limits(read_settings(None, {**CPU, "model": "tiny"}), policy, tasks)
    assert found.lengths == lengths_of(tasks, found.settings, TokenCounter.of_policy(policy))
    text = memory_text(found, 80.0)
    assert text.endswith("It fits in 72.00 GB, the usable share of 80 GB.")
    assert "estimated" not in text


def test_plan_of_a_language_model_reads_its_configuration_only(kitchen, llama_8b):
    found = forecast(kitchen, str(llama_8b), None, {})
    plan = found.plan
    assert found.settings.device == "cuda"
    parameters = 8_030_261_248
    assert sum(plan.parts[Phase.STEP].values()) >= 24 * parameters  # 20 bytes each, and AdamW's denominators
    text = memory_text(found, 80.0)
    assert "does not fit in 72.00 GB, the usable share of 80 GB." in text
    assert f"lora.rank = 16 helps most: {found.advice.peak / GB:.2f} GB, which fits." in text
    changed = forecast(kitchen, str(llama_8b), None, {"lora.rank": 16})
    assert changed.plan.peak == found.advice.peak
    assert changed.plan.peak_phase is Phase.CHECKPOINT
    assert memory_text(changed, 8.0).endswith("take a larger GPU or a smaller model.")
    assert memory_text(found, 8.0).endswith("GB, which does not fit either.")


def test_printed_plan_of_the_page_is_that_of_the_shipped_tasks(llama_8b, tmp_path, monkeypatch):
    unpack_part(tmp_path / "shipped", 1)
    monkeypatch.chdir(llama_8b.parent)
    found = forecast(tmp_path / "shipped", llama_8b.name, None, {})
    assert f"```text\n{memory_text(found, 80.0)}\n```" in PAGE.read_text(encoding="utf-8")


def test_unusable_configurations_are_one_sentence(kitchen, tmp_path):
    pytest.importorskip("transformers")
    with pytest.raises(TrainerError, match=r"the model folder \S+ has no config\.json"):
        forecast(kitchen, str(tmp_path), None, {})
    for text in ("{", "[]", '{"model_type": "llama", "hidden_size": "wide"}'):
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(TrainerError, match=r"the config\.json of the model \S+ can't be used"):
            forecast(kitchen, str(tmp_path), None, {})
