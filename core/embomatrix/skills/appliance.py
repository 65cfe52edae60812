"""Appliances by their parameters: what heats or cools, what it acts on, and on which conditions.

The parameters are BEHAVIOR-1K's: ``temperature`` in degrees Celsius, and three flags.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.world.state import COOK_C, FREEZE_C, HOT_C

if TYPE_CHECKING:
    from embomatrix.world.asset import Asset


@dataclass(frozen=True, slots=True)
class Source:
    """A heat or cold source. It acts on what is inside it if ``requires_inside``, else on what is on top of it."""

    temperature_c: float
    requires_on: bool
    requires_closed: bool
    requires_inside: bool


def heat_source(asset: Asset) -> Source | None:
    """The asset as a heat source, None when it is none."""
    return _source(asset, "heatSource")


def cold_source(asset: Asset) -> Source | None:
    """The asset as a cold source, None when it is none."""
    return _source(asset, "coldSource")


def _source(asset: Asset, ability: str) -> Source | None:
    """An ability without a temperature makes nothing hot or cold: the knowledge base lists some."""
    parameters = asset.abilities.get(ability, {})
    if "temperature" not in parameters:
        return None
    return Source(
        temperature_c=parameters["temperature"],
        requires_on=parameters.get("requires_toggled_on", 0.0) > 0 and asset.can("toggleable"),
        requires_closed=parameters.get("requires_closed", 0.0) > 0 and bool(asset.joints),
        requires_inside=parameters.get("requires_inside", 0.0) > 0,
    )


def heats(source: Source) -> bool:
    """Whether the source makes things hot."""
    return source.temperature_c >= HOT_C


def cooks(source: Source, food: Asset) -> bool:
    """Whether the source cooks the food."""
    return food.can("cookable") and source.temperature_c >= cook_temperature_c(food)


def freezes(source: Source) -> bool:
    """Whether the source freezes things."""
    return source.temperature_c <= FREEZE_C


def cook_temperature_c(food: Asset) -> float:
    """Temperature that the food needs to get cooked."""
    return food.abilities.get("cookable", {}).get("cook_temperature", COOK_C)


def starts_closed(asset: Asset) -> bool:
    """Whether the appliance starts only when it is closed, and therefore may not be opened while it runs."""
    return asset.abilities.get("toggleable", {}).get("requires_closed", 0.0) > 0 and bool(asset.joints)
