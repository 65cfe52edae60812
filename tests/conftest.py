"""Make the repository's root importable: tests import their fakes as ``from tests.fakes.scenes import kitchen_scene``."""

import sys
from pathlib import Path

ROOT = str(Path(__file__).resolve().parents[1])
if ROOT not in sys.path:
    sys.path.insert(0, ROOT)
