"""Connections to Bullet: silent, without the renderer, or a clear error."""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from typing import TYPE_CHECKING, Any, Final

from embomatrix.sim.engine import EngineError, EngineMissingError

if TYPE_CHECKING:
    from collections.abc import Iterator

TINY_RENDERER: Final = 2
"""Index of the plugin that draws pictures on the CPU. With it every body costs ten times as much to create."""


NEAR_M: Final = 0.005
_USUAL_M: Final = 0.02
"""Bullet's own: made for crates and cars. Boxes around bodies are larger by as much, and whose boxes meet wake one another."""


@contextlib.contextmanager
def _stderr_closed() -> Iterator[None]:
    """Discard what C code writes to stderr: pybullet prints its build date when it is imported."""
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
    """The module, imported at the first call. Raises EngineMissingError where it is not installed."""
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
    """Connected clients, kept for reuse: the memory of a fresh one costs more time than loading a scene does.

    A process that forks simulators fills the pool first: its children find the clients connected.
    """

    def __init__(self, spare: int = 0) -> None:
        """Connect ``spare`` clients at once."""
        self._spare = [connect() for _ in range(spare)]

    def take(self) -> int:
        """An empty client. Raises EngineError when Bullet has none left."""
        return self._spare.pop() if self._spare else connect()

    def give_back(self, client: int) -> None:
        """Empty a client and keep it for the next who asks."""
        pybullet().resetSimulation(physicsClientId=client)
        self._spare.append(client)

    def close(self) -> None:
        """Disconnect the spare clients."""
        for client in self._spare:
            pybullet().disconnect(physicsClientId=client)
        self._spare.clear()


def connect() -> int:
    """Open a client without a renderer and return its id. Raises EngineError when Bullet has none left."""
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
    """Whether the renderer answers still: without it Bullet knows nothing of visual shapes and raises."""
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
    """Look at bodies from 5 mm on: of the things on a crowded table, one that is taken wakes only those that it is close to."""
    bullet = pybullet()
    bullet.setPhysicsEngineParameter(contactBreakingThreshold=NEAR_M, physicsClientId=client)
    try:
        yield
    finally:
        bullet.setPhysicsEngineParameter(contactBreakingThreshold=_USUAL_M, physicsClientId=client)
