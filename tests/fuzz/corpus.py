"""Committed inputs of the decoders: one text file each, an input per line in base64."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from tests.fuzz.decoder import Decoder

FOLDER: Final = Path(__file__).parent / "corpus"


def kept_inputs(name: str) -> list[bytes]:
    """Return the committed inputs of a decoder."""
    path = FOLDER / f"{name.replace(' ', '-')}.txt"
    return [base64.b64decode(line) for line in path.read_text("ascii").splitlines()] if path.exists() else []


def inputs_of(name: str, decoder: Decoder) -> list[bytes]:
    """Return the seeds and the committed inputs of a decoder."""
    return [*decoder.seeds(), *kept_inputs(name)]


def keep(name: str, inputs: Iterable[bytes]) -> None:
    """Replace the committed inputs of a decoder."""
    path = FOLDER / f"{name.replace(' ', '-')}.txt"
    lines = sorted(
        (base64.b64encode(data).decode("ascii") for data in inputs), key=lambda line: (len(line), line)
    )
    if lines:
        FOLDER.mkdir(exist_ok=True)
        path.write_text("".join(f"{line}\n" for line in lines), "ascii")
    else:
        path.unlink(missing_ok=True)
