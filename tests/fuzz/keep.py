"""Keep the found inputs that reach lines which no known input reaches: ``python -m tests.fuzz.keep [NAME ...]``.

It reads ``build/fuzz`` and rewrites ``tests/fuzz/corpus``, the smallest inputs first.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from types import FrameType
from typing import Any, Final

from tests.fuzz.corpus import keep, kept_inputs
from tests.fuzz.decoder import Decoder
from tests.fuzz.decoders import decoders, forget_inputs
from tests.fuzz.search import folder_of

LARGEST: Final = 4_000
"""Most bytes of an input that is kept."""
MOST: Final = 9_000
"""Most bytes of all kept inputs of a decoder."""

Step = tuple[str, int, int]
"""File, and the numbers of two lines that ran one after the other."""


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.keep", description=__doc__)
    parser.add_argument("names", nargs="*", help="decoders; all of them by default")
    known = decoders()
    for name in parser.parse_args().names or known:
        chosen = choose(known[name], [*kept_inputs(name), *found_inputs(name)])
        keep(name, chosen)
        print(f"{name:<32} {len(chosen):>4} inputs of {sum(map(len, chosen)):>6,} bytes", flush=True)
    return 0


def found_inputs(name: str) -> list[bytes]:
    """Return the inputs in the decoder's folder of the last searches."""
    folder = folder_of(name)
    return [path.read_bytes() for path in sorted(folder.iterdir())] if folder.is_dir() else []


def choose(decoder: Decoder, inputs: Iterable[bytes]) -> list[bytes]:
    """Return inputs that each reach a step which neither a seed nor a smaller input reaches."""
    for data in decoder.seeds():
        decoder.check(data)  # Imports modules late.
    reached = set().union(*(steps_of(decoder, data) for data in decoder.seeds()))
    chosen: list[bytes] = []
    for data in sorted(set(inputs), key=lambda data: (len(data), data)):
        if len(data) > LARGEST or sum(map(len, chosen)) + len(data) > MOST:
            break
        steps = steps_of(decoder, data)
        if not steps <= reached:
            reached |= steps
            chosen.append(data)
    return chosen


def steps_of(decoder: Decoder, data: bytes) -> set[Step]:
    """Decode the input and return the steps in the program's own code."""
    found: set[Step] = set()

    def on_call(frame: FrameType, event: str, argument: Any) -> Any:
        del event, argument
        file = frame.f_code.co_filename
        if "/embomatrix/" not in file:
            return None
        before = 0

        def on_line(frame: FrameType, event: str, argument: Any) -> Any:
            nonlocal before
            del argument
            if event == "line":
                found.add((file, before, frame.f_lineno))
                before = frame.f_lineno
            return on_line

        return on_line

    forget_inputs()
    sys.settrace(on_call)
    try:
        decoder.check(data)
    finally:
        sys.settrace(None)
    return found


if __name__ == "__main__":
    sys.exit(main())
