"""Ports of local clusters."""

import random

from embomatrix.cli import local_cluster
from embomatrix.cli.local_cluster import SERVER_PORTS, free_port


def test_no_port_is_chosen_twice_before_its_server_has_it(monkeypatch):
    first = free_port()
    drawn = [first, first]

    class Repeating(random.Random):
        def choice(self, ports):
            return drawn.pop() if drawn else super().choice(ports)

    monkeypatch.setattr(local_cluster.random, "SystemRandom", Repeating)
    second = free_port()
    assert (second != first, second in SERVER_PORTS, drawn) == (True, True, [])
