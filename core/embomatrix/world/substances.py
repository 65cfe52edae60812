"""Substances: symbolic films, liquids and grains that cover, fill or soak objects.

A substance is named by its synset, ``water.n.06``, in the place of an object's name; it has no position and no amount. The
rules of removal are BEHAVIOR-1K's (``data/substances.json.gz``), with one rule of the paper: plain water removes stains.
"""

import functools
import gzip
import json
from collections.abc import Iterable, Mapping, Set
from enum import StrEnum
from importlib import resources
from typing import Any, Final

from embomatrix.world.state import State, SubstanceFact, SubstanceRelation

Json = Any

WATER: Final = "water.n.06"
DUST: Final = "dust.n.01"
STAIN: Final = "stain.n.01"
RUNNING: Final = "on"
"""Member of a need: the tool must be switched on."""

MEANINGS: Final[Mapping[State, SubstanceFact]] = {
    State.DUSTY: SubstanceFact(SubstanceRelation.COVERED, DUST),
    State.STAINED: SubstanceFact(SubstanceRelation.COVERED, STAIN),
    State.SOAKED: SubstanceFact(SubstanceRelation.SATURATED, WATER),
}
"""States of the paper's dialect that are facts about substances."""
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
"""Requirement on a tool: soaked with one of these substances, or `RUNNING`; empty for no requirement."""


def is_substance(name: str) -> bool:
    """Return True if the name is the synset of a substance in the catalog."""
    return name in _table()["kinds"]


def kind_of(substance: str) -> SubstanceKind:
    """Kind of a substance; SOLID for unknown ones."""
    return SubstanceKind(_table()["kinds"].get(substance, SubstanceKind.SOLID))


def facts_of(states: Iterable[State], substances: Iterable[SubstanceFact]) -> frozenset[SubstanceFact]:
    """Facts about substances, including those that ``states`` imply."""
    return frozenset(substances) | {MEANINGS[state] for state in states if state in MEANINGS}


def fact_holds(relation: SubstanceRelation, substance: str, facts: Set[SubstanceFact]) -> bool:
    """Return True if the facts imply the relation; a filled object also contains the substance."""
    if relation is SubstanceRelation.CONTAINS and SubstanceFact(SubstanceRelation.FILLED, substance) in facts:
        return True
    return SubstanceFact(relation, substance) in facts


def liquids_in(facts: Iterable[SubstanceFact]) -> tuple[str, ...]:
    """Liquids that an object with these facts holds and can be poured from it, sorted."""
    holding = (SubstanceRelation.FILLED, SubstanceRelation.CONTAINS)
    found = {fact.substance for fact in facts if fact.relation in holding}
    return tuple(sorted(name for name in found if kind_of(name) is SubstanceKind.LIQUID))


def flows_from(synset: str) -> tuple[str, ...]:
    """Substances that flow out of an object of this kind while it is on: water out of a sink."""
    return tuple(_table()["sources"].get(synset, ()))


def is_remover(synset: str) -> bool:
    """Return True if an object of this kind removes any substance from another one."""
    return synset in _table()["removers"]


def removal_need(tool: str, substance: str) -> Need | None:
    """Requirement on a tool of this synset to remove the substance; None if it never does."""
    rules = _table()["removers"].get(tool, {})
    return _need(substance, rules.get(substance, rules.get(kind_of(substance))))


def washed_off(substance: str, *, with_detergent: bool) -> bool:
    """Return True if running water removes the substance, alone or with the detergent of a washing machine.

    Substances without a rule rinse off.
    """
    rules = _table()["washer"]
    if substance not in rules:
        return True
    need = _need(substance, rules[substance])
    return need is not None and (with_detergent or not need or WATER in need)


def comes_off(substance: str) -> bool:
    """Return True if any tool, sink or machine removes the substance."""
    tools = _table()["removers"]
    return washed_off(substance, with_detergent=True) or any(
        removal_need(tool, substance) is not None for tool in tools
    )


def half_of(synset: str) -> str:
    """Kind of the two halves of a sliced object of this kind; "" if the catalog has none."""
    return str(_table()["halves"].get(synset, ""))


def in_words(fact: SubstanceFact) -> str:
    """Fact in words: ``dusty``, ``covered with mud``."""
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
