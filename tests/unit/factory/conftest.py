"""One furnished scene for all tests of this folder: building it takes a second."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from embomatrix.factory.scenes.build import build_base_scene

if TYPE_CHECKING:
    from embomatrix.world.scene import Scene


@pytest.fixture(scope="session")
def flat() -> Scene:
    """Rs_int: five rooms, the smallest of the base scenes."""
    return build_base_scene("Rs_int", seed=0)
