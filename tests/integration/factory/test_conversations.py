"""Solved episodes as chats: every answer, played again, gets the observation that follows it."""

import json

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from typer.testing import CliRunner

from embomatrix.envs import EpisodeEnd, EpisodeRules, Visibility, make
from embomatrix.factory.commands.app import app


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory):
    return write_kitchen_dataset(tmp_path_factory.mktemp("kitchen"))


def written(kitchen, out, *options):
    arguments = ["conversations", f"--dataset={kitchen}", f"--out={out}", "--jobs=1", *options]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.parametrize("visibility", Visibility)
@pytest.mark.parametrize("codec", ["lines", "json"])
def test_conversations_are_episodes(kitchen, tmp_path, visibility, codec):
    out = tmp_path / "talks.jsonl"
    printed = written(kitchen, out, "--split=heldout", f"--visibility={visibility}", f"--codec={codec}")
    rows = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
    assert f"{len(rows)} of " in printed
    with make(kitchen, rules=EpisodeRules(visibility), codec=codec) as environment:
        assert [row["task_id"] for row in rows] == list(environment.task_ids)
        for row in rows:
            system, *turns = row["messages"]
            told, said = turns[::2], turns[1::2]
            prompt = environment.reset(row["task_id"], seed=0)
            assert (system, told[0]) == (
                {"role": "system", "content": prompt.system},
                {"role": "user", "content": prompt.user},
            )
            observations = [environment.step(message["content"]) for message in said]
            assert [each.text for each in observations[:-1]] == [message["content"] for message in told[1:]]
            assert {message["role"] for message in said} == {"assistant"}
            assert observations[-1].end is EpisodeEnd.DONE
            assert observations[-1].reward.tiers.success
            assert row["calls"] == len(said) - 1


def test_parquet_is_read_by_pyarrow_alone(kitchen, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    lines, table = tmp_path / "talks.jsonl", tmp_path / "talks.parquet"
    for out in (lines, table):
        written(kitchen, out, "--split=heldout")
    assert parquet.read_table(table).to_pylist() == [
        json.loads(line) for line in lines.read_text(encoding="utf-8").splitlines()
    ]


def test_other_tasks_tell_where_things_usually_are(kitchen, tmp_path):
    own, other = tmp_path / "own.jsonl", tmp_path / "other.jsonl"
    written(kitchen, own, "--split=heldout")
    written(kitchen, other, "--split=heldout", f"--training={kitchen}")
    assert own.read_bytes() == other.read_bytes()
    arguments = [
        "conversations",
        f"--dataset={kitchen}",
        f"--out={tmp_path / 'third.jsonl'}",
        "--training=nowhere",
    ]
    refused = CliRunner().invoke(app, arguments)
    assert refused.exit_code == 2
    assert "nowhere" in refused.output
    assert not (tmp_path / "third.jsonl").exists()
