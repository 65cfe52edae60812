"""Fixtures of the end-to-end tests: a small dataset, and a browser for the pages."""

import os
import shutil

import pytest
from tests.fakes.datasets import write_kitchen_dataset

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="session")
def kitchen(tmp_path_factory):
    return write_kitchen_dataset(tmp_path_factory.mktemp("kitchen"))


@pytest.fixture(scope="session")
def browser():
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None and os.environ.get("EMBOMATRIX_CI"):
        pytest.fail(f"none of {', '.join(BROWSERS)} is installed: CI looks at every page")
    if found is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is installed: install one to look at the pages")
    return found
