"""`embomatrix bench trainer`: one load for two trainers, and one sentence for each refusal."""

import sys
from dataclasses import asdict, replace
from types import SimpleNamespace

import pytest
import torch
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.symbolic_household import make_tasks
from typer.testing import CliRunner

from embomatrix.bench.cli import app
from embomatrix.bench.report.figures import BenchError
from embomatrix.bench.trainer.gpu import changed_share, gpu_load
from embomatrix.bench.trainer.measure import measure_steps, shares_of
from embomatrix.bench.trainer.steps import load_of, own_step_s, parse_step_s, policy_of
from embomatrix.bench.trainer.trl_steps import model_of

TASKS = make_tasks(3, 0, objects=6).train
SMALL = {
    "tasks": 2,
    "group": 3,
    "new": 4,
    "steps": 2,
    "layers": 1,
    "width": 32,
    "heads": 2,
    "key_value_heads": 2,
    "inner": 32,
}


def test_load_knows_every_word_of_its_prompts():
    load = load_of(TASKS)
    assert {word for prompt in load.prompts for word in prompt.split()} <= set(load.words)


def test_our_steps_use_the_prompts_of_the_load():
    pytest.importorskip("transformers")
    load = replace(load_of(TASKS), **SMALL)
    assert len(own_step_s(load, TASKS)) == 2
    policy = policy_of(load)
    words = [load.words[token] for token in policy.encode_plan(load.prompts[0])[:-1]]
    assert words == load.prompts[0].split()


def test_load_of_a_gpu_has_one_and_a_half_billion_weights_and_names_each_word_once():
    pytest.importorskip("transformers")
    load = gpu_load(TASKS)
    assert len(set(load.words)) == len(load.words) == 151_936
    with torch.device("meta"):
        model = model_of(asdict(load))
    assert sum(parameter.numel() for parameter in model.parameters()) == pytest.approx(1.54e9, rel=0.01)


def test_changed_share_counts_weights():
    policy = SimpleNamespace(parameters=lambda: [torch.tensor([1.0, 2.0]), torch.tensor([3.0, 4.0])])
    before = [torch.tensor([1.0, 2.5]), torch.tensor([3.0, 4.0])]
    assert changed_share(before, policy) == 0.25


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_missing_gpu_is_one_sentence():
    pytest.importorskip("transformers")
    result = CliRunner().invoke(app, ["trainer", "--gpu"])
    assert result.exit_code == 2
    assert "torch finds no GPU here" in " ".join(result.output.split())


@pytest.mark.parametrize("output", ["", "no json", "[]", '{"step_s": null}'])
def test_program_without_step_times_is_one_sentence(output):
    with pytest.raises(BenchError, match="printed no step times"):
        parse_step_s(output)


def test_step_times_are_read_from_the_last_line():
    assert parse_step_s('a warning\n{"step_s": [1.5, 2]}\n') == [1.5, 2.0]


def test_shares_are_of_the_given_steps_and_the_time_since_earlier_ones():
    def record(seconds, sampling, update, waiting):
        spent_s = {"sampling": sampling, "update": update, "waiting for simulation": waiting}
        return {"seconds": seconds, "spent_s": spent_s}

    steps = [record(4.0, 1.0, 1.0, 2.0), record(2.0, 2.0, 1.5, 2.2), record(2.0, 3.0, 2.0, 2.4)]
    first, later = shares_of(steps[:1], {}), shares_of(steps[1:], steps[0]["spent_s"])
    assert (first.seconds, first.waiting, first.overhead) == (4.0, 0.5, 0.5)
    assert later.seconds == 4.0
    assert (later.waiting, later.overhead) == pytest.approx((0.1, 0.25))


def test_missing_dataset_is_one_sentence():
    result = CliRunner().invoke(app, ["trainer", "--dataset=nowhere"])
    assert result.exit_code == 2
    assert "there is no dataset in nowhere" in " ".join(result.output.split())


@pytest.mark.slow
def test_steps_are_compared_with_those_of_the_named_interpreter(tmp_path):
    pytest.importorskip("transformers")
    folder = write_kitchen_dataset(tmp_path / "kitchen")
    stand_in = tmp_path / "python"
    stand_in.write_text(f"#!{sys.executable}\nprint('{{\"step_s\": [1000.0]}}')\n")
    stand_in.chmod(0o755)
    figures = measure_steps(folder, stand_in, tmp_path, lambda _: None)
    found = {figure.name: figure for figure in figures}
    assert found["grpo_step_vs_trl"].value == pytest.approx(1000.0 / found["grpo_step_cpu_s"].value)
