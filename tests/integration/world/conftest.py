"""Fixtures of the unit tests of this package."""

from tests.unit.world.conftest import bundle, scene, task  # noqa: F401
