"""Experiment trackers receive the metrics, named by phase."""

import importlib.util

import pytest

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import read_settings
from embomatrix.trainer.imitation.teacher_forcing import ImitationProgress
from embomatrix.trainer.logging.recorder import Recorder, numbers_of
from embomatrix.trainer.logging.trackers import trackers_of


def test_tensorboard_receives_the_recorded_metrics(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    settings = read_settings(None, {"track": ["tensorboard"]})
    with trackers_of(settings, tmp_path) as trackers:
        recorder = Recorder(tmp_path, trackers)
        recorder.imitation(ImitationProgress(1, 0.1, 3.0))
        recorder.imitation(ImitationProgress(2, 0.2, 2.5, validation=2.75))
    drawn = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(event.step, event.value) for event in drawn.Scalars("imitation/loss")] == [(1, 3.0), (2, 2.5)]
    assert [(event.step, event.value) for event in drawn.Scalars("imitation/validation")] == [(2, 2.75)]


def test_nested_values_are_named_by_their_path():
    row = {"step": 1, "reward": 2.5, "success_by_category": {"compound": 0.5}, "validation": None}
    assert dict(numbers_of(row)) == {"step": 1, "reward": 2.5, "success_by_category/compound": 0.5}


@pytest.mark.skipif(importlib.util.find_spec("trackio") is not None, reason="trackio is installed")
def test_missing_tracker_package_is_reported(tmp_path):
    refused = pytest.raises(TrainerError, match="pip install trackio")
    with refused, trackers_of(read_settings(None, {"track": ["trackio"]}), tmp_path):
        pass


def test_unknown_tracker_is_rejected():
    with pytest.raises(TrainerError, match="track"):
        read_settings(None, {"track": ["paper"]})
