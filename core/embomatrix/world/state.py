"""Relations and states that a goal can name."""

from dataclasses import dataclass
from enum import StrEnum


class Relation(StrEnum):
    """Binary relations read from the engine's metric state. ``ontop(a, b)`` means that a is on b."""

    ONTOP = "ontop"
    INSIDE = "inside"
    UNDER = "under"
    NEXTTO = "nextto"
    TOUCHING = "touching"
    INROOM = "inroom"


class State(StrEnum):
    """Unary states. OPEN is metric (a joint beyond 5 % of its travel); the others are symbolic."""

    OPEN = "open"
    TOGGLED_ON = "toggled_on"
    COOKED = "cooked"
    FROZEN = "frozen"
    HOT = "hot"
    SLICED = "sliced"
    DUSTY = "dusty"
    STAINED = "stained"
    SOAKED = "soaked"


THERMAL = frozenset({State.COOKED, State.FROZEN, State.HOT})
"""States that heat and cold sources give. A goal may name the source as a second argument: ``hot(apple_1, oven_1)``."""


class SubstanceRelation(StrEnum):
    """Symbolic relations of an object to a substance. ``covered(a, dust.n.01)`` means that dust lies on a."""

    COVERED = "covered"
    FILLED = "filled"
    CONTAINS = "contains"
    SATURATED = "saturated"


@dataclass(frozen=True, slots=True, order=True)
class SubstanceFact:
    """Fact about an object and a substance; ``substance`` is a synset of the catalog, such as ``water.n.06``."""

    relation: SubstanceRelation
    substance: str


HOT_C = 40.0
COOK_C = 70.0
FREEZE_C = 0.0
"""Temperatures in degrees Celsius at which the states of the same name begin: BEHAVIOR-1K's defaults."""
OPEN_FRACTION = 0.05
"""A joint is open beyond this share of its travel: OmniGibson's definition."""
