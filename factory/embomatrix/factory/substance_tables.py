"""Build the table of substances from the ``bddl`` package: their kinds, what takes them off, what slicing makes.

A part of `embomatrix.factory.catalog_tables`, whose command writes it.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

Json = Any

ON: Final = "on"
"""What stands in place of a substance in the needs of a remover that works when it is switched on."""
DEFAULTS: Final = {
    "default_visual_conditions": "visual",
    "default_fluid_conditions": "liquid",
    "default_non_fluid_conditions": "solid",
}


def build_substances(folder: Path) -> Json:
    """The table, from the package's generated data.

    ``kinds``: each substance is "visual" (a film, such as dust), "liquid" or "solid" (grains and pieces). ``needs`` are the
    lists that the other entries number: null for never, else the substances one of which must soak the tool (``on``: it
    must run), empty for none. ``removers`` map a tool to substances, and to kinds for those not named; ``washer`` are
    washing machines' rules; ``sources`` what flows out of things that are switched on; ``halves`` what slicing makes.
    """
    knowledge = json.loads((folder / "propagated_annots_params.json").read_text(encoding="utf-8"))
    washer = json.loads((folder / "transition_map/tm_jsons/washer.json").read_text(encoding="utf-8"))
    needs: list[list[str] | None] = []

    def number(options: Iterable[str] | None) -> int:
        entry = None if options is None else sorted(options)
        if entry not in needs:
            needs.append(entry)
        return needs.index(entry)

    return {
        "kinds": {name: _kind(entry) for name, entry in sorted(knowledge.items()) if "substance" in entry},
        "removers": {
            name: {substance: number(options) for substance, options in _removals(ability).items()}
            for name, ability in _able(knowledge, "particleRemover", "conditions")
        },
        "washer": {substance: number(options) for substance, options in sorted(washer.items())},
        "sources": {
            name: sorted(ability["conditions"])
            for name, ability in _able(knowledge, "particleSource", "conditions")
        },
        "halves": {
            name: ability["sliceable_derivative_synset"]
            for name, ability in _able(knowledge, "sliceable", "sliceable_derivative_synset")
        },
        "needs": needs,
    }


def _able(knowledge: Mapping[str, Json], ability: str, parameter: str) -> Iterator[tuple[str, Json]]:
    """Synsets whose ability has the parameter, in their order, with all parameters of the ability."""
    for name, entry in sorted(knowledge.items()):
        if entry.get(ability, {}).get(parameter):
            yield name, entry[ability]


def _kind(abilities: Mapping[str, Json]) -> str:
    if "visualSubstance" in abilities:
        return "visual"
    return "liquid" if "liquid" in abilities else "solid"


def _removals(remover: Mapping[str, Json]) -> dict[str, list[str] | None]:
    conditions = {
        **remover["conditions"],
        **{kind: remover[key] for key, kind in DEFAULTS.items() if key in remover},
    }
    return {name: _options(conditions[name]) for name in sorted(conditions)}


def _options(conditions: list[list[Json]] | None) -> list[str] | None:
    """Each condition is a state and its value: ``["saturated", SUBSTANCE]`` or ``["toggled_on", true]``."""
    if conditions is None:
        return None
    return [value if state == "saturated" else ON for state, value in conditions]
