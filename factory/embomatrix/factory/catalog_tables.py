"""Build the catalog's package data from the ``bddl`` package: ``python -m embomatrix.factory.catalog_tables --out FOLDER``.

BEHAVIOR-1K's knowledge base (``bddl`` 3.6.0, MIT) holds the box of every object model, the mass and abilities of
their categories, and the inventories of 51 scenes by room. This script reduces its 28 MB to three small tables, which
are identical on every run, and adds the notice that the licence requires.
"""

import argparse
import csv
import gzip
import importlib.metadata
import importlib.util
import json
import re
import statistics
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

Json = Any

BDDL_VERSION: Final = "3.6.0"
CATALOG_FILE: Final = "catalog.json.gz"
SCENES_FILE: Final = "scenes.json.gz"
SUBSTANCES_FILE: Final = "substances.json.gz"
NOTICE_FILE: Final = "NOTICE.md"

DOORS: Final = frozenset({"door", "sliding_door", "garage_door", "elevator_door", "gate"})
WINDOWS: Final = frozenset({"openable_window", "fixed_window"})
STRUCTURE: Final = frozenset({"walls", "floors", "ceilings", "lawn", "driveway"})
"""Categories of the building itself. A scene generates its own walls and floors."""
LEAST_FLOOR_M: Final = 0.4
"""Narrower floor models are thresholds or strips too narrow to stand on."""

_SYNSET: Final = re.compile(r"[a-z][\w'\-]*\.n\.\d\d")
"""Synset in a problem file, such as ``apple.n.01``, without the number of an instance."""

UNIVERSAL: Final = frozenset(
    {
        "disinfectable", "dustyable", "grassyable", "moldyable", "nonSubstance", "rustable", "scratchable",
        "stainable", "stickyable", "tarnishable", "wetable", "wrinkleable",
    }
)  # fmt: skip
"""Abilities that every solid object has. They carry no information and would double the table."""


class CatalogSourceError(Exception):
    """The ``bddl`` package is missing or has another version than the tables."""


def source_folder() -> Path:
    """Return the folder of the package's generated data. Raise CatalogSourceError if it is missing or has another version."""
    spec = importlib.util.find_spec("bddl")
    if spec is None or spec.origin is None:
        raise CatalogSourceError(f"the package bddl is not installed: try `pip install bddl=={BDDL_VERSION}`")
    found = importlib.metadata.version("bddl")
    if found != BDDL_VERSION:
        raise CatalogSourceError(
            f"bddl is {found}, the tables come from {BDDL_VERSION}: install that version"
        )
    return Path(spec.origin).parent / "generated_data"


def build_catalog(folder: Path) -> Json:
    """Return synsets (children, abilities), categories (synset, mass) and models (box in m, meta links).

    Only solid categories are kept. The other 601 are particle meshes of substances, which have no mass.
    """
    inventory = _read_json(folder / "object_inventory.json")
    synsets = _taxonomy(_read_json(folder / "output_hierarchy.json"))
    for synset, abilities in _read_json(folder / "propagated_annots_params.json").items():
        if synset in synsets:
            synsets[synset]["abilities"] = _abilities(abilities)
    masses = _masses(folder / "category_mapping.csv")
    categories: dict[str, Json] = {}
    for synset, entry in synsets.items():
        for category in entry.pop("categories"):
            categories[category] = {"synset": synset, "mass_kg": masses[category], "models": {}}
    for asset_id in inventory["providers"]:
        category, model = asset_id.rsplit("-", 1)
        if category in categories:
            size = [round(extent, 4) for extent in inventory["bounding_box_sizes"][model]]
            links = sorted(set(inventory["meta_links"].get(asset_id, [])) - {"collision"})
            categories[category]["models"][model] = [*size, links] if links else size
    return {
        "source": f"bddl {BDDL_VERSION}",
        "synsets": synsets,
        "categories": categories,
        "activity_synsets": _activity_synsets(folder.parent / "activity_definitions", synsets),
    }


def _activity_synsets(folder: Path, known: Mapping[str, Json]) -> list[str]:
    """Return the synsets of the taxonomy that the activity definitions name."""
    found: set[str] = set()
    for path in folder.glob("*/problem*.bddl"):
        found.update(_SYNSET.findall(path.read_text(encoding="utf-8").lower()))
    return sorted(found & known.keys())


def _taxonomy(root: Json) -> dict[str, Json]:
    synsets: dict[str, Json] = {}

    def visit(node: Json) -> None:
        entry = synsets.setdefault(node["name"], {"children": set(), "categories": set()})
        entry["categories"].update(node.get("categories", []))
        for child in node.get("children", []):
            entry["children"].add(child["name"])
            visit(child)

    visit(root)
    return {
        name: {key: sorted(values) for key, values in entry.items()}
        for name, entry in sorted(synsets.items())
    }


def _abilities(raw: Mapping[str, Mapping[str, Json]]) -> dict[str, dict[str, float]]:
    """Keep the distinguishing abilities with their numeric parameters."""
    return {
        ability: {name: float(value) for name, value in parameters.items() if isinstance(value, (int, float))}
        for ability, parameters in raw.items()
        if ability not in UNIVERSAL
    }


def _masses(path: Path) -> dict[str, float]:
    with path.open(newline="", encoding="utf-8") as file:
        return {
            row["category"]: float(row["mass (auto)"]) for row in csv.DictReader(file) if row["mass (auto)"]
        }


def build_scenes(folder: Path) -> Json:
    """Return the inventories of all scenes: for each room its floor (m), and model counts of doors, windows and objects."""
    boxes = _read_json(folder / "object_inventory.json")["bounding_box_sizes"]
    scenes = _read_json(folder / "combined_room_object_list.json")["scenes"]
    typical = _typical_floors(scenes, boxes)
    return {
        "source": f"bddl {BDDL_VERSION}",
        "scenes": {
            scene_id: {"rooms": {name: _room(name, models, boxes, typical) for name, models in rooms.items()}}
            for scene_id, rooms in scenes.items()
        },
    }


def _room(name: str, models: Mapping[str, int], boxes: Json, typical: Mapping[str, list[float]]) -> Json:
    floors = _floors(models, boxes)
    room_type = _room_type(name)
    room = {
        "type": room_type,
        "floors": floors or [typical[room_type]],
        "doors": _pick(models, DOORS),
        "windows": _pick(models, WINDOWS),
        "objects": {key: n for key, n in models.items() if _category(key) not in DOORS | WINDOWS | STRUCTURE},
    }
    return room if floors else {**room, "floor_estimated": True}


def _pick(models: Mapping[str, int], categories: frozenset[str]) -> dict[str, int]:
    return {asset_id: count for asset_id, count in models.items() if _category(asset_id) in categories}


def _floors(models: Iterable[str], boxes: Json) -> list[list[float]]:
    """Return depth and width of a room's floor models without thresholds, the largest first."""
    sizes = [boxes[key.rsplit("-", 1)[1]] for key in models if _category(key) == "floors"]
    floors = [[round(size[0], 3), round(size[1], 3)] for size in sizes if min(size[:2]) >= LEAST_FLOOR_M]
    return sorted(floors, key=lambda s: (-s[0] * s[1], s))


def _typical_floors(scenes: Json, boxes: Json) -> dict[str, list[float]]:
    """Return the median floor of each room type, for the twelve rooms without a usable floor model."""
    seen: dict[str, list[list[float]]] = defaultdict(list)
    for rooms in scenes.values():
        for name, models in rooms.items():
            seen[_room_type(name)].extend(_floors(models, boxes)[:1])
    return {
        room_type: [round(statistics.median(size[axis] for size in sizes), 3) for axis in (0, 1)]
        for room_type, sizes in seen.items()
        if sizes
    }


def _category(asset_id: str) -> str:
    return asset_id.rsplit("-", 1)[0]


def _room_type(name: str) -> str:
    return name.rsplit("_", 1)[0]


def _read_json(path: Path) -> Json:
    return json.loads(path.read_text(encoding="utf-8"))


def encode(table: Json) -> bytes:
    """Compress a table deterministically: sorted keys, no time stamp, no file name."""
    text = json.dumps(table, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return gzip.compress(text.encode(), compresslevel=9, mtime=0)


def notice(licence: str) -> str:
    """Return the notice for the tables: their source, and the licence with its copyright line."""
    return (
        "# NOTICE: data in this folder\n\n"
        f"`{CATALOG_FILE}`, `{SCENES_FILE}` and `{SUBSTANCES_FILE}` are derived from the Python package `bddl` {BDDL_VERSION}\n"
        "(BEHAVIOR Domain Definition Language, https://github.com/StanfordVL/bddl, `bddl/generated_data/`) by\n"
        "`python -m embomatrix.factory.catalog_tables`: fields were selected and re-keyed, extents rounded to 0.1 mm.\n"
        "The package is distributed under this licence:\n\n"
        f"```\n{licence.strip()}\n```\n"
    )


def _licence_text() -> str:
    files = importlib.metadata.files("bddl") or []
    for file in files:
        if file.name.upper().startswith("LICENSE"):
            return Path(str(file.locate())).read_text(encoding="utf-8")
    raise CatalogSourceError("the installed bddl carries no licence text: reinstall it with pip")


def write_tables(out: Path) -> tuple[Path, ...]:
    """Write all files to ``out``, which is created if missing, and return their paths."""
    folder = source_folder()
    contents = {
        CATALOG_FILE: encode(build_catalog(folder)),
        SCENES_FILE: encode(build_scenes(folder)),
        SUBSTANCES_FILE: encode({"source": f"bddl {BDDL_VERSION}", **build_substances(folder)}),
        NOTICE_FILE: notice(_licence_text()).encode(),
    }
    out.mkdir(parents=True, exist_ok=True)
    for name, data in contents.items():
        (out / name).write_bytes(data)
    return tuple(out / name for name in contents)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the tables and print the files."""
    parser = argparse.ArgumentParser(
        description="Derive the catalog's tables from the installed bddl package."
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to write to")
    options = parser.parse_args(arguments)
    try:
        paths = write_tables(options.out)
    except CatalogSourceError as error:
        parser.exit(2, f"{error}\n")
    for path in paths:
        print(f"{path}  {path.stat().st_size} bytes")  # noqa: T201 - this is the command line


ON: Final = "on"
"""Stands for a substance in the needs of a remover that works when it is switched on."""
DEFAULTS: Final = {
    "default_visual_conditions": "visual",
    "default_fluid_conditions": "liquid",
    "default_non_fluid_conditions": "solid",
}


def build_substances(folder: Path) -> Json:
    """Return the table of substances.

    ``kinds`` maps each substance to "visual" (a film, such as dust), "liquid" or "solid" (grains and pieces).
    ``needs`` are numbered lists: null means never; otherwise one of the substances must soak the tool (``on``: the
    tool must run); empty means no need. ``removers`` map a tool to substances, and to kinds for all others.
    ``washer`` holds the rules of washing machines, ``sources`` the liquids that switched-on objects give, and
    ``halves`` the product of slicing.
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
    """Yield the synsets whose ability has the parameter, in sorted order, with all parameters of the ability."""
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
    """Return the substances of conditions such as ``["saturated", SUBSTANCE]`` or ``["toggled_on", true]``."""
    if conditions is None:
        return None
    return [value if state == "saturated" else ON for state, value in conditions]


if __name__ == "__main__":
    main()
