"""Settings shared by all tests: import path, profiles of the property tests, logging."""

import logging
import os
import signal
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from embomatrix.rpc import logs

ROOT = str(Path(__file__).resolve().parents[1])
if ROOT not in sys.path:
    sys.path.insert(0, ROOT)

# The default suite draws the same inputs in every run: a red run then points at a change, never at luck. An input that
# once failed is kept beside its test as an ``@example``. ``HYPOTHESIS_PROFILE=random`` searches anew (`make test-random`).
# No profile has deadlines: a busy machine says nothing about the code.
_UNTIMED = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("default", derandomize=True, **_UNTIMED)
settings.register_profile("random", derandomize=False, print_blob=True, **_UNTIMED)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))

# A script that starts the tests in the background makes them ignore Ctrl-C, which some of them send to themselves.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _reset_logging():
    """Remove the log handlers, hidden words and bound ids that a test left, so that later tests don't depend on them."""
    yield from _as_before()
    root = logging.getLogger()
    for handler in root.handlers[:]:
        if not type(handler).__module__.startswith("_pytest"):
            root.removeHandler(handler)
    logging.getLogger("embomatrix").setLevel(logging.NOTSET)


@pytest.fixture(scope="module", autouse=True)
def _reset_logging_of_module():
    """Remove the hidden words and bound ids of fixtures that several tests share."""
    yield from _as_before()


def _as_before():
    hidden, bound = set(logs._hidden), logs._bound.get()
    yield
    logs._hidden.clear()
    logs._hidden.update(hidden)
    logs._bound.set(bound)
