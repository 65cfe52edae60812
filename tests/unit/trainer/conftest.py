"""Shared fixtures of the trainer's tests."""

import resource
import signal
from contextlib import contextmanager

import pytest
import torch


@pytest.fixture(autouse=True)
def one_thread():
    """Use one thread: bit comparisons need it, and more are no faster on networks of this size."""
    torch.set_num_threads(1)


@pytest.fixture
def small_files():
    """Make the kernel refuse files above a size, like a full disk."""

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
