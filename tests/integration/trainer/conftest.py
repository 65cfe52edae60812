"""Fixtures of the unit tests of this package."""

from tests.unit.trainer.conftest import one_thread, small_files  # noqa: F401
