"""Appliances of a scene that a goal needs and its problem does not name."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Final

from embomatrix.skills.household import liquids_given
from embomatrix.world.evaluate import atoms_of
from embomatrix.world.state import State
from embomatrix.world.substances import WATER

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from embomatrix.factory.scenes.view import SceneView
    from embomatrix.world.goal import Formula

_THERMAL: Final = frozenset({State.COOKED, State.FROZEN, State.HOT})


def sources_for(
    view: SceneView, goal: Formula, types: Mapping[str, tuple[str, ...]], known: Iterable[str]
) -> Iterator[str]:
    """Objects of the scene that heat, cook or freeze what the goal asks for, where no object of the problem does.

    The paper's own tasks freeze things in coolers, which keep drinks cool and no more.
    """
    for atom in atoms_of(goal):
        if atom.predicate not in _THERMAL:
            continue
        effect = State(atom.predicate)
        things = types.get(atom.args[0].lstrip("?"), (atom.args[0],))
        for thing in things:
            if thing not in view.scene.by_name:
                continue
            if any(effect in view.thermal_effects(thing, name) for name in known):
                continue
            able = (
                item.name
                for item in view.scene.objects
                if item.fixed
                and view.is_source(item.name)
                and effect in view.thermal_effects(thing, item.name)
                and view.opens(item.name)
            )
            yield from itertools.islice(able, 1)


def taps_for(view: SceneView, goal: Formula, known: Iterable[str]) -> Iterator[str]:
    """A tap of the scene where the goal asks for something wet, or clean, and no object of the problem gives water.

    EAI's tasks soak things in a teapot, which is empty in our world.
    """
    asked = {atom.predicate for atom in atoms_of(goal)}
    if not asked & {State.SOAKED, State.STAINED}:
        return
    rooms = {view.room(name) for name in known}
    if any(_gives_water(view, name) for name in known):
        return
    taps = [item.name for item in view.scene.objects if item.fixed and _gives_water(view, item.name)]
    taps.sort(key=lambda name: view.room(name) not in rooms)
    yield from itertools.islice(taps, 1)


def _gives_water(view: SceneView, name: str) -> bool:
    return WATER in liquids_given(view.asset(name), view.item(name).substances, on=True)
