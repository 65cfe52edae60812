"""Ports of local clusters."""

import random

from embomatrix.cli import local_cluster
from embomatrix.cli.local_cluster import free_port


def test_no_port_is_chosen_twice_before_its_server_has_it(monkeypatch):
    first = free_port()

    class Drawn:
        ports = [first, first, first + 1 if first + 1 in local_cluster.SERVER_PORTS else first - 1]

        def choice(self, _):
            return self.ports.pop(0) if self.ports else random.choice(local_cluster.SERVER_PORTS)

    monkeypatch.setattr(local_cluster.random, "SystemRandom", Drawn)
    assert free_port() != first
