"""Two furnished scenes for all tests of this folder: building one takes a second."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from tests.fakes.scenes import kitchen_scene

from embomatrix.factory.scenes.build import build_base_scene

if TYPE_CHECKING:
    from embomatrix.world.scene import Scene


@pytest.fixture(scope="session")
def flat() -> Scene:
    """Rs_int: five rooms, the smallest of the base scenes."""
    return build_base_scene("Rs_int", seed=0)


@pytest.fixture(scope="session")
def home() -> Scene:
    """A small flat with a kitchen."""
    return kitchen_scene()
