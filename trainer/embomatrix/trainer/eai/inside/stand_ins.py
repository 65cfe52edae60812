"""Stand-ins for iGibson, so that EAI's judge can be imported without it. Runs in the judge's own interpreter.

The judge only asks iGibson for names, states, boxes and initial relations of objects. Parser, checks, graph and goal check
are the published code.
"""

import importlib.util
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
"""Packages that the judge imports and does not use."""
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
    """Module in which every name is an empty class, cached by name."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        found = type(name, (), {})
        setattr(self, name, found)
        return found


def install() -> None:
    """Register the stand-ins in sys.modules. Installed packages are kept."""
    for name in (*SIMULATOR, *UNUSED):
        if name in UNUSED and importlib.util.find_spec(name):
            continue
        module = _Blank(name)
        module.__path__ = []
        sys.modules[name] = module
        parent, _, child = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], child, module)


def state_class(name: str) -> type:
    """Class by which the judge identifies a state. Only its name matters."""
    found: type = getattr(sys.modules["igibson.object_states"], name)
    return found


class StandInState:
    """State of one object: a boolean, or the names of related objects."""

    def __init__(self) -> None:
        self.holds = False
        self.related: set[str] = set()

    def get_value(self, other: Any = None) -> bool:
        return self.holds if other is None else other.name in self.related


def make_object(module: str, kind: str, name: str, box_m: list[float], unary: set[str]) -> Any:
    """Object of an iGibson class with all relations and the given unary states, all false."""
    made = getattr(sys.modules[module], kind)()
    made.name, made.bounding_box = name, box_m
    made.states = {state_class(state): StandInState() for state in (*BINARY, *sorted(unary))}
    return made
