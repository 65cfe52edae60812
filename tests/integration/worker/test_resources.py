"""Resources of a machine and settings that override them."""

import os

import pytest
from pydantic import ValidationError

from embomatrix.worker.host.gpu import Gpu, find_gpu
from embomatrix.worker.host.resources import fingerprint, measure
from embomatrix.worker.host.settings import WorkerSettings


def test_resources_are_all_cores_and_a_share_of_the_memory():
    resources = measure(WorkerSettings())
    assert resources.slots == resources.cores == len(os.sched_getaffinity(0))
    assert resources.memory_mb > 0
    assert resources.score > 0
    assert set(resources.versions) == {"embomatrix", "python", "pybullet", "numpy", "platform"}


def test_settings_take_precedence_over_measurements():
    resources = measure(WorkerSettings(slots=3, memory_mb=77))
    assert (resources.slots, resources.memory_mb) == (3, 77)


def test_platform_fingerprint_is_stable():
    assert fingerprint() == fingerprint()
    assert len(fingerprint()) == 16


def test_gpu_is_found_by_nvidia_smi(tmp_path, monkeypatch):
    program = tmp_path / "nvidia-smi"
    program.write_text("#!/bin/sh\necho 'NVIDIA H200, 143771'\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    assert find_gpu() == Gpu("NVIDIA H200", 143771)


def test_failing_nvidia_smi_means_no_gpu(tmp_path, monkeypatch):
    program = tmp_path / "nvidia-smi"
    program.write_text("#!/bin/sh\necho 'driver mismatch'\nexit 9\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    assert find_gpu() == Gpu()


def test_slots_render_only_where_a_gpu_has_memory_for_them():
    assert Gpu().render_slots(8) == 0
    assert Gpu("A", 1024).render_slots(8) == 0
    assert Gpu("A", 8192).render_slots(8) == 4
    assert Gpu("A", 80_000).render_slots(8) == 8


def test_machine_without_a_gpu_driver_has_no_gpu(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert find_gpu() == Gpu()


def test_resources_include_labels_and_free_disk(tmp_path):
    resources = measure(WorkerSettings(cache_dir=tmp_path / "cache", labels={"room": "attic"}))
    assert resources.labels == {"room": "attic"}
    assert resources.disk_mb > 0


def test_two_workers_of_one_host_get_different_names():
    assert WorkerSettings().name != WorkerSettings().name


@pytest.mark.parametrize(
    "wrong", [{"manager": "nowhere"}, {"slots": -1}, {"name": "a b"}, {"nice": 20}, {"slotz": 1}]
)
def test_invalid_setting_is_refused(wrong):
    with pytest.raises(ValidationError):
        WorkerSettings(**wrong)


def test_token_is_not_shown():
    assert "secret" not in repr(WorkerSettings(token="secret"))
