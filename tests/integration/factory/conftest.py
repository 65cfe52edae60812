"""Scenes of the factory's unit tests, for the integration tests of this folder."""

from tests.unit.factory.conftest import flat, home  # noqa: F401
