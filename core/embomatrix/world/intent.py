"""Intent of an instruction: what it demands, in terms of scene objects, apart from the goal that is scored."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class IntentClause:
    """Demand that any of ``things`` has a state, or a relation to any of ``places``; or has not, if ``holds`` is False.

    ``places`` are the hosts of a relation, or the sources of a thermal state; empty if the instruction names none.
    """

    predicate: str
    things: tuple[str, ...]
    places: tuple[str, ...] = ()
    holds: bool = True
