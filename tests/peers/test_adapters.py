"""Adapters of other trainers on a real cluster: a manager, a worker with physics, and the examples in docs/."""

import asyncio
import json
import os
import re
import shlex

import pytest
from tests.fakes.chat_server import ChatServer
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.documents import snippets
from tests.fakes.peers import EXAMPLES, ROOTS, Peer
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
TOOL_CALLER = r"""
import json
import sys
from pathlib import Path

import trl
from tokenizers import AddedToken, Tokenizer, decoders
from tokenizers.models import WordLevel
from tokenizers.pre_tokenizers import WhitespaceSplit
from transformers import LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerFast

# A model without any training calls tools, because each call is one token.
calls = [
    "<tool_call>\n" + json.dumps({"name": name, "arguments": {"object_index": row}}) + "\n</tool_call>"
    for name in ("move", "open", "pick_up") for row in range(4)
]
words = ["<|im_end|>", "<unknown>", "<|im_start|>", *calls]
inner = Tokenizer(WordLevel({word: at for at, word in enumerate(words)}, unk_token="<unknown>"))
inner.pre_tokenizer = WhitespaceSplit()
inner.add_special_tokens(["<|im_start|>", "<|im_end|>"])
inner.add_tokens([AddedToken(call, normalized=False) for call in calls])
inner.decoder = decoders.Fuse()
tokenizer = PreTrainedTokenizerFast(
    tokenizer_object=inner, eos_token="<|im_end|>", pad_token="<|im_end|>", unk_token="<unknown>",
    chat_template=(Path(trl.__file__).parent / "chat_templates" / "qwen3.jinja").read_text(),
)
tokenizer.save_pretrained(sys.argv[1])
LlamaForCausalLM(LlamaConfig(
    vocab_size=len(words), hidden_size=32, intermediate_size=64, num_hidden_layers=1, num_attention_heads=4,
    bos_token_id=0, eos_token_id=0, pad_token_id=0, max_position_embeddings=4096,
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


async def test_trl_trains_on_the_cluster_and_announces_the_next_scenes(cluster, dataset, tmp_path):
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


async def test_trl_trains_in_episodes_on_the_cluster(cluster, dataset, tmp_path):
    started, client = cluster
    peer = Peer("trl", TORCH, "trl==1.16.0")
    peer.run("-c", TOOL_CALLER, tmp_path / "model")
    peer.run(
        EXAMPLES / "train_with_trl_episodes.py",
        *(dataset, tmp_path / "model", tmp_path / "out"),
        *("--steps=3", "--group=4", "--calls=4", "--tokens=1500", "--cpu"),
        EMBOMATRIX_MANAGER=started.address,
    )
    state = json.loads((tmp_path / "out" / "trainer_state.json").read_text())
    steps = [entry for entry in state["log_history"] if "reward" in entry]
    assert len(steps) == 3
    for step in steps:
        assert step["embomatrix/lost"] == 0
        assert step["tools/failure_frequency"] == 0, "TRL could not call the tools"
        assert step["embomatrix/calls"] > 0
        tiers = sum(step[f"embomatrix/{tier}"] for tier in ("format", "relevance", "goal"))
        assert step["reward"] == pytest.approx(tiers, abs=1e-4)
    assert any(step["embomatrix/relevance"] > 0 for step in steps)
    (run,) = [run for run in await client.list_runs(closed=True) if run.name == "episodes"]
    assert run.closed_s, "the script's end closes its run"


TRL = """
import sys
block = sys.argv[1]
exec(compile(block, "docs/adapters.md", "exec"), globals())
trainer.train()
print("trained", trainer.state.global_step)
"""
TRL_SETTINGS = "max_steps=1, per_device_train_batch_size=4, num_generations=2, report_to='none', use_cpu=True, bf16=False"


@pytest.mark.parametrize(
    ("heading", "model", "tokens"),
    [("TRL", SMALL_MODEL, ("=1024", "=6")), ("TRL, in episodes", TOOL_CALLER, ("=8192", "=1500"))],
)
async def test_trl_block_of_the_page_trains(cluster, dataset, tmp_path, heading, model, tokens):
    peer = Peer("trl", TORCH, "trl==1.16.0")
    peer.run("-c", model, tmp_path / "model")
    (block,) = snippets("adapters.md", heading, "python")
    for printed, given in (
        ("model=...", f"model={str(tmp_path / 'model')!r}"),
        ("GRPOConfig(...", f"GRPOConfig(output_dir={str(tmp_path / 'out')!r}, {TRL_SETTINGS}"),
        (f"max_completion_length{tokens[0]}", f"max_completion_length{tokens[1]}"),  # seconds, not minutes
        ("build/dataset", str(dataset)),
    ):
        assert printed in block
        block = block.replace(printed, given)
    assert "trained 1" in peer.run("-c", TRL, block, EMBOMATRIX_MANAGER=cluster[0].address)


async def test_trl_block_of_the_readme_trains(cluster, dataset, tmp_path):
    peer = Peer("trl", TORCH, "trl==1.16.0")
    peer.run("-c", TOOL_CALLER, tmp_path / "model")
    readme = (EXAMPLES.parents[1] / "README.md").read_text(encoding="utf-8")
    (block,) = [each for each in re.findall(r"```python\n(.*?)```", readme, re.DOTALL) if "trl" in each]
    for printed, given in (
        ("Qwen/Qwen3-1.7B", str(tmp_path / "model")),
        ('GRPOConfig("runs/trl"', f"GRPOConfig({str(tmp_path / 'out')!r}, {TRL_SETTINGS}"),
        ("max_completion_length=8192", "max_completion_length=1500"),
        ("build/dataset", str(dataset)),
    ):
        assert printed in block
        block = block.replace(printed, given)
    printed = peer.run("-c", "import sys; exec(sys.argv[1])", block, EMBOMATRIX_MANAGER=cluster[0].address)
    assert "embomatrix/success" in printed


VERIFIERS_PEER = ("verifiers", "verifiers==0.4.0", "uv==0.13.9")
"""Its harnesses start programs with uv."""
VERIFIERS = """
import asyncio, json, sys
sys.path.append(sys.argv[2])
import verifiers.v1 as vf
from verifiers.v1.utils.loaders import load_taskset
from verifiers.v1.types import AssistantMessage
from embomatrix.trainer.adapters.verifiers import HouseholdConfig
from embomatrix.world.dataset import Dataset

taskset = load_taskset(HouseholdConfig(id="embomatrix-household", dataset=sys.argv[1]))
records = Dataset.load(sys.argv[1]).train
oracles = {record.task.task_id: json.dumps([dict(call) for call in record.oracle]) for record in records}

def trace_of(task, reply):
    node = vf.MessageNode(message=AssistantMessage(content=reply), sampled=True)
    seed = vf.TraceTask(type=type(task).__name__, data=task.data)
    return vf.Trace.model_construct(task=seed, nodes=[node], rewards={}, metrics={}, info={}, root_reply=None)

async def main():
    tasks = list(taskset)
    good = [trace_of(task, oracles[task.data.id]) for task in tasks]
    none = [trace_of(task, "hm") for task in tasks]
    await asyncio.gather(*(task.score(trace) for task, trace in zip(tasks * 2, good + none, strict=True)))
    for trace in good + none:
        total = sum(reward.score * reward.weight for reward in trace.rewards.values())
        print(json.dumps({"total": total, "success": trace.metrics["success"]}))

asyncio.run(main())
"""


async def test_verifiers_scores_replies(cluster, dataset):
    peer = Peer(*VERIFIERS_PEER)
    printed = peer.run("-c", VERIFIERS, dataset, EXAMPLES, EMBOMATRIX_MANAGER=cluster[0].address)
    rows = [json.loads(line) for line in printed.splitlines()]
    assert [each["success"] for each in rows] == [1, 1, 1, 0, 0, 0]
    assert all(each["total"] > 30 for each in rows[:3])
    assert [each["total"] for each in rows[3:]] == [-1, -1, -1]


class StreamingModel(ChatServer):
    """Model that says the next of its lines in each conversation, as a stream: the harnesses of verifiers ask for one."""

    lines = ("I look around.", "move 10", "pick_up 10", "move 0", "place 0 ontop", "done")

    def next_answer(self, request):
        turn = sum(message["role"] == "assistant" for message in request["messages"])
        head = {"id": "x", "object": "chat.completion.chunk", "created": 1, "model": "scripted"}
        said = {"role": "assistant", "content": self.lines[turn]}
        usage = {"prompt_tokens": 9, "completion_tokens": 2, "total_tokens": 11}
        chunks = (
            {**head, "choices": [{"index": 0, "delta": said, "finish_reason": None}]},
            {**head, "choices": [{"index": 0, "delta": {}, "finish_reason": "stop"}]},
            {**head, "choices": [], "usage": usage},
        )
        body = "".join(f"data: {json.dumps(chunk)}\n\n" for chunk in chunks)
        return (200, {"content-type": "text/event-stream"}, f"{body}data: [DONE]\n\n", 0.0)


async def test_verifiers_own_command_plays_episodes(cluster, dataset, tmp_path):
    peer = Peer(*VERIFIERS_PEER)
    (block,) = (text for text in snippets("adapters.md", "verifiers", "") if "embomatrix-episodes" in text)
    printed = shlex.split(block.split("vf-eval ")[1])
    assert "search" in printed
    command = [
        str(dataset) if word == "search" else "scripted" if word == "MODEL" else word for word in printed
    ]
    command += ["--no-push", "--select.include.ids", "apple_to_counter", "-o", str(tmp_path)]
    with StreamingModel("").serving() as url:
        await asyncio.to_thread(
            peer.run,
            *("-c", "from verifiers.v1.cli.eval.main import main; main()", *command),
            *("--client.base-url", url),
            PYTHONPATH=os.pathsep.join(map(str, (*ROOTS, EXAMPLES))),
            PATH=f"{peer.folder / 'bin'}:{os.environ['PATH']}",
            EMBOMATRIX_MANAGER=cluster[0].address,
            PRIME_API_KEY="none",
        )
    (line,) = next(tmp_path.glob("*/traces.jsonl")).read_text().splitlines()
    (trace,) = json.loads(line)["traces"]
    assert (trace["errors"], trace["metrics"]) == ([], {"success": 1.0, "calls": 5.0, "failed_calls": 1.0})
    assert sum(reward["score"] for reward in trace["rewards"].values()) > 30


VERL = """
import asyncio, json, sys
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from verl import DataProto
from verl.experimental.reward_loop.reward_manager.naive import NaiveRewardManager
from verl.trainer.ppo.reward import get_custom_reward_fn
from embomatrix.trainer.adapters.rows import verl_rows
from embomatrix.world.dataset import Dataset

class Letters:
    def decode(self, ids, skip_special_tokens):
        return "".join(map(chr, ids.tolist()))

config = OmegaConf.from_dotlist([line.removeprefix("+") for line in sys.argv[2].split()])
records = Dataset.load(sys.argv[1]).train
oracles = {record.task.task_id: json.dumps([dict(call) for call in record.oracle]) for record in records}

def sample(row, text):
    ids = torch.tensor([[ord(letter) for letter in text]])
    batch = TensorDict({"responses": ids, "attention_mask": torch.ones_like(ids)}, batch_size=1)
    names = ("data_source", "reward_model", "extra_info")
    return DataProto.from_dict(dict(batch), non_tensors={name: [row[name]] for name in names})

async def main():
    manager = NaiveRewardManager(config, Letters(), get_custom_reward_fn(config))
    rows = verl_rows(sys.argv[1])
    texts = [oracles[row["reward_model"]["ground_truth"]] for row in rows]
    samples = [sample(row, text) for row, text in zip(rows * 2, texts + ["hm"] * len(rows), strict=True)]
    for scored in await asyncio.gather(*(manager.run_single(each) for each in samples)):
        print(json.dumps({"score": scored["reward_score"], **scored["reward_extra_info"]}))

asyncio.run(main())
"""


VERL_LIBRARIES = (
    *("tensordict", "omegaconf", "hydra-core", "ray", "transformers", "codetiming", "pandas", "datasets"),
    *("cachetools", "uvicorn", "fastapi", "verl==0.9.1"),
)


async def test_verl_s_reward_manager_awaits_the_cluster(cluster, dataset):
    peer = Peer("verl", TORCH, *VERL_LIBRARIES)
    options, _ = snippets("adapters.md", "verl", "")
    options = options.replace("build/dataset", str(dataset))
    printed = peer.run("-c", VERL, dataset, options, EMBOMATRIX_MANAGER=cluster[0].address)
    rows = [json.loads(line) for line in printed.splitlines() if line.startswith("{")]
    assert [each["success"] for each in rows] == [1, 1, 1, 0, 0, 0]
    assert all(each["score"] == each["format"] + each["relevance"] + each["goal"] for each in rows)
    assert [each["score"] for each in rows[3:]] == [-1, -1, -1]


VERL_EPISODES = r"""
import asyncio, json, sys
from hydra.utils import instantiate
from omegaconf import OmegaConf
from tokenizers import Regex, Tokenizer, decoders
from tokenizers.models import WordLevel
from tokenizers.pre_tokenizers import Split
from transformers import PreTrainedTokenizerFast
from verl.experimental.agent_loop.agent_loop import DictConfigWrap
from verl.workers.rollout.replica import TokenOutput
from embomatrix.trainer.adapters.rows import verl_rows

dataset, loops, length = sys.argv[1], sys.argv[2], int(sys.argv[3])
letters = ["<end>", "<unknown>", *map(chr, range(32, 127)), "\n"]
inner = Tokenizer(WordLevel({letter: at for at, letter in enumerate(letters)}, unk_token="<unknown>"))
inner.pre_tokenizer = Split(Regex("[\\s\\S]"), "isolated")
inner.decoder = decoders.Fuse()
tokenizer = PreTrainedTokenizerFast(
    tokenizer_object=inner, eos_token="<end>", pad_token="<end>", unk_token="<unknown>",
    chat_template="{% for m in messages %}{{ m.role }}: {{ m.content }}<end>{% endfor %}"
    "{% if add_generation_prompt %}assistant: {% endif %}",
)
config = OmegaConf.create(
    {"actor_rollout_ref": {"rollout": {"prompt_length": 4000, "response_length": length}}, "data": {}}
)
(loop,) = OmegaConf.load(loops)
loop.dataset = dataset
answers = iter(sys.argv[4:])

class Server:
    asked = []
    async def generate(self, request_id, prompt_ids, sampling_params):
        self.asked.append(list(prompt_ids))
        ids = [*tokenizer.encode(next(answers), add_special_tokens=False), tokenizer.eos_token_id]
        return TokenOutput(token_ids=ids, log_probs=[-0.5] * len(ids))

async def main():
    server = Server()
    player = instantiate(
        loop, trainer_config=DictConfigWrap(config), server_manager=server, tokenizer=tokenizer, processor=None,
        dataset_cls=None, data_config=DictConfigWrap(config.data), hf_model_type="llama",
    )
    (row,) = [row for row in verl_rows(dataset) if row["reward_model"]["ground_truth"] == "apple_to_counter"]
    played = await player.run({}, raw_prompt=row["prompt"], **row)
    ids = [*played.prompt_ids, *played.response_ids]
    own = [token for token, is_own in zip(played.response_ids, played.response_mask) if is_own]
    print(json.dumps({
        "prompt": tokenizer.decode(played.prompt_ids), "own": tokenizer.decode(own), "reward": played.reward_score,
        "info": played.extra_fields["reward_extra_info"], "turns": played.num_turns,
        "appended": all(ids[:len(asked)] == asked for asked in server.asked if len(asked) <= len(ids)),
        "lengths": [len(played.response_ids), len(played.response_mask), len(played.response_logprobs)],
    }))

asyncio.run(main())
"""
ANSWERS = ("I look around.", "move 10", "pick_up 10", "move 0", "place 0 ontop", "done")


def played_by_verl(cluster, dataset, length):
    """Return what verl's agent loop makes of an episode with the answers and room for so many tokens."""
    peer = Peer("verl", TORCH, *VERL_LIBRARIES)
    arguments = (dataset, EXAMPLES / "verl_episodes.yaml", length, *ANSWERS)
    printed = peer.run("-c", VERL_EPISODES, *arguments, EMBOMATRIX_MANAGER=cluster[0].address)
    return json.loads(printed.splitlines()[-1])


async def test_verl_s_agent_loop_plays_an_episode(cluster, dataset):
    played = await asyncio.to_thread(played_by_verl, cluster, dataset, 4000)
    assert "system: You control a home robot step by step." in played["prompt"]
    assert played["own"] == "".join(f"{answer}<end>" for answer in ANSWERS)
    assert played["appended"]
    assert (played["turns"], len({*played["lengths"]})) == (12, 1)
    assert played["reward"] > 30
    assert played["reward"] == pytest.approx(
        sum(played["info"][tier] for tier in ("format", "relevance", "goal"))
    )
    assert {name: played["info"][name] for name in ("success", "calls", "failed_calls")} == {
        "success": 1.0,
        "calls": 5.0,
        "failed_calls": 1.0,
    }


async def test_verl_s_agent_loop_ends_where_the_response_has_no_room(cluster, dataset):
    played = await asyncio.to_thread(played_by_verl, cluster, dataset, 200)
    assert played["lengths"] == [200, 200, 200]
    assert played["appended"]
    assert played["info"]["success"] == 0.0
    assert played["own"].startswith("I look around.<end>")
