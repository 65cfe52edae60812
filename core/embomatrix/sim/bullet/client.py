"""Connections to Bullet: silent and without the renderer."""

import contextlib
import functools
import os
import sys
from collections.abc import Iterator
from typing import Any, Final

from embomatrix.sim.engine import EngineError, EngineMissingError

TINY_RENDERER: Final = 2
"""Index of the CPU renderer plugin. With it every body costs ten times as much to create."""


NEAR_M: Final = 0.005
_USUAL_M: Final = 0.02
"""Bullet's default contact distance. It enlarges body boxes, and bodies with touching boxes wake one another."""


@contextlib.contextmanager
def _stderr_closed() -> Iterator[None]:
    """Discard stderr of C code: pybullet prints its build date on import."""
    sys.stderr.flush()
    kept = os.dup(2)
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(null)
        os.close(kept)


@functools.cache
def pybullet() -> Any:
    """Return the module, imported at the first call. Raises EngineMissingError if it is not installed."""
    try:
        with _stderr_closed():
            import pybullet as module
    except ImportError as error:
        raise EngineMissingError(
            "the physics engine is missing: expected the package pybullet 3.2.7, which has wheels for Python up to "
            "3.11 on x86-64 Linux; install embomatrix[worker] there"
        ) from error
    return module


class ClientPool:
    """Pool of connected clients: the memory of a new one costs more time than loading a scene.

    A process that forks simulators fills the pool first, so that its children inherit connected clients.
    """

    def __init__(self, spare: int = 0) -> None:
        """Connect ``spare`` clients at once."""
        self._spare = [connect() for _ in range(spare)]

    def take(self) -> int:
        """Take an empty client. Raises EngineError if Bullet has none left."""
        return self._spare.pop() if self._spare else connect()

    def give_back(self, client: int) -> None:
        """Empty a client and keep it for reuse."""
        pybullet().resetSimulation(physicsClientId=client)
        self._spare.append(client)

    def close(self) -> None:
        """Disconnect the spare clients."""
        for client in self._spare:
            pybullet().disconnect(physicsClientId=client)
        self._spare.clear()


def connect() -> int:
    """Open a client without a renderer and return its id. Raises EngineError if Bullet has none left."""
    bullet = pybullet()
    client = int(bullet.connect(bullet.DIRECT))
    if client < 0:
        raise EngineError(
            "Bullet opened no physics client: a process may hold 1,023 of them; close engines that are not in use"
        )
    bullet.unloadPlugin(TINY_RENDERER, physicsClientId=client)
    if _renders(client):
        bullet.disconnect(physicsClientId=client)
        raise EngineError(
            f"plugin {TINY_RENDERER} of pybullet is not its renderer: expected version 3.2.7; install that one"
        )
    return client


def _renders(client: int) -> bool:
    """Return True if the renderer still answers: without it Bullet raises on queries about visual shapes."""
    bullet = pybullet()
    shape = bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=0.1, physicsClientId=client)
    body = bullet.createMultiBody(0, shape, physicsClientId=client)
    try:
        bullet.getVisualShapeData(body, physicsClientId=client)
    except bullet.error:
        return False
    finally:
        bullet.resetSimulation(physicsClientId=client)
    return True


@contextlib.contextmanager
def near_contacts(client: int) -> Iterator[None]:
    """Reduce the contact distance to 5 mm: an object taken from a crowded table then wakes only close neighbours.

    Bullet has one such number for all clients of a process, so the default returns afterwards.
    """
    bullet = pybullet()
    bullet.setPhysicsEngineParameter(contactBreakingThreshold=NEAR_M, physicsClientId=client)
    try:
        yield
    finally:
        bullet.setPhysicsEngineParameter(contactBreakingThreshold=_USUAL_M, physicsClientId=client)
