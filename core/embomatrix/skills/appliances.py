"""Rules of appliances and tools: heating, cooling, cutting, cleaning and wetting.

Pure functions of assets and facts, shared by preconditions, both execution modes and the planner. The parameters of heat
and cold sources are BEHAVIOR-1K's: a temperature in degrees Celsius and three flags.
"""

from collections.abc import Iterable, Set
from dataclasses import dataclass
from typing import Final

from embomatrix.world.asset import Asset
from embomatrix.world.state import COOK_C, FREEZE_C, HOT_C, SubstanceFact, SubstanceRelation
from embomatrix.world.substances import (
    RUNNING,
    WATER,
    flows_from,
    is_remover,
    liquids_in,
    removal_need,
    washed_off,
)

CLOTH: Final = "rag.n.01"
"""Tool whose removal rules apply to a cleaning agent that is poured on directly."""
_MACHINES: Final = frozenset({"dishwasher.n.01", "washer.n.03"})
"""Washing machines with built-in detergent."""


@dataclass(frozen=True, slots=True)
class ThermalSource:
    """A heat or cold source. It acts on its contents if ``requires_inside``, else on the objects on top of it."""

    temperature_c: float
    requires_on: bool
    requires_closed: bool
    requires_inside: bool


@dataclass(frozen=True, slots=True)
class Washing:
    """Conditions under which an appliance washes its contents while it is on."""

    requires_closed: bool
    with_detergent: bool


def heat_source(asset: Asset) -> ThermalSource | None:
    """Return the asset's parameters as a heat source, None if it is none."""
    return _thermal_source(asset, "heatSource")


def cold_source(asset: Asset) -> ThermalSource | None:
    """Return the asset's parameters as a cold source, None if it is none."""
    return _thermal_source(asset, "coldSource")


def _thermal_source(asset: Asset, ability: str) -> ThermalSource | None:
    """Ignore abilities without a temperature: the knowledge base lists some."""
    parameters = asset.abilities.get(ability, {})
    if "temperature" not in parameters:
        return None
    return ThermalSource(
        temperature_c=parameters["temperature"],
        requires_on=parameters.get("requires_toggled_on", 0.0) > 0 and asset.can("toggleable"),
        requires_closed=parameters.get("requires_closed", 0.0) > 0 and bool(asset.joints),
        requires_inside=parameters.get("requires_inside", 0.0) > 0,
    )


def heats(source: ThermalSource) -> bool:
    """True if the source makes objects hot."""
    return source.temperature_c >= HOT_C


def cooks(source: ThermalSource, food: Asset) -> bool:
    return food.can("cookable") and source.temperature_c >= cook_temperature_c(food)


def freezes(source: ThermalSource) -> bool:
    """True if the source freezes objects."""
    return source.temperature_c <= FREEZE_C


def cook_temperature_c(food: Asset) -> float:
    """Temperature at which the food gets cooked."""
    return food.abilities.get("cookable", {}).get("cook_temperature", COOK_C)


def starts_closed(asset: Asset) -> bool:
    """True if the appliance runs only when closed, so that it must not be opened while it runs."""
    return asset.abilities.get("toggleable", {}).get("requires_closed", 0.0) > 0 and bool(asset.joints)


def soaks_up(asset: Asset) -> bool:
    """True if the asset takes up a liquid: cloths, sponges and brushes get soaked, vessels get filled."""
    return is_remover(asset.synset) or asset.can("fillable")


def washing(asset: Asset) -> Washing | None:
    """Return the washing conditions of a sink or a washing machine, None for any other asset."""
    if not asset.can("toggleable") or not asset.interiors:
        return None
    if asset.synset in _MACHINES:
        return Washing(requires_closed=bool(asset.joints), with_detergent=True)
    return Washing(requires_closed=False, with_detergent=False) if flows_from(asset.synset) else None


def is_cleaner(asset: Asset, facts: Iterable[SubstanceFact]) -> bool:
    """True if the asset removes substances from other objects: by wiping, by washing, or with the liquid that it holds."""
    return is_remover(asset.synset) or washing(asset) is not None or bool(liquids_in(facts))


def gives_liquid(asset: Asset, facts: Iterable[SubstanceFact]) -> bool:
    """True if the asset holds a liquid, or a liquid flows out of it when it is on."""
    return bool(flows_from(asset.synset)) or bool(liquids_in(facts))


def liquids_given(asset: Asset, facts: Iterable[SubstanceFact], *, on: bool) -> tuple[str, ...]:
    """Liquids that the asset gives in its present state: first those that flow out of it, then those that it holds."""
    flowing = flows_from(asset.synset) if on or not asset.can("toggleable") else ()
    return tuple(dict.fromkeys((*flowing, *liquids_in(facts))))


def soaked_with(asset: Asset, liquids: Iterable[str]) -> frozenset[SubstanceFact]:
    """Facts that hold after liquids ran over an asset: a cloth is soaked, a vessel is filled and, by water, wet."""
    found: set[SubstanceFact] = set()
    for liquid in liquids:
        if asset.can("fillable"):
            found.add(SubstanceFact(SubstanceRelation.FILLED, liquid))
        if is_remover(asset.synset) or (liquid == WATER and asset.can("fillable")):
            found.add(SubstanceFact(SubstanceRelation.SATURATED, liquid))
    return frozenset(found)


def coverings(facts: Iterable[SubstanceFact]) -> tuple[str, ...]:
    """Substances that cover an object with these facts, sorted."""
    return tuple(sorted(fact.substance for fact in facts if fact.relation is SubstanceRelation.COVERED))


def missing_for(
    tool: Asset, facts: Set[SubstanceFact], substance: str, *, on: bool
) -> tuple[str, ...] | None:
    """Return alternatives that a tool lacks to remove a substance: liquids, or `RUNNING`. One of them is enough.

    Empty: the tool removes the substance without a liquid. None: the tool never removes it. ``facts`` are those of the tool.
    """
    if not is_remover(tool.synset):
        # The paper's rule: detergent in the hand does what a cloth soaked with it does. Water needs the cloth.
        agents = (removal_need(CLOTH, substance) or frozenset()) - {WATER}
        return () if agents & set(liquids_in(facts)) else None
    need = removal_need(tool.synset, substance)
    if need is None:
        return None
    met = (on and RUNNING in need) or any(
        SubstanceFact(SubstanceRelation.SATURATED, liquid) in facts for liquid in need - {RUNNING}
    )
    return () if met or not need else tuple(sorted(need))


def taken_off(
    tool: Asset, facts: Set[SubstanceFact], covering: Iterable[str], *, on: bool
) -> tuple[str, ...]:
    """Covering substances that a tool in the hand removes in its present state."""
    return tuple(name for name in covering if missing_for(tool, facts, name, on=on) == ())


def washed_away(machine: Washing, covering: Iterable[str]) -> tuple[str, ...]:
    """Covering substances that come off in a running sink or washing machine."""
    return tuple(name for name in covering if washed_off(name, with_detergent=machine.with_detergent))
