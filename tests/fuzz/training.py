"""Decoders of the trainer: settings, checkpoints, answers, reports and texts of models."""

from __future__ import annotations

import functools
import io
import json
import random
from dataclasses import asdict, replace
from pathlib import Path

import msgspec
import torch
from tests.fuzz.decoder import Decoder, in_file, mutate_bytes, mutate_json, mutate_json_lines, text_of

from embomatrix.cli.evaluate import read_eval_settings
from embomatrix.rpc.traffic import SubmittedGroup, TrafficError, read_traffic
from embomatrix.trainer.commands.eai import _read as read_eai_answers
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import ServerKind, TrainSettings, read_settings
from embomatrix.trainer.eai.sanitise import sanitise_answer
from embomatrix.trainer.episodes.oracle import read_episodes
from embomatrix.trainer.evaluation.answers import Answer, EvaluationSetup
from embomatrix.trainer.evaluation.answers import _read as read_answers
from embomatrix.trainer.evaluation.benchmark import IMPORT_REPORT, _rejected
from embomatrix.trainer.evaluation.episodes import _texts
from embomatrix.trainer.evaluation.table import read_row
from embomatrix.trainer.lifecycle.checkpoint import SCHEMA, TrainingProgress, read_state, restore
from embomatrix.trainer.logging.outcome import OUTCOME, RunOutcome, TaskRate, read_outcome, write_outcome
from embomatrix.trainer.logging.recorder import METRICS, Recorder
from embomatrix.trainer.policy.decoder import DecoderShape
from embomatrix.trainer.policy.hf import CODEC_KEY, CONFIG, HfPolicy
from embomatrix.trainer.policy.loading import saved_policy
from embomatrix.trainer.policy.tiny import TinyPolicy
from embomatrix.trainer.policy.vocabulary import build_vocabulary
from embomatrix.trainer.serving.forms import (
    FORMS,
    AbortedError,
    AnswerError,
    OldWeightsError,
    PlanRequest,
    Weights,
)
from embomatrix.trainer.serving.server import served_models

_FOLDER = Path("weights")
_ADAPTERS = Weights("run-1", _FOLDER, are_adapters=True)
_WANTED = PlanRequest(((1, 2),), 1, 1.0, 4, (2,), 0)
_COMPLETIONS = (
    b'{"choices": [{"index": 0, "text": "a", "finish_reason": "stop", "token_ids": [4, 2], "logprobs": {"tokens":'
    b' ["token_id:4", "token_id:2"], "token_logprobs": [-0.5, -0.25]}}]}'
)
_GENERATIONS = (
    b'[{"text": "a", "meta_info": {"finish_reason": {"type": "stop", "matched": 2}, "weight_version": "run-1",'
    b' "output_token_logprobs": [[-0.5, 4, null], [-0.25, 2, null]]}}]'
)
TRAIN_TOML = b"""model = "tiny"
seed = 3
[tiny]
layers = 2
[lora]
rank = 0
"""


def _train_settings(data: bytes) -> object:
    return read_settings(in_file("train.toml", data), {})


def _eval_settings(data: bytes) -> object:
    return read_eval_settings(in_file("eval.toml", data), {})


def _state(data: bytes) -> object:
    return read_state(in_file("checkpoint/state.json", data).parent)


def _traffic(data: bytes) -> object:
    return [group.rollouts() for group in read_traffic([data])]


def _traffic_line() -> bytes:
    return msgspec.json.encode(
        SubmittedGroup("step-1-0/0", 1, 0.5, "sha256:1", "t", 7, ("move 1\npick_up 1", "move 2"), (0, 1, 0))
    )


def _tensors(data: bytes) -> object:
    return restore(in_file("checkpoint/training.pt", data).parent, dict)


def _saved(tensors: dict[str, torch.Tensor]) -> bytes:
    file = io.BytesIO()
    torch.save(tensors, file)
    return file.getvalue()


@functools.cache
def _small_policy() -> tuple[bytes, bytes]:
    """Return the description and the weights of a small policy."""
    vocabulary = build_vocabulary((), ())
    policy = TinyPolicy(vocabulary, DecoderShape(len(vocabulary), 1, 8, 2, 8, 16), seed=0)
    folder = in_file("small/x", b"").parent
    policy.save(folder)
    return (folder / "tiny.json").read_bytes(), (folder / "weights.pt").read_bytes()


def _tiny(data: bytes) -> object:
    """Load a small policy with this description."""
    folder = in_file("policy/tiny.json", data).parent
    in_file("policy/weights.pt", _small_policy()[1])
    return saved_policy(folder, TrainSettings())


def _codec(data: bytes) -> object:
    return HfPolicy.codec_in(in_file(f"hf/{CONFIG}", data).parent)


def _answers(data: bytes) -> object:
    return read_answers(in_file("answers.jsonl", data))


def _episode_texts(data: bytes) -> object:
    return _texts(Answer("t", 0, text_of(data)))


def _report_row(data: bytes) -> object:
    return read_row(in_file("report.json", data), "sha256:0")


def _import_report(data: bytes) -> object:
    return _rejected(in_file(f"import/{IMPORT_REPORT}", data).parent)


def _oracle_episodes(data: bytes) -> object:
    return read_episodes(in_file("run/oracle_episodes.json", data), {"seed": 0})


def _outcome(data: bytes) -> object:
    folder = in_file(f"run/{OUTCOME}", data).parent
    found = read_outcome(folder)
    write_outcome(folder, found)
    return found.shares


def _metrics(data: bytes) -> object:
    """Resume a run whose metrics end in a damaged line."""
    path = in_file(f"run/{METRICS}", data)
    recorder = Recorder(path.parent)
    recorder.forget_after(3, METRICS)
    return path.read_bytes()


def _eai_answers(data: bytes) -> object:
    return read_eai_answers(in_file("eai.json", data))


def _eai_text(data: bytes) -> object:
    text = sanitise_answer(text_of(data))
    assert text.isascii()
    return text


def _state_text() -> bytes:
    progress, settings = asdict(TrainingProgress()), TrainSettings().model_dump(mode="json")
    return json.dumps({"schema": SCHEMA, "progress": progress, "settings": settings}).encode()


def _outcome_text() -> bytes:
    rate = TaskRate("t", "pick_and_place", 0.5)
    folder = in_file("run/x", b"").parent
    write_outcome(folder, RunOutcome("tiny", 1, 1, 8, 0, 1.0, 0.5, {"sampling": 0.2}, (rate,), (rate,)))
    return (folder / OUTCOME).read_bytes()


def _answer_lines() -> bytes:
    setup = EvaluationSetup("bench", "sha256:0", "train", 1, "model", "names", 60, 1, 0.0, 100, 0)
    lines = ({"answers": 1, **asdict(setup)}, asdict(Answer("t", 0, "move 0", "stop", 3, 2)))
    return b"".join(json.dumps(line).encode() + b"\n" for line in lines)


REPORT = (
    b'{"report": 1, "setup": {"model": "m", "bench_digest": "sha256:0"}, "overall": {"success": {"value": 0.5, "low": 0.1,'
    b' "high": 0.9}}, "categories": {}}'
)


def _mutate_zip(data: bytes, rng: random.Random) -> bytes:
    """Change bytes, but keep the end of the archive, without which nothing else is read."""
    return mutate_bytes(data[:-200], rng) + data[-200:] if rng.random() < 0.7 else mutate_bytes(data, rng)


def table() -> dict[str, Decoder]:
    """Return the decoders of this module by name."""
    tensors = _saved({"a": torch.zeros(2, 3), "b": torch.tensor(1.0, dtype=torch.bfloat16)})
    return {
        "training settings": Decoder(
            _train_settings,
            (TrainerError,),
            lambda: (TRAIN_TOML,),
            frozenset({"trainer.config.settings:read_toml", "trainer.config.settings:checked_settings"}),
            mutate_bytes,
        ),
        "evaluation settings": Decoder(
            _eval_settings,
            (TrainerError,),
            lambda: (b"samples = 2\ntemperature = 0.5\n",),
            frozenset({"trainer.config.settings:read_toml", "cli.evaluate:read_eval_settings"}),
            mutate_bytes,
        ),
        "recorded traffic": Decoder(
            _traffic,
            (TrafficError,),
            lambda: (_traffic_line(),),
            frozenset(),
            mutate_json,
        ),
        "state of a checkpoint": Decoder(
            _state,
            (TrainerError,),
            lambda: (_state_text(),),
            frozenset({"trainer.lifecycle.checkpoint:read_state"}),
            mutate_json,
        ),
        "tensors of a checkpoint": Decoder(
            _tensors,
            (TrainerError,),
            lambda: (tensors,),
            frozenset({"trainer.policy.tensor_file:read_tensors"}),
            _mutate_zip,
        ),
        "word-level policy": Decoder(
            _tiny,
            (TrainerError,),
            lambda: (_small_policy()[0],),
            frozenset({"trainer.policy.tiny:TinyPolicy.described_in"}),
            mutate_json,
        ),
        "codec of a model": Decoder(
            _codec,
            (),
            lambda: (json.dumps({CODEC_KEY: "names"}).encode(),),
            frozenset({"trainer.policy.hf:HfPolicy.codec_in"}),
            mutate_json,
        ),
        "answers of an evaluation": Decoder(
            _answers,
            (TrainerError,),
            lambda: (_answer_lines(),),
            frozenset({"trainer.evaluation.answers:_read", "trainer.evaluation.answers:_validate"}),
            mutate_json_lines,
        ),
        "answers of an episode": Decoder(
            _episode_texts,
            (TrainerError,),
            lambda: (b'["move 3", "done"]', b"[" * 9_000, b"[1]"),
            frozenset({"trainer.evaluation.episodes:_texts"}),
            mutate_json,
        ),
        "row of a report": Decoder(
            _report_row,
            (TrainerError,),
            lambda: (REPORT,),
            frozenset({"trainer.evaluation.table:read_row"}),
            mutate_json,
        ),
        "import report": Decoder(
            _import_report,
            (TrainerError,),
            lambda: (b'{"outcomes": [{"name": "a", "reason": ""}, {"name": "b", "reason": "no_scene"}]}',),
            frozenset({"trainer.evaluation.benchmark:_rejected"}),
            mutate_json,
        ),
        "episodes of the oracle": Decoder(
            _oracle_episodes,
            (TrainerError,),
            lambda: (
                b'{"version": {"seed": 0, "format": 2, "file": 3}, "systems": [""], "episodes": {"task": [0, "room '
                b'kitchen_0", 1, ["open fridge", "did"], ["done", "robot"]]}}',
            ),
            frozenset({"trainer.episodes.oracle:read_episodes"}),
            mutate_json,
        ),
        "outcome of a run": Decoder(
            _outcome,
            (TrainerError,),
            lambda: (_outcome_text(),),
            frozenset({"trainer.logging.outcome:read_outcome"}),
            mutate_json,
        ),
        "metrics of a run": Decoder(
            _metrics,
            (),
            lambda: (b'{"step": 1}\n{"step": 4}\n{"step": 2', b"1\n[]\n{}\n"),
            frozenset({"trainer.logging.recorder:_step_of"}),
            mutate_json_lines,
        ),
        "plans of vLLM": Decoder(
            lambda data: FORMS[ServerKind.VLLM].plans(data, _WANTED, _ADAPTERS),
            (AnswerError, AbortedError),
            lambda: (_COMPLETIONS, _COMPLETIONS.replace(b'"token_ids": [4, 2], ', b"")),
            frozenset({"trainer.serving.forms:VllmForm.plans"}),
            mutate_json,
        ),
        "plans of SGLang": Decoder(
            lambda data: FORMS[ServerKind.SGLANG].plans(
                data, _WANTED, replace(_ADAPTERS, are_adapters=False)
            ),
            (AnswerError, AbortedError, OldWeightsError),
            lambda: (_GENERATIONS,),
            frozenset({"trainer.serving.forms:SglangForm.plans"}),
            mutate_json,
        ),
        "models of a model server": Decoder(
            served_models,
            (ValueError,),
            lambda: (b'{"data": [{"id": "m", "max_model_len": 2048, "parent": null}]}',),
            frozenset({"trainer.serving.server:served_models"}),
            mutate_json,
        ),
        "answers for EAI": Decoder(
            _eai_answers,
            (TrainerError,),
            lambda: (b'[{"identifier": "a", "llm_output": "[]"}]',),
            frozenset({"trainer.commands.eai:_read"}),
            mutate_json,
        ),
        "text for EAI": Decoder(
            _eai_text,
            (),
            lambda: (
                b'[{"action": "OPEN", "object": "fridge_1"}]',
                b"I think [1] </think> [{'action': 'OPEN', 'object': 'a\"b'},]",
                b"[" * 300 + b"-" * 3_000 + b"1]",
            ),
            frozenset({"trainer.eai.sanitise:_lists", "trainer.eai.sanitise:_literal"}),
            mutate_bytes,
        ),
    }
