"""Make the repository's root importable: tests import their fakes as ``from tests.fakes.scenes import kitchen_scene``."""

import logging
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

ROOT = str(Path(__file__).resolve().parents[1])
if ROOT not in sys.path:
    sys.path.insert(0, ROOT)

# No test is timed: a busy machine that draws inputs slowly says nothing about the code.
settings.register_profile("shared", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("shared")


@pytest.fixture(autouse=True)
def _logs_stay_with_their_test():
    """A command that a test runs in this process says where logs go: what a later test reads shall not hold them."""
    yield
    root = logging.getLogger()
    for handler in root.handlers[:]:
        if not type(handler).__module__.startswith("_pytest"):
            root.removeHandler(handler)
    logging.getLogger("embomatrix").setLevel(logging.NOTSET)
