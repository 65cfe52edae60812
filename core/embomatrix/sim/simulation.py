"""Simulators on PyBullet: joins the executor with a concrete physics engine."""

from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.executor import Actor, Simulator
from embomatrix.world.bundle import Bundle


def load_simulator(bundle: Bundle, actor: Actor | None = None, pool: ClientPool | None = None) -> Simulator:
    """Load a bundle's scene into a PyBullet engine with clients of the pool, or with new ones.

    Raises EngineError for a scene that can't be loaded.
    """
    return Simulator(bundle, BulletEngine(bundle.scene, pool), actor)
