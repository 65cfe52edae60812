"""Files of a run stay consistent: repeated steps and truncated lines are dropped."""

import json

import pytest

from embomatrix.trainer.config.errors import TrainerError, reason_of
from embomatrix.trainer.lifecycle.checkpoint import atomic_folder
from embomatrix.trainer.logging.recorder import METRICS, SAMPLES, Recorder, read_metrics


def test_steps_after_the_checkpoint_and_truncated_lines_are_dropped(tmp_path):
    lines = [json.dumps({"step": step}) for step in (1, 2, 3)]
    for name in (METRICS, SAMPLES):
        (tmp_path / name).write_text("\n".join([*lines, '{"step": 1, "rew']))
    Recorder(tmp_path).forget_after(2, METRICS, SAMPLES)
    assert read_metrics(tmp_path) == [{"step": 1}, {"step": 2}]
    assert (tmp_path / SAMPLES).read_text() == (tmp_path / METRICS).read_text()


def test_atomic_folder_appears_when_complete(tmp_path):
    with atomic_folder(tmp_path / "final") as partial:
        (partial / "a").write_text("1")
        assert not (tmp_path / "final").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["final"]


def test_failed_atomic_folder_keeps_the_old_one(tmp_path):
    with atomic_folder(tmp_path / "final") as partial:
        (partial / "a").write_text("1")
    refused = pytest.raises(TrainerError, match=r"final can't be written \(no room\)")
    with refused, atomic_folder(tmp_path / "final"):
        raise RuntimeError("no room. And then an essay.\nWith a trace.")
    assert (tmp_path / "final" / "a").read_text() == "1"
    assert [path.name for path in tmp_path.iterdir()] == ["final"]


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (OSError(28, "No space left on device", "/a"), "No space left on device"),
        (RuntimeError("first sentence. Second.\nthird"), "first sentence"),
        (ValueError(), "ValueError"),
    ],
)
def test_reason_is_short(error, reason):
    assert reason_of(error) == reason
