"""Search for the bundle that takes the most memory within the limits.

A bundle is a small sound scene with more elements of some kinds. Each kind costs content bytes and JSON values and gives
objects, so the worst bundle is a mixture of few kinds. ``python -m tests.fuzz.worst_bundle`` prints the worst ones.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import string
import tracemalloc
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from tests.fakes.tiny_scene import tiny_bundle

from embomatrix.manager.web.floor_plan import floor_plan, moments_of, movable_objects
from embomatrix.skills.prompt import situation_of
from embomatrix.world.bundle import decode_bundle, encode_bundle
from embomatrix.world.bundle_head import FORMAT, HEAD, MAGIC
from embomatrix.world.inflation import DEFAULT_LIMITS, BundleError

Head = dict[str, Any]
Arrays = dict[str, bytes]
SHAPES: Final = {"poses": 7, "parts": 10, "kinds": 2, "vertices": 3, "stands": 3, "sets": 5, "spots": 7}
"""Columns of the arrays of a bundle."""
FREE: Final = 1_000_000
"""Bytes of content that are allowed beyond the ratio to the compressed bytes, rounded down."""
WIDTHS: Final = {"kinds": 4, "sets": 4}
"""Bytes of a number, 8 in the other arrays."""


@dataclass(frozen=True)
class Growth:
    """Memory of decoding one bundle. ``kept_mb`` remains while the bundle is held."""

    mixture: Mapping[str, int]
    compressed: int
    content: int
    peak_mb: float
    kept_mb: float
    accepted: bool


def _small() -> tuple[Head, Arrays]:
    content = zlib.decompress(encode_bundle(tiny_bundle()))
    _, _, size = HEAD.unpack_from(content)
    head: Head = json.loads(content[HEAD.size : HEAD.size + size])
    arrays, at = {}, HEAD.size + size
    for name, (_, *shape) in head["arrays"].items():
        end = at + math.prod(shape) * WIDTHS.get(name, 8)
        arrays[name] = content[at:end]
        at = end + -end % 8
    return head, arrays


def packed(head: Head, arrays: Arrays) -> bytes:
    """Return the compressed bundle. Random characters in a text at its beginning keep every part of it within the ratio."""
    for name, data in arrays.items():
        width = WIDTHS.get(name, 8)
        rows = len(data) // width // SHAPES[name]
        head["arrays"][name] = [f"<{'i' if width == 4 else 'f'}{width}", rows, SHAPES[name]]
    body = b"".join(data + bytes(-len(data) % 8) for data in arrays.values())
    data = _compressed(head, body)
    for _ in range(3):
        lacking = int((len(zlib.decompress(data)) - FREE) / DEFAULT_LIMITS.ratio * 1.05) - len(data)
        if lacking <= 0:
            break
        noise = random.Random(1).choices(
            string.ascii_letters + string.digits, k=len(head["scene"]["base"]) + 2 * lacking
        )
        head["scene"] = {
            "base": "".join(noise),
            **{key: value for key, value in head["scene"].items() if key != "base"},
        }
        data = _compressed(head, body)
    return data


def _compressed(head: Head, body: bytes) -> bytes:
    text = json.dumps({"scene": head["scene"], **head}, separators=(",", ":")).encode()
    text += b" " * (-(HEAD.size + len(text)) % 8)
    return zlib.compress(HEAD.pack(MAGIC, FORMAT, len(text)) + text + body, 6)


Add = Callable[[Head, Arrays, int], None]


def _poses(head: Head, arrays: Arrays, count: int) -> None:
    del head
    arrays["poses"] += arrays["poses"][: 7 * 8] * count


def _stands(head: Head, arrays: Arrays, count: int) -> None:
    del head
    arrays["stands"] += arrays["stands"][: 3 * 8] * count


def _spots(head: Head, arrays: Arrays, count: int) -> None:
    del head
    arrays["spots"] += arrays["spots"][: 7 * 8] * count


def _boxes(head: Head, arrays: Arrays, count: int) -> None:
    del head
    arrays["parts"] += arrays["parts"][: 10 * 8] * count
    arrays["kinds"] += arrays["kinds"][: 2 * 4] * count


def _hulls(corners: int) -> Add:
    import struct

    def add(head: Head, arrays: Arrays, count: int) -> None:
        del head
        points = [(x, y, z) for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)] * (corners // 4)
        arrays["parts"] += arrays["parts"][: 10 * 8] * count
        arrays["kinds"] += struct.pack("<2i", _HULL, corners) * count
        arrays["vertices"] += struct.pack(f"<{3 * corners}d", *sum(points[1 : corners + 1], ())) * count

    return add


def _names(head: Head, arrays: Arrays, count: int) -> None:
    del arrays
    head["scene"]["left_out"] += ["é" + str(number) for number in range(count)]


def _stand_names(head: Head, arrays: Arrays, count: int) -> None:
    del arrays
    head["poses"]["stands"] |= {f"{number:x}": [0, 1] for number in range(count)}


def _barred(head: Head, arrays: Arrays, count: int) -> None:
    del arrays
    head["poses"]["barred_places"] = {"ontop": {f"{number:x}": {"b": "c"} for number in range(count)}}


def _reached(head: Head, arrays: Arrays, count: int) -> None:
    del arrays
    head["poses"]["reached"] = {"ontop": {f"{number:x}": {"b": 99999} for number in range(count)}}


def _doorways(head: Head, arrays: Arrays, count: int) -> None:
    del arrays
    head["scene"]["doorways"] += head["scene"]["doorways"][:1] * count


def _windows(head: Head, arrays: Arrays, count: int) -> None:
    del arrays
    window = {
        "rooms": ["", ""],
        "center_m": [0, 0],
        "width_m": 1,
        "sill_m": 0,
        "head_m": 1,
        "along": "x",
        "model": "",
    }
    head["scene"]["windows"] = [window] * count


def _abilities(head: Head, arrays: Arrays, count: int) -> None:
    del arrays
    asset = next(iter(head["scene"]["assets"].values()))
    asset["abilities"] |= {f"{number:x}": {"a": 1.5} for number in range(count)}


def _supports(head: Head, arrays: Arrays, count: int) -> None:
    del arrays
    asset = next(iter(head["scene"]["assets"].values()))
    surface = {"name": "a", "center_m": [0, 0, 0], "size_m": [1, 1], "clearance_m": 1, "interior": ""}
    asset["supports"] += [surface] * count


def _assets(head: Head, arrays: Arrays, count: int) -> None:
    del arrays
    asset = next(each for each in head["scene"]["assets"].values() if len(each["links"]) == 1)
    body = {**asset, "links": [{"name": "b", "parts": [0]}]}
    head["scene"]["assets"] |= {f"{number:x}": {**body, "asset_id": f"{number:x}"} for number in range(count)}


def _objects(head: Head, arrays: Arrays, count: int) -> None:
    """Objects outside the world, which need no place of their own."""
    del arrays
    thing = head["scene"]["objects"][1]
    head["scene"]["objects"] += [
        {**thing, "name": f"{n:x}", "absent": True, "pieces": ["0"] * 20} for n in range(count)
    ]


def _types(head: Head, arrays: Arrays, count: int) -> None:
    del arrays
    head["tasks"][0]["types"] |= {f"{number:x}": ["apple_1"] for number in range(count)}


def _tasks(head: Head, arrays: Arrays, count: int) -> None:
    del arrays
    task = {**head["tasks"][0], "types": {}}
    head["tasks"] += [{**task, "task_id": f"{number:x}"} for number in range(count)]


def _goal(head: Head, arrays: Arrays, count: int) -> None:
    """One goal of many atoms."""
    del arrays
    head["tasks"][0]["goal"] = f"(and {'(open fridge_1)' * count})"


def _goals(head: Head, arrays: Arrays, count: int) -> None:
    """Many tasks with goals of a hundred atoms."""
    del arrays
    task = {**head["tasks"][0], "types": {}, "goal": f"(and {'(open fridge_1)' * 100})"}
    head["tasks"] += [{**task, "task_id": f"{number:x}"} for number in range(count)]


def _deep_goals(head: Head, arrays: Arrays, count: int) -> None:
    """Goals of nested lists."""
    del arrays
    goal = "(not " * 60 + "(open fridge_1)" + ")" * 60
    task = {**head["tasks"][0], "types": {}, "goal": goal}
    head["tasks"] += [{**task, "task_id": f"{number:x}"} for number in range(count)]


def _long_text(head: Head, arrays: Arrays, count: int) -> None:
    """One text whose last character makes every other take four bytes in memory."""
    del arrays
    head["scene"]["left_out"].append("a" * count + "\U0001f600")


def _described(head: Head, arrays: Arrays, count: int) -> None:
    """Empty arrays with names."""
    del arrays
    head["arrays"] |= {f"prepared.{number:x}": ["|u1", 0] for number in range(count)}


_HULL: Final = 3
KINDS: Final[Mapping[str, Add]] = {
    "poses": _poses,
    "stands": _stands,
    "spots": _spots,
    "boxes": _boxes,
    "hulls of 4": _hulls(4),
    "hulls of 64": _hulls(64),
    "names": _names,
    "stand names": _stand_names,
    "barred": _barred,
    "reached": _reached,
    "doorways": _doorways,
    "windows": _windows,
    "abilities": _abilities,
    "supports": _supports,
    "assets": _assets,
    "objects": _objects,
    "types": _types,
    "tasks": _tasks,
    "one goal": _goal,
    "goals": _goals,
    "deep goals": _deep_goals,
    "characters": _long_text,
    "described arrays": _described,
}


def bundle_with(mixture: Mapping[str, int]) -> bytes:
    """Return the small bundle with these numbers of elements."""
    head, arrays = _small()
    for kind, count in mixture.items():
        KINDS[kind](head, arrays, count)
    return packed(head, arrays)


def measured(mixture: Mapping[str, int]) -> Growth:
    """Decode a bundle and show it, as workers, trainers and the gallery do, and return the memory that it took."""
    data = bundle_with(mixture)
    content = len(zlib.decompress(data))
    accepted = True
    held: list[object] = []
    tracemalloc.start()
    try:
        bundle = decode_bundle(data)
        held.append(bundle)
        held.append(floor_plan(bundle.scene))
        for task in list(bundle.tasks.values())[:1]:
            held += [
                task.goal_objects,
                movable_objects(bundle.scene, task),
                moments_of(bundle.scene, task, ()),
            ]
            held.append(situation_of(bundle.scene, task))
    except BundleError:
        accepted = False
    kept, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return Growth(dict(mixture), len(data), content, peak / 1e6, kept / 1e6, accepted)


def most_of(kind: str, others: Mapping[str, int] | None = None, largest: int = 1 << 25) -> int:
    """Return the largest number of elements of a kind that a bundle may have beside others, to a few per cent."""
    low, high = 0, 64
    while high <= largest and _fits({**(others or {}), kind: high}):
        low, high = high, high * 2
    while high - low > max(1, low // 32):
        middle = (low + high) // 2
        low, high = (middle, high) if _fits({**(others or {}), kind: middle}) else (low, middle)
    return low


def _fits(mixture: Mapping[str, int]) -> bool:
    data = bundle_with(mixture)
    if len(data) > DEFAULT_LIMITS.compressed_bytes:
        return False
    try:
        decode_bundle(data)
    except BundleError:
        return False
    return True


def worst(kinds: int = 5, on_growth: Callable[[Growth], None] = lambda growth: None) -> Growth:
    """Fill the limits with each kind alone, then with pairs of the worst kinds; return the worst growth."""
    alone = {kind: measured({kind: most_of(kind)}) for kind in KINDS}
    for growth in alone.values():
        on_growth(growth)
    ranked = sorted(alone, key=lambda kind: -alone[kind].peak_mb)[:kinds]
    found = [alone[ranked[0]]]
    for first in ranked:
        for second in ranked:
            half = {first: alone[first].mixture[first] // 2}
            if first != second:
                found.append(measured({**half, second: most_of(second, half)}))
                on_growth(found[-1])
    return max(found, key=lambda growth: growth.peak_mb)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.worst_bundle", description=__doc__)
    parser.add_argument("--pairs", type=int, default=5, help="number of the worst kinds that are combined")
    given = parser.parse_args()

    def show(growth: Growth) -> None:
        parts = " + ".join(f"{count:,} {kind}" for kind, count in growth.mixture.items())
        print(
            f"{growth.peak_mb:7.0f} MB at the peak, {growth.kept_mb:6.0f} MB kept, from {growth.compressed / 1e3:7,.0f} kB "
            f"({growth.content / 1e6:6.1f} MB of content): {parts}",
            flush=True,
        )

    print("worst:", end=" ")
    show(worst(given.pairs, show))


if __name__ == "__main__":
    main()
