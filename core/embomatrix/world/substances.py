"""Substances: symbolic films, liquids and grains that things are covered, filled or soaked with.

A substance is called by its synset, ``water.n.06``, wherever an object could be called by its name; it has no place and no
amount. What takes a substance off is BEHAVIOR-1K's knowledge (``data/substances.json.gz``), with one rule of the paper's
added here: plain water takes stains off.
"""

from __future__ import annotations

import functools
import gzip
import json
from enum import StrEnum
from importlib import resources
from typing import TYPE_CHECKING, Any, Final

from embomatrix.world.state import State, SubstanceFact, SubstanceRelation

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Set

Json = Any

WATER: Final = "water.n.06"
DUST: Final = "dust.n.01"
STAIN: Final = "stain.n.01"
RUNNING: Final = "on"
"""Stands in a need where the tool must be switched on, rather than soaked."""

MEANINGS: Final[Mapping[State, SubstanceFact]] = {
    State.DUSTY: SubstanceFact(SubstanceRelation.COVERED, DUST),
    State.STAINED: SubstanceFact(SubstanceRelation.COVERED, STAIN),
    State.SOAKED: SubstanceFact(SubstanceRelation.SATURATED, WATER),
}
"""States of the paper's dialect that are facts about substances: the two are one, whichever a scene or a goal speaks of."""
WORDS: Final[Mapping[SubstanceRelation, str]] = {
    SubstanceRelation.COVERED: "covered with",
    SubstanceRelation.FILLED: "filled with",
    SubstanceRelation.CONTAINS: "containing",
    SubstanceRelation.SATURATED: "soaked with",
}
_STATE_OF: Final = {fact: state for state, fact in MEANINGS.items()}


class SubstanceKind(StrEnum):
    """VISUAL substances are films on a surface; SOLID ones are grains and pieces."""

    VISUAL = "visual"
    LIQUID = "liquid"
    SOLID = "solid"


Need = frozenset[str]
"""What a tool must be for a removal: soaked with one of these substances, or `RUNNING`; empty for neither."""


def is_substance(name: str) -> bool:
    """Whether the name is the synset of a substance that the catalog knows."""
    return name in _table()["kinds"]


def kind_of(substance: str) -> SubstanceKind:
    """Kind of a substance; of one that the catalog does not know, SOLID."""
    return SubstanceKind(_table()["kinds"].get(substance, SubstanceKind.SOLID))


def facts_of(states: Iterable[State], substances: Iterable[SubstanceFact]) -> frozenset[SubstanceFact]:
    """Facts about substances, with those that ``states`` tell of in the paper's words."""
    return frozenset(substances) | {MEANINGS[state] for state in states if state in MEANINGS}


def fact_holds(relation: SubstanceRelation, substance: str, facts: Set[SubstanceFact]) -> bool:
    """Whether the facts say so. What is filled with a substance contains it."""
    if relation is SubstanceRelation.CONTAINS and SubstanceFact(SubstanceRelation.FILLED, substance) in facts:
        return True
    return SubstanceFact(relation, substance) in facts


def liquids_in(facts: Iterable[SubstanceFact]) -> tuple[str, ...]:
    """Liquids that a thing with these facts holds, sorted: what can be poured on something from it."""
    holding = (SubstanceRelation.FILLED, SubstanceRelation.CONTAINS)
    found = {fact.substance for fact in facts if fact.relation in holding}
    return tuple(sorted(name for name in found if kind_of(name) is SubstanceKind.LIQUID))


def flows_from(synset: str) -> tuple[str, ...]:
    """Substances that flow out of a thing of this kind while it is on: water out of a sink."""
    return tuple(_table()["sources"].get(synset, ()))


def is_remover(synset: str) -> bool:
    """Whether a thing of this kind takes any substance off another one."""
    return synset in _table()["removers"]


def removal_need(tool: str, substance: str) -> Need | None:
    """What a tool of this synset must be to take the substance off; None when it never does."""
    rules = _table()["removers"].get(tool, {})
    return _need(substance, rules.get(substance, rules.get(kind_of(substance))))


def washed_off(substance: str, *, with_detergent: bool) -> bool:
    """Whether running water takes the substance off, by itself or with the detergent of a washing machine.

    What the rules do not name is rinsed off, be it a film, a liquid or grains.
    """
    rules = _table()["washer"]
    if substance not in rules:
        return True
    need = _need(substance, rules[substance])
    return need is not None and (with_detergent or not need or WATER in need)


def comes_off(substance: str) -> bool:
    """Whether any tool, sink or machine takes the substance off."""
    tools = _table()["removers"]
    return washed_off(substance, with_detergent=True) or any(
        removal_need(tool, substance) is not None for tool in tools
    )


def half_of(synset: str) -> str:
    """Kind of the two things that slicing makes of one of this kind, "" where the catalog knows none."""
    return str(_table()["halves"].get(synset, ""))


def in_words(fact: SubstanceFact) -> str:
    """A fact as a person says it: ``dusty``, ``covered with mud``."""
    state = _STATE_OF.get(fact)
    return state.value if state is not None else f"{WORDS[fact.relation]} {word_of(fact.substance)}"


def word_of(substance: str) -> str:
    """The substance in words: ``cooked__white_rice.n.01`` is "cooked white rice"."""
    return substance.split(".")[0].replace("__", " ").replace("_", " ")


def _need(substance: str, number: int | None) -> Need | None:
    options = None if number is None else _table()["needs"][number]
    if options is None:
        return None
    return frozenset(options) | {WATER} if substance == STAIN and options else frozenset(options)


@functools.cache
def _table() -> Json:
    data = resources.files("embomatrix.world").joinpath("data").joinpath("substances.json.gz").read_bytes()
    return json.loads(gzip.decompress(data))
