"""Fixtures of the unit tests of this package."""

from tests.unit.factory.conftest import flat, home  # noqa: F401
