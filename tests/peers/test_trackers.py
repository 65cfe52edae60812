"""Weights & Biases and trackio offline: they receive a run's metrics."""

import sqlite3

import pytest
from tests.fakes.peers import Peer

pytestmark = [pytest.mark.peers, pytest.mark.timeout(900)]
TELL = """
import sys
from pathlib import Path
from embomatrix.trainer.imitation.teacher_forcing import ImitationProgress
from embomatrix.trainer.logging.recorder import Recorder
from embomatrix.trainer.config.settings import read_settings
from embomatrix.trainer.logging.trackers import trackers_of
folder, step = Path(sys.argv[1]), int(sys.argv[2])
with trackers_of(read_settings(None, {"track": ["wandb", "trackio"]}), folder) as trackers:
    Recorder(folder, trackers).imitation(ImitationProgress(step, 0.5, 3.0))
"""


def test_resumed_run_is_one_wandb_run_and_trackio_has_every_step(tmp_path):
    peer = Peer("trackers", "torch==2.13.0", "wandb==0.31.0", "trackio==0.43.0")
    run = tmp_path / "run"
    run.mkdir()
    for step in (1, 2):
        peer.run("-c", TELL, run, step, WANDB_MODE="offline", TRACKIO_DIR=str(tmp_path / "trackio"))
    written = [folder.name for folder in (run / "wandb").glob("offline-run-*")]
    assert {name.rpartition("-")[2] for name in written} == {(run / "wandb-id.txt").read_text()}
    (kept,) = (tmp_path / "trackio").glob("*.db")
    with sqlite3.connect(kept) as database:
        rows = database.execute("select metrics from metrics").fetchall()
    assert [
        f'"imitation/step":{step}' in row[0].decode() for step, row in zip((1, 2), rows, strict=True)
    ] == [True, True]
