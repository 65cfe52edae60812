"""Shared fixtures of the trainer's tests."""

import resource
import signal
from contextlib import contextmanager

import pytest
import torch


@pytest.fixture(autouse=True)
def one_thread():
    """What is compared to the bit is computed by one thread; several are no faster on networks of a test's size."""
    torch.set_num_threads(1)


@pytest.fixture
def small_files():
    """For a while the kernel refuses to write files larger than so many bytes, as a full disk refuses to write."""

    @contextmanager
    def limited(most_bytes):
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
            signal.signal(signal.SIGXFSZ, handler)

    return limited
