"""The front door to episodes in Python: an environment over a dataset, executed in this process or on a cluster."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from embomatrix.envs.environment import Environment
from embomatrix.envs.rules import EpisodeRules, member, rules_of
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.skills.prompt import Codec
from embomatrix.starter.shipped import STARTER, dataset_named

if TYPE_CHECKING:
    from pathlib import Path

    from embomatrix.envs.simulation import Simulation
    from embomatrix.world.dataset import Dataset


def make(
    dataset: str | Path = STARTER,
    *,
    split: str = "heldout",
    visibility: str | None = None,
    rules: EpisodeRules | None = None,
    reward: RewardSettings = PAPER,
    codec: str = Codec.LINES,
    manager: str = "",
    token: str = "",
    ca: bytes = b"",
    seed: int = 0,
) -> Environment:
    """Open an environment over the tasks of a dataset: ``starter`` or ``search``, which ship, or a folder.

    ``visibility`` is ``full`` or ``seen``, that of the ``rules`` if it is not given; ``reward`` has the coefficients of the
    reward; ``codec`` is ``lines``, ``json`` or ``names``. With the address of a ``manager``, turns are executed on its cluster,
    else in this process. ``seed`` draws tasks.

    Raises ValueError for an unknown word, DatasetError for a missing dataset, ClusterError if the manager refuses.
    """
    known = rules_of(rules, visibility)
    form = member(Codec, "codec", codec)
    loaded = dataset_named(dataset)
    simulation = _simulation(loaded, reward, manager, token, ca)
    return Environment(loaded, split, known, form, simulation, seed)


def make_where_named(dataset: str, split: str, rules: EpisodeRules, manager: str = "") -> Environment:
    """Open an environment on the cluster that ``manager`` or ``EMBOMATRIX_MANAGER`` names, or in this process if none does.

    Raises what ``make`` raises.
    """
    if not (manager or os.environ.get("EMBOMATRIX_MANAGER")):
        return make(dataset, split=split, rules=rules)
    from embomatrix.rpc.cluster_address import cluster_named  # needs gRPC

    named = cluster_named(manager)
    return make(dataset, split=split, rules=rules, manager=named.manager, token=named.token, ca=named.ca)


def _simulation(dataset: Dataset, reward: RewardSettings, address: str, token: str, ca: bytes) -> Simulation:
    """Import what the place needs and nothing else: trainers have no simulator, and most scripts no gRPC."""
    if not address:
        from embomatrix.envs.turns import LocalSimulation

        return LocalSimulation(dataset, reward)
    from embomatrix.envs.simulation import ClusterSimulation
    from embomatrix.rpc.client import ClusterClient

    return ClusterSimulation(dataset, lambda: ClusterClient(address, token, ca=ca), reward)
