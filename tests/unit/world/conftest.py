"""A kitchen with a fridge and an apple, small enough to break in every place."""

import pytest
from tests.fakes.tiny_scene import tiny_bundle, tiny_scene, tiny_task

from embomatrix.world.bundle import Bundle
from embomatrix.world.scene import Scene
from embomatrix.world.task import Task


@pytest.fixture
def scene() -> Scene:
    return tiny_scene()


@pytest.fixture
def task() -> Task:
    return tiny_task()


@pytest.fixture
def bundle() -> Bundle:
    return tiny_bundle()
