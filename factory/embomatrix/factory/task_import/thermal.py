"""Appliances of a scene that a goal needs and its problem does not name."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Final

from embomatrix.world.evaluate import atoms_of
from embomatrix.world.state import State

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from embomatrix.factory.writer.view import SceneView
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
