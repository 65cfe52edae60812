"""Stands in for iGibson, so that EAI's published judge can be imported without it. Runs in the judge's own interpreter.

The judge asks iGibson for names, states, boxes and first relations of objects only. Its parser, its checks, its graph and its
goal check are the published code.
"""

from __future__ import annotations

import importlib
import sys
import types
from typing import Any, Final

SIMULATOR: Final = (
    "igibson",
    "igibson.object_states",
    "igibson.object_states.on_floor",
    "igibson.objects",
    "igibson.objects.multi_object_wrappers",
    "igibson.objects.articulated_object",
    "igibson.objects.object_base",
    "igibson.tasks",
    "igibson.tasks.behavior_task",
    "igibson.envs",
    "igibson.envs.igibson_env",
    "igibson.robots",
    "igibson.scenes",
    "igibson.scenes.igibson_indoor_scene",
    "igibson.simulator",
    "igibson.utils",
    "igibson.utils.utils",
    "igibson.utils.ig_logging",
)
UNUSED: Final = ("pybullet", "gym", "IPython", "pyquaternion", "fire")
"""Packages that the judge imports beside it and does not use."""
BINARY: Final = ("Inside", "OnFloor", "OnTop", "Under", "NextTo", "Touching")
UNARY: Final = (
    "Cooked",
    "Dusty",
    "Frozen",
    "Open",
    "Sliced",
    "Soaked",
    "Stained",
    "ToggledOn",
    "Burnt",
    "Slicer",
    "CleaningTool",
    "AABB",
    "HeatSourceOrSink",
    "WaterSource",
)


class _Blank(types.ModuleType):
    """A module in which every name is an empty class, the same one each time."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        found = type(name, (), {})
        setattr(self, name, found)
        return found


def install() -> None:
    """Put the stand-ins where imports look. Packages that are there stay."""
    for name in (*SIMULATOR, *UNUSED):
        if name in UNUSED and _is_there(name):
            continue
        module = _Blank(name)
        module.__path__ = []
        sys.modules[name] = module
        parent, _, child = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], child, module)


def _is_there(name: str) -> bool:
    try:
        importlib.import_module(name)
    except ImportError:
        return False
    return True


def state_class(name: str) -> type:
    """The class by which the judge asks for a state: its name is all that counts."""
    found: type = getattr(sys.modules["igibson.object_states"], name)
    return found


class StandInState:
    """One state of an object: a value of its own, or names of the objects that it is related to."""

    def __init__(self) -> None:
        self.holds = False
        self.related: set[str] = set()

    def get_value(self, other: Any = None) -> bool:
        return self.holds if other is None else other.name in self.related


def make_object(module: str, kind: str, name: str, box_m: list[float], unary: set[str]) -> Any:
    """An object of one of iGibson's classes, with every relation and these states of its own, all false."""
    made = getattr(sys.modules[module], kind)()
    made.name, made.bounding_box = name, box_m
    made.states = {state_class(state): StandInState() for state in (*BINARY, *sorted(unary))}
    return made
