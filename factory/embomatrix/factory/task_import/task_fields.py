"""Fields of an imported task: instruction, signature, and appliances that the goal needs."""

import itertools
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Final

from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.task_import.sources import SourceText
from embomatrix.skills.appliances import liquids_given
from embomatrix.world.bddl import ROOM_TYPES, BddlProblem, is_room_instance
from embomatrix.world.evaluate import atoms_of
from embomatrix.world.goal import Formula
from embomatrix.world.state import THERMAL, State
from embomatrix.world.substances import WATER

MAX_SOURCES: Final = 2
"""Maximum number of appliances added to the table for each object that gets hot, cooked or frozen."""
_ROOM_OR_TEXT: Final = re.compile(
    rf"(?:{'|'.join(sorted(ROOM_TYPES, key=len, reverse=True))})_\d+|.+?(?=(?:{'|'.join(sorted(ROOM_TYPES))})_\d|$)",
    re.IGNORECASE,
)


def instruction_of(
    source: SourceText, problem: BddlProblem, rooms: Mapping[str, str] = MappingProxyType({})
) -> str:
    """Return the instruction. The paper's tasks encode it in the problem's name, with underscores for spaces.

    ``rooms`` maps the problem's room names to the scene's, in the instruction too.
    """
    if source.instruction:
        return source.instruction
    words = source.request or problem.name
    words = re.sub(r"-\d+$", "", words)
    words = re.sub(r"\.n\.\d+(_\d+)?", "", words)
    spaced = " ".join(
        rooms.get(word.lower(), word) if is_room_instance(word.lower()) else word.replace("_", " ")
        for word in _ROOM_OR_TEXT.findall(words)
    )
    words = re.sub(r"\s+([.,]|$)", r"\1", re.sub(r"\s+", " ", spaced)).strip(" .")
    return f"{words[:1].upper()}{words[1:]}."


def signature_of(goal: Formula, view: SceneView) -> str:
    """Return the signature of a goal: its predicates over categories, sorted. Variables stand for their type."""
    signs = []
    for atom in atoms_of(goal):
        args = (view.category(arg) if arg in view.scene.by_name else arg.lstrip("?") for arg in atom.args)
        signs.append(f"{atom.predicate}({','.join(args)})")
    return " ".join(sorted(signs))


def sources_for(
    view: SceneView, goal: Formula, types: Mapping[str, tuple[str, ...]], known: Collection[str]
) -> Iterator[str]:
    """Yield appliances of the scene that heat, cook or freeze what the goal requires and the problem's objects can't.

    There may be several for each object: the door of the nearest one may be blocked.

    The paper's tasks freeze food in coolers, which only keep drinks cool.
    """
    rooms = {view.room(name) for name in known}
    for atom in atoms_of(goal):
        if atom.predicate not in THERMAL:
            continue
        effect = State(atom.predicate)
        object_names = types.get(atom.args[0].lstrip("?"), (atom.args[0],))
        for object_name in object_names:
            if object_name not in view.scene.by_name:
                continue
            if any(effect in view.thermal_effects(object_name, name) for name in known):
                continue
            able = [
                item.name
                for item in view.scene.objects
                if item.fixed
                and view.is_source(item.name)
                and effect in view.thermal_effects(object_name, item.name)
                and view.opens(item.name)
            ]
            able.sort(key=lambda name: view.room(name) not in rooms)
            yield from able[:MAX_SOURCES]


def taps_for(view: SceneView, goal: Formula, known: Iterable[str]) -> Iterator[str]:
    """Yield a tap of the scene if the goal needs water and no object of the problem gives any.

    EAI's tasks soak objects in a teapot, which is empty here.
    """
    predicates = {atom.predicate for atom in atoms_of(goal)}
    if not predicates & {State.SOAKED, State.STAINED}:
        return
    rooms = {view.room(name) for name in known}
    if any(_gives_water(view, name) for name in known):
        return
    taps = [item.name for item in view.scene.objects if item.fixed and _gives_water(view, item.name)]
    taps.sort(key=lambda name: view.room(name) not in rooms)
    yield from itertools.islice(taps, 1)


def _gives_water(view: SceneView, name: str) -> bool:
    return WATER in liquids_given(view.asset(name), view.item(name).substances, on=True)
