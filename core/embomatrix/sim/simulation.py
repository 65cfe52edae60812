"""Simulators on PyBullet: joins the executor with a concrete physics engine."""

from embomatrix.sim.bullet.client import shared_pool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.executor import Actor, Simulator
from embomatrix.world.bundle import Bundle


def load_simulator(bundle: Bundle, actor: Actor | None = None) -> Simulator:
    """Load a bundle's scene into a new PyBullet engine. Raises EngineError for a scene that can't be loaded."""
    return Simulator(bundle, BulletEngine(bundle.scene), actor)


def load_briefly(bundle: Bundle) -> Simulator:
    """Load a bundle's scene into shared clients, for one of many short checks of nearly equal scenes.

    Raises EngineError for a scene that can't be loaded.
    """
    return Simulator(bundle, BulletEngine(bundle.scene, shared_pool(), keeps_bounds=True))
