"""Random numbers of a step: a generator that is set anew, since to make one costs more than a skill does."""

from __future__ import annotations

import hashlib

import numpy as np


class Draws:
    """One generator for all steps. What it gives at a step depends on the seed and the step only."""

    def __init__(self) -> None:
        self._bits = np.random.PCG64(0)
        self.generator = np.random.Generator(self._bits)

    def go_to(self, seed: int, step: int) -> None:
        """Put the generator at the start of a step's stream.

        State and increment of PCG64 (O'Neill 2014) are the two halves of a hash; any state and any odd increment give a
        full period.
        """
        digest = hashlib.sha256(f"{seed}:{step}".encode()).digest()
        state, increment = (int.from_bytes(half, "little") for half in (digest[:16], digest[16:]))
        self._bits.state = {
            "bit_generator": "PCG64",
            "state": {"state": state, "inc": increment | 1},
            "has_uint32": 0,
            "uinteger": 0,
        }
