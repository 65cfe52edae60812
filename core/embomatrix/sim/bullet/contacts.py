"""From how near on Bullet looks at two bodies. It is one number for all clients of a process, so it is set only for a while."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Final

from embomatrix.sim.bullet.client import pybullet

if TYPE_CHECKING:
    from collections.abc import Iterator

NEAR_M: Final = 0.005
_USUAL_M: Final = 0.02
"""Bullet's own: made for crates and cars. Boxes around bodies are larger by as much, and whose boxes meet wake one another."""


@contextlib.contextmanager
def near_contacts(client: int) -> Iterator[None]:
    """Look at bodies from 5 mm on: of the things on a crowded table, one that is taken wakes only those that it is close to."""
    bullet = pybullet()
    bullet.setPhysicsEngineParameter(contactBreakingThreshold=NEAR_M, physicsClientId=client)
    try:
        yield
    finally:
        bullet.setPhysicsEngineParameter(contactBreakingThreshold=_USUAL_M, physicsClientId=client)
