"""Other trainers' own code on a real cluster: a manager, a worker with physics, and the examples of the docs."""

import json

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.peers import EXAMPLES, Peer
from tests.fakes.real_cluster import RealCluster, connected

pytestmark = [pytest.mark.peers, pytest.mark.timeout(1800)]
TORCH = "torch==2.13.0"
SMALL_MODEL = """
import sys
from tokenizers import Tokenizer
from tokenizers.models import WordLevel
from transformers import LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerFast

# Every word is a whole call, so that a model without any training writes plans.
words = ["<end>", "<unknown>", *(f"{verb} {row};" for verb in ("move", "open", "pick_up") for row in range(10))]
tokenizer = PreTrainedTokenizerFast(
    tokenizer_object=Tokenizer(WordLevel({word: at for at, word in enumerate(words)}, unk_token="<unknown>")),
    eos_token="<end>", pad_token="<end>", unk_token="<unknown>",
    chat_template="{% for message in messages %}{{ message.content }}{% endfor %}",
)
tokenizer.save_pretrained(sys.argv[1])
LlamaForCausalLM(LlamaConfig(
    vocab_size=len(words), hidden_size=32, intermediate_size=64, num_hidden_layers=1, num_attention_heads=4,
    bos_token_id=0, eos_token_id=0, pad_token_id=0,
)).save_pretrained(sys.argv[1])
"""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return write_kitchen_dataset(tmp_path_factory.mktemp("dataset"))


@pytest.fixture
async def cluster(tmp_path):
    with RealCluster(tmp_path) as started:
        started.start_manager()
        started.start_real_worker("worker", slots=2)
        async with started.client() as client:
            await connected(client, "worker")
            yield started, client


async def test_trl_trains_on_the_cluster_and_announces_what_comes(cluster, dataset, tmp_path):
    started, client = cluster
    peer = Peer("trl", TORCH, "trl==1.16.0")
    peer.run("-c", SMALL_MODEL, tmp_path / "model")
    peer.run(
        EXAMPLES / "train_with_trl.py",
        *(dataset, tmp_path / "model", tmp_path / "out"),
        *("--steps=3", "--group=4", "--tokens=6", "--cpu"),
        EMBOMATRIX_MANAGER=started.address,
    )
    state = json.loads((tmp_path / "out" / "trainer_state.json").read_text())
    steps = [entry for entry in state["log_history"] if "reward" in entry]
    assert len(steps) == 3
    for step in steps:
        assert step["embomatrix/lost"] == 0
        assert -1 <= step["embomatrix/format"] <= 0.5
        tiers = sum(step[f"embomatrix/{tier}"] for tier in ("format", "relevance", "goal"))
        assert step["reward"] == pytest.approx(tiers, abs=1e-4)
    assert any(step["embomatrix/relevance"] > 0 for step in steps)
    (run,) = [run for run in await client.list_runs(closed=True) if run.name == "adapter"]
    assert run.closed_s, "the script's end closes its run"
    assert 0 < run.stats.delivered <= 3 * 2 * 4
    assert run.stats.prewarm_hits + run.stats.prewarm_misses > 0, "nothing was announced"
