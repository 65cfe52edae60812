"""Instructions in a bounded vocabulary with natural variation: references to objects and phrases for goals."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from embomatrix.factory.scenes.view import SceneView
from embomatrix.world.bddl import is_room_instance

PHRASES: Final[Mapping[str, tuple[str, ...]]] = {
    "ontop": (
        "put {thing} on {place}",
        "place {thing} on {place}",
        "move {thing} onto {place}",
        "set {thing} down on {place}",
    ),
    "inside": (
        "put {thing} in {place}",
        "place {thing} inside {place}",
        "store {thing} in {place}",
        "put {thing} away in {place}",
    ),
    "open": ("open {thing}", "open up {thing}", "leave {thing} open"),
    "not open": ("close {thing}", "shut {thing}", "make sure that {thing} is closed"),
    "toggled_on": ("turn on {thing}", "switch on {thing}", "switch {thing} on"),
    "not toggled_on": ("turn off {thing}", "switch off {thing}", "switch {thing} off"),
    "cooked": ("cook {thing}", "cook {thing} with {place}", "use {place} to cook {thing}"),
    "hot": ("heat {thing}", "heat up {thing} with {place}", "warm {thing} with {place}"),
    "frozen": ("freeze {thing}", "freeze {thing} in {place}", "chill {thing} in {place} until it is frozen"),
}
"""Phrases that request an atom, by predicate. ``place`` is the host or the source."""

_OPENERS: Final = (
    "{request}.",
    "Please {request}.",
    "Could you {request}?",
    "I would like you to {request}.",
)
_JOINS: Final = (" and ", ", then ", " and then ")


def spoken(name: str) -> str:
    """Return a category or room type in words."""
    return name.replace("_", " ")


def room_words(view: SceneView, room: str) -> str:
    """Return ``the kitchen`` if there is one kitchen, otherwise the room's own name such as ``living_room_2``."""
    types = [item.type for item in view.scene.rooms]
    stem = room.rpartition("_")[0] if is_room_instance(room) else room
    return f"the {spoken(stem)}" if types.count(stem) == 1 else room


class Voice:
    """Random choice among phrases with equal probability."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def choose(self, options: Sequence[str]) -> str:
        return options[int(self.rng.integers(len(options)))] if len(options) > 1 else options[0]


class FreshVoice(Voice):
    """Random choice among the least used phrases."""

    def __init__(self, rng: np.random.Generator, said: Counter[str]) -> None:
        super().__init__(rng)
        self._said = said

    def choose(self, options: Sequence[str]) -> str:
        least = min(self._said[option] for option in options)
        chosen = super().choose([option for option in options if self._said[option] == least])
        self._said[chosen] += 1
        return chosen


def sentence(phrases: Sequence[str], rng: np.random.Generator) -> str:
    """Join the clauses to one request."""
    request = phrases[0]
    for clause in phrases[1:]:
        request += _JOINS[int(rng.integers(len(_JOINS)))] + clause
    text = _OPENERS[int(rng.integers(len(_OPENERS)))].format(request=request)
    return text[0].upper() + text[1:]
