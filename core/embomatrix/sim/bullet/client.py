"""Connections to Bullet: silent and without the renderer."""

import contextlib
import functools
import inspect
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
            "3.11 on x86-64 Linux; install embomatrix[worker] there, or build a wheel in a clone with `make physics-wheel`"
        ) from error
    return module


class BulletClient:
    """Bullet's functions, bound to one physics client, and its constants."""

    def __init__(self, number: int) -> None:
        self._number = number

    def __getattr__(self, name: str) -> Any:
        """Bind a function at its first use; later uses find it in the instance."""
        found = getattr(pybullet(), name)
        if inspect.isbuiltin(found):
            found = functools.partial(found, physicsClientId=self._number)
        setattr(self, name, found)
        return found


class ClientPool:
    """Pool of connected clients: the memory of a new one costs more time than loading a scene.

    A process that forks simulators fills the pool first, so that its children inherit connected clients.
    """

    def __init__(self, spare: int = 0) -> None:
        """Connect ``spare`` clients at once."""
        self._spare = [connect() for _ in range(spare)]

    def take(self) -> BulletClient:
        """Take an empty client. Raises EngineError if Bullet has none left."""
        return self._spare.pop() if self._spare else connect()

    def give_back(self, client: BulletClient) -> None:
        """Empty a client and keep it for reuse."""
        client.resetSimulation()
        self._spare.append(client)

    def close(self) -> None:
        """Disconnect the spare clients."""
        for client in self._spare:
            client.disconnect()
        self._spare.clear()


@functools.cache
def shared_pool() -> ClientPool:
    """Pool for the short-lived engines of this process: a layout opens one for each attempt."""
    return ClientPool()


def connect(*, renders: bool = False) -> BulletClient:
    """Open a client, without a renderer unless it ``renders``. Raises EngineError if Bullet has none left."""
    bullet = pybullet()
    number = int(bullet.connect(bullet.DIRECT))
    if number < 0:
        raise EngineError(
            "Bullet opened no physics client: a process may hold 1,023 of them; close engines that are not in use"
        )
    client = BulletClient(number)
    if renders:
        return client
    client.unloadPlugin(TINY_RENDERER)
    if _renders(client):
        client.disconnect()
        raise EngineError(
            f"plugin {TINY_RENDERER} of pybullet is not its renderer: expected version 3.2.7; install that one"
        )
    return client


def _renders(client: BulletClient) -> bool:
    """Return True if the renderer still answers: without it Bullet raises on queries about visual shapes."""
    body = client.createMultiBody(0, client.createCollisionShape(client.GEOM_SPHERE, radius=0.1))
    try:
        client.getVisualShapeData(body)
    except client.error:
        return False
    finally:
        client.resetSimulation()
    return True


@contextlib.contextmanager
def near_contacts(client: BulletClient) -> Iterator[None]:
    """Reduce the contact distance to 5 mm: an object taken from a crowded table then wakes only close neighbours.

    Bullet has one such number for all clients of a process, so the default returns afterwards.
    """
    client.setPhysicsEngineParameter(contactBreakingThreshold=NEAR_M)
    try:
        yield
    finally:
        client.setPhysicsEngineParameter(contactBreakingThreshold=_USUAL_M)
