"""Machines in network namespaces with a router between them, whose links lose packets without a word. Needs root."""

import json
import os
import subprocess

from tests.fakes.real_cluster import FAKES, RealCluster

PORT = 50070
MANAGER, WORKER, OTHER, TRAINER = "manager", "w1", "w2", "trainer"
MACHINES = (MANAGER, WORKER, OTHER, TRAINER)
_ROUTER = "router"


class Network:
    """Context manager with one namespace per machine. Packets pass a router, which may drop them in one direction."""

    def __enter__(self):
        try:
            for name in (_ROUTER, *MACHINES):
                _ip("netns", "add", _space(name))
            self._in(_ROUTER, "sh", "-c", "echo 1 > /proc/sys/net/ipv4/ip_forward")
            for number, name in enumerate(MACHINES):
                self._connect(number, name)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_):
        for name in (_ROUTER, *MACHINES):
            subprocess.run(["ip", "netns", "delete", _space(name)], stderr=subprocess.DEVNULL, check=False)

    def command(self, name, *command):
        """Return the command that runs ``command`` on a machine, in the same process."""
        return ["ip", "netns", "exec", _space(name), *command]

    def lose(self, sender, receiver):
        """Drop every packet from one machine to another. Neither hears of it."""
        self._rule("add", sender, receiver)

    def pass_again(self, sender, receiver):
        self._rule("delete", sender, receiver)

    def unplug(self, name):
        """Take the machine's link down at the router's end."""
        _ip("-n", _space(_ROUTER), "link", "set", name, "down")

    def plug(self, name):
        _ip("-n", _space(_ROUTER), "link", "set", name, "up")

    def _connect(self, number, name):
        router, machine = _space(_ROUTER), _space(name)
        _ip("link", "add", name, "netns", router, "type", "veth", "peer", "name", "eth0", "netns", machine)
        _ip("-n", router, "address", "add", f"10.77.{number}.1/24", "dev", name)
        _ip("-n", router, "link", "set", name, "up")
        _ip("-n", machine, "address", "add", f"{address_of(name)}/24", "dev", "eth0")
        for link in ("lo", "eth0"):
            _ip("-n", machine, "link", "set", link, "up")
        _ip("-n", machine, "route", "add", "default", "via", f"10.77.{number}.1")

    def _rule(self, change, sender, receiver):
        ends = ("from", address_of(sender), "to", address_of(receiver))
        _ip("-n", _space(_ROUTER), "rule", change, *ends, "blackhole")

    def _in(self, name, *command):
        subprocess.run(self.command(name, *command), check=True, capture_output=True)


def address_of(name):
    return f"10.77.{MACHINES.index(name)}.2"


def why_not():
    """Return why this system lets the test make no network namespaces; empty if it does."""
    try:
        with Network() as network:
            network.lose(WORKER, MANAGER)
    except FileNotFoundError:
        return "the command `ip` is missing (Debian's iproute2)"
    except subprocess.CalledProcessError as error:
        return f"no network namespaces: {error.stderr.decode(errors='replace').strip()}"
    return ""


def _space(name):
    return f"embomatrix-{os.getpid()}-{name}"


def _ip(*arguments):
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


class SplitCluster(RealCluster):
    """Cluster with each process on a machine of the network. The trainer is a process too."""

    def __init__(self, folder, network, **settings):
        # Every message of this network comes from a process of the test.
        super().__init__(folder, host=address_of(MANAGER), insecure_bind=True, **settings)
        self.network = network
        self.ports = {MANAGER: PORT}
        self.results = folder / "results.jsonl"

    @property
    def address(self):
        return f"{address_of(MANAGER)}:{PORT}"

    def start_far_trainer(self, count, task):
        """Start a trainer that opens a run, executes one batch, and writes its results to a file."""
        arguments = (self.address, str(count), task, str(self.results), WORKER)
        self._start(TRAINER, str(FAKES / "far_trainer_process.py"), *arguments)

    def received(self):
        """Return the lines of the trainer so far: a rollout's id and what it got."""
        lines = self.results.read_text().splitlines() if self.results.exists() else []
        return [json.loads(line) for line in lines]

    def trainer_status(self):
        """Return the trainer's exit status; None while it runs."""
        return self.processes[TRAINER].poll()

    def _run(self, name, *command):
        super()._run(name, *self.network.command(name, *command))
