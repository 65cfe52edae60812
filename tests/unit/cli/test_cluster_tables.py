"""Tables in a narrow terminal."""

import pytest

from embomatrix.cli.cluster.tables import plan_table, run_table, show, worker_table
from embomatrix.rpc.wire.values import PlanCell, Resources, RunInfo, RunStats, Warmth, WorkerInfo

STATS = RunStats(1_234_567, 12, 345, 6, prewarm_hits=1999, prewarm_misses=2, prewarm_wasted=7)
WORKER = "a-worker-with-a-name-as-long-as-names-of-machines-get.example"


@pytest.fixture(params=["40", "80", "300"])
def terminal(request, monkeypatch):
    monkeypatch.setenv("COLUMNS", request.param)


@pytest.mark.usefixtures("terminal")
def test_tables_cut_no_figure_and_no_name(capsys):
    show(run_table([RunInfo("run-0123456789ab", "an evening's run", STATS, 65_536, 1.0, 0.0)]))
    reason = "paused: its owner is at the keyboard, and the machine runs on battery besides"
    show(
        worker_table([WorkerInfo(WORKER, "paused", Resources(64, 64, 262_144), (), 3, 99_999, 12.3, reason)])
    )
    show(
        plan_table([PlanCell("run-0123456789ab", 4_321, "sha256:0123456789", 512, Warmth.WARMING, (WORKER,))])
    )
    output = capsys.readouterr().out
    assert "…" not in output
    words = output.split()
    for figure in (
        "1234567",
        "65536",
        "345",
        "1999/2001",
        "262144",
        "99999",
        "12.3",
        "4321",
        WORKER,
    ):
        assert figure in words
    assert "besides" in words
    assert f"01234567·512·warming@{WORKER}" in "".join(words)
