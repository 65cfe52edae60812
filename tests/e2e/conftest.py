"""What the commands under test work on: one small dataset."""

import pytest
from tests.fakes.datasets import write_kitchen_dataset


@pytest.fixture(scope="session")
def kitchen(tmp_path_factory):
    return write_kitchen_dataset(tmp_path_factory.mktemp("kitchen"))
