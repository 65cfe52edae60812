"""Cutting, cleaning and wetting by the catalog's rules: what a tool takes off, what flows out of a source, what washes.

Pure functions of assets and facts, so that preconditions, both execution modes and planners decide alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.world.state import SubstanceFact, SubstanceRelation
from embomatrix.world.substances import (
    RUNNING,
    WATER,
    flows_from,
    is_remover,
    liquids_in,
    removal_need,
    washed_off,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Set

    from embomatrix.world.asset import Asset

CLOTH: Final = "rag.n.01"
"""The tool whose rules say what a cleaning agent takes off that is poured on by itself."""
_MACHINES: Final = frozenset({"dishwasher.n.01", "washer.n.03"})
"""Washing machines: they bring their own detergent."""


@dataclass(frozen=True, slots=True)
class Washing:
    """How a thing washes what lies in it, while it is on."""

    requires_closed: bool
    with_detergent: bool


def cuts(asset: Asset) -> bool:
    """Whether things can be sliced with it."""
    return asset.can("slicer")


def is_sliceable(asset: Asset) -> bool:
    """Whether it can be sliced."""
    return asset.can("sliceable")


def soaks_up(asset: Asset) -> bool:
    """Whether a liquid stays in it: cloths, sponges and brushes are soaked, vessels are filled."""
    return is_remover(asset.synset) or asset.can("fillable")


def washing(asset: Asset) -> Washing | None:
    """The asset as something that washes, a sink or a machine; None when it is none."""
    if not asset.can("toggleable") or not asset.interiors:
        return None
    if asset.synset in _MACHINES:
        return Washing(requires_closed=bool(asset.joints), with_detergent=True)
    return Washing(requires_closed=False, with_detergent=False) if flows_from(asset.synset) else None


def is_cleaner(asset: Asset, facts: Iterable[SubstanceFact]) -> bool:
    """Whether it takes substances off other things: by wiping, by washing them, or with the liquid that it holds."""
    return is_remover(asset.synset) or washing(asset) is not None or bool(liquids_in(facts))


def gives_liquid(asset: Asset, facts: Iterable[SubstanceFact]) -> bool:
    """Whether things can be soaked with what is in it, or with what flows out of it when it is on."""
    return bool(flows_from(asset.synset)) or bool(liquids_in(facts))


def liquids_given(asset: Asset, facts: Iterable[SubstanceFact], *, on: bool) -> tuple[str, ...]:
    """Substances with which the source soaks things as it is: those that flow out of it, then those that it holds."""
    flowing = flows_from(asset.synset) if on or not asset.can("toggleable") else ()
    return tuple(dict.fromkeys((*flowing, *liquids_in(facts))))


def soaked_with(asset: Asset, liquids: Iterable[str]) -> frozenset[SubstanceFact]:
    """What becomes of a thing that liquids run over: a cloth is soaked, a vessel filled. With water, a vessel is wet too."""
    found: set[SubstanceFact] = set()
    for liquid in liquids:
        if asset.can("fillable"):
            found.add(SubstanceFact(SubstanceRelation.FILLED, liquid))
        if is_remover(asset.synset) or (liquid == WATER and asset.can("fillable")):
            found.add(SubstanceFact(SubstanceRelation.SATURATED, liquid))
    return frozenset(found)


def coverings(facts: Iterable[SubstanceFact]) -> tuple[str, ...]:
    """Substances that lie on a thing with these facts, sorted."""
    return tuple(sorted(fact.substance for fact in facts if fact.relation is SubstanceRelation.COVERED))


def missing_for(
    tool: Asset, facts: Set[SubstanceFact], substance: str, *, on: bool
) -> tuple[str, ...] | None:
    """What a tool lacks to take a substance off, any one of which is enough: liquids, or `RUNNING`.

    Empty: it takes the substance off as it is. None: it never does. ``facts`` are the tool's own.
    """
    if not is_remover(tool.synset):
        return _missing_of_bottle(facts, substance)
    need = removal_need(tool.synset, substance)
    if need is None:
        return None
    met = (on and RUNNING in need) or any(
        SubstanceFact(SubstanceRelation.SATURATED, liquid) in facts for liquid in need - {RUNNING}
    )
    return () if met or not need else tuple(sorted(need))


def _missing_of_bottle(facts: Set[SubstanceFact], substance: str) -> tuple[str, ...] | None:
    """The paper's rule: detergent in the hand does what a cloth does that is soaked with it. Water needs the cloth."""
    agents = (removal_need(CLOTH, substance) or frozenset()) - {WATER}
    return () if agents & set(liquids_in(facts)) else None


def taken_off(
    tool: Asset, facts: Set[SubstanceFact], covering: Iterable[str], *, on: bool
) -> tuple[str, ...]:
    """Which of the covering substances a tool in the hand takes off as it is."""
    return tuple(name for name in covering if missing_for(tool, facts, name, on=on) == ())


def washed_away(machine: Washing, covering: Iterable[str]) -> tuple[str, ...]:
    """Which of the covering substances come off in a sink or a machine that runs."""
    return tuple(name for name in covering if washed_off(name, with_detergent=machine.with_detergent))
