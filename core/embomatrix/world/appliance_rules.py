"""Corrections of heat and cold sources: parameters of BEHAVIOR-1K that differ from the appliance in the world.

The knowledge base gives parameters to synsets, so a wine fridge has the numbers of a fridge-freezer. Each correction names
a category and the reason. A fridge stands for a fridge-freezer: it freezes, as in the paper's skill
``froze_object_with_source``. Coolers, wine fridges and display fridges only cool.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

Abilities = Mapping[str, Mapping[str, float]]

COLD: Final = "coldSource"
HEAT: Final = "heatSource"
CLOSED: Final = "requires_closed"
TEMPERATURE: Final = "temperature"


@dataclass(frozen=True, slots=True)
class SourceRule:
    """Corrected parameters of a heat or cold source, with the reason. Temperatures are degrees Celsius."""

    ability: str
    parameters: Mapping[str, float]
    reason: str


SOURCE_RULES: Final[Mapping[str, SourceRule]] = MappingProxyType(
    {
        "wine_fridge": SourceRule(COLD, {TEMPERATURE: 12.0}, "wine is kept at 8 to 14, it must not freeze"),
        "display_fridge": SourceRule(COLD, {TEMPERATURE: 4.0}, "drinks and cakes behind glass are cooled, not frozen"),
        "cooler": SourceRule(COLD, {CLOSED: 1.0}, "a cool box holds its 4 degrees under its lid only"),
        "freezer": SourceRule(COLD, {CLOSED: 1.0}, "a deep-freeze freezes behind its door only, like a fridge"),
        "coffee_maker": SourceRule(HEAT, {TEMPERATURE: 45.0}, "the water has 93; the bay warms cups and cooks nothing"),
        "espresso_machine": SourceRule(HEAT, {TEMPERATURE: 45.0}, "as the coffee maker"),
        "electric_cauldron": SourceRule(HEAT, {TEMPERATURE: 100.0}, "soup boils at 100, the pot never reaches 200"),
        "radiator": SourceRule(HEAT, {TEMPERATURE: 45.0}, "its top warms things; 91 is the water inside and would cook food"),
        "pressure_cooker": SourceRule(HEAT, {CLOSED: 1.0}, "121 needs pressure, so the lid must be shut"),
        "smoker": SourceRule(HEAT, {TEMPERATURE: 120.0}, "hot smoking works at 110 to 130, a grill at 260"),
    }
)  # fmt: skip
"""Corrections by category. A category without an entry keeps the parameters of its synset."""


def corrected(category: str, abilities: Abilities) -> Abilities:
    """Return the abilities of a category with the corrections of its heat or cold source."""
    rule = SOURCE_RULES.get(category)
    if rule is None:
        return abilities
    source = MappingProxyType({**abilities[rule.ability], **rule.parameters})
    return MappingProxyType({**abilities, rule.ability: source})
