"""Evaluations on a cluster write the same bytes as local evaluations."""

import pytest
from tests.fakes.commands import run
from tests.fakes.waiting import until_listening

from embomatrix.cli.local_cluster import local_cluster

FILES = ("report.json", "report.html", "report.txt")


@pytest.mark.slow
def test_cluster_and_local_processes_give_the_same_report(kitchen, tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    asked = ("eval", f"--bench={kitchen}", "--split=all", "--baseline=random", "--samples=5")
    result = run(*asked, f"--out={here}", "--jobs=1")
    assert result.status == 0, result.text
    cluster = local_cluster(tmp_path / "cluster", workers=1, slots=1)
    with cluster.supervisor:
        until_listening(cluster.address)
        result = run(
            "eval", f"--answers={here / 'answers.jsonl'}", f"--manager={cluster.address}", f"--out={there}"
        )
    assert result.status == 0, result.text
    assert [(here / name).read_bytes() for name in FILES] == [(there / name).read_bytes() for name in FILES]
