"""Sequence of hostile calls and messages as a decoder: the bytes make every choice of the attackers."""

from __future__ import annotations

import functools
import random
from pathlib import Path

from tests.fuzz.decoder import Decoder, in_file, mutate_bytes

from embomatrix.bench.adversary.inside import run_in_order
from embomatrix.bench.adversary.sequences import Played, provoke
from embomatrix.bench.engine.workload import PINNED, Workload, load_workload

BYTES_PER_STEP = 24
MOST_STEPS = 40


class _Drawn(random.Random):
    """Takes its numbers from bytes, and after the last one from a fixed seed."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0
        super().__init__(0)

    def getrandbits(self, k: int, /) -> int:
        size = (k + 7) // 8
        part = self._data[self._at : self._at + size]
        self._at += size
        return (
            super().getrandbits(k) if len(part) < size else int.from_bytes(part, "little") >> (8 * size - k)
        )

    def random(self) -> float:
        return self.getrandbits(16) / 65_536


@functools.cache
def _workload() -> Workload:
    return load_workload(PINNED)


def _play(data: bytes) -> Played:
    """Play the sequence. Raise AssertionError if the manager fails."""
    steps = min(len(data) // BYTES_PER_STEP, MOST_STEPS)
    folder = Path(in_file("sequences/x", b"")).parent
    played = run_in_order(provoke(_Drawn(data), steps, _workload(), folder))
    assert not played.tracebacks, (played.steps, played.tracebacks)
    assert "INTERNAL" not in played.statuses, played.steps
    return played


def table() -> dict[str, Decoder]:
    return {
        "sequence of messages": Decoder(
            _play,
            (),
            lambda: tuple(random.Random(seed).randbytes(40 * BYTES_PER_STEP) for seed in range(6)),
            frozenset(),
            mutate_bytes,
            most_s=10.0,
        )
    }
