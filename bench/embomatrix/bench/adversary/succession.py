"""Siege of two managers on one Redis, whose leader is killed in the middle. The standby is attacked before and after."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import re
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from embomatrix.bench.adversary.attackers import (
    Fight,
    Target,
    browser,
    hostile_worker,
    stranger,
    trainer,
)
from embomatrix.bench.adversary.siege import (
    LAST_WORDS,
    SAMPLE_S,
    START_S,
    Field,
    Harm,
    Watch,
    admin_token,
    beside,
    honest_trainer,
    occupied,
    read_state,
    run_alone,
    temporary_folder,
)
from embomatrix.bench.cluster.processes import SERVES, Process, kill_tree, redis_server, running_process
from embomatrix.cli.local_cluster import free_port
from embomatrix.rpc.status import ClusterError

if TYPE_CHECKING:
    from embomatrix.bench.engine.workload import Workload

STANDS_BY: Final = re.compile(r"manager stands by")
KILLED_AFTER: Final = 0.4
"""Share of the siege after which the leader is killed."""
Attack = Callable[[Target, Fight, int], Coroutine[Any, Any, None]]
UNLIMITED: Final = 10**9


@dataclass
class Succession:
    """Harm of a siege, and the hostile messages."""

    harm: Harm
    fight: Fight
    took_over: bool


@dataclass
class _Pair:
    place: Field
    """The leader's field."""
    standby: Process
    second: Target


@contextlib.asynccontextmanager
async def _pair(folder: Path, workload: Workload) -> AsyncIterator[_Pair]:
    """Start Redis, a leader, a standby and honest workers that know both."""
    with contextlib.ExitStack() as processes:
        redis = processes.enter_context(redis_server(folder))
        ports = {name: (free_port(), free_port()) for name in ("leader", "standby")}
        shared = (admin_token(folder), f"--state={redis.url}", f"--data-dir={folder / 'manager'}")
        managers: dict[str, Process] = {}
        for name, pattern in (("leader", SERVES), ("standby", STANDS_BY)):
            port, http = ports[name]
            serve = ("embomatrix.cli", "manager", "serve", f"--port={port}", f"--http-port={http}")
            managers[name] = processes.enter_context(running_process(folder, name, *serve, *shared))
            await asyncio.to_thread(managers[name].wait_for, pattern, time.monotonic() + START_S)
        first, second = ((f"127.0.0.1:{port}", f"127.0.0.1:{http}") for port, http in ports.values())
        both = f"{first[0]},{second[0]}"
        async with occupied(folder, managers["leader"], both, first, workload, honest=2) as place:
            target = replace(place.target, address=second[0], http=second[1])
            yield _Pair(place, managers["standby"], target)


async def _besiege(pair: _Pair, duration_s: float, seed: int) -> Succession:
    place, standby = pair.place, pair.standby
    harm, fight = Harm(), Fight(UNLIMITED)
    ends_s = time.monotonic() + duration_s

    def is_over() -> bool:
        return time.monotonic() >= ends_s or standby.child.poll() is not None

    foreign: deque[Any] = deque(maxlen=64)
    kinds: tuple[Attack, ...] = (
        functools.partial(hostile_worker, foreign=foreign),
        trainer,
        browser,
        stranger,
    )
    attacks = [
        _persistent(functools.partial(attack, target, fight, seed + 10 * index + number), is_over)
        for index, target in enumerate((place.target, pair.second))
        for number, attack in enumerate(kinds)
    ]

    async def kill_leader() -> None:
        await asyncio.sleep(KILLED_AFTER * duration_s)
        kill_tree(place.manager.child.pid)

    watch = Watch(standby)
    async with beside(watch.sample(), kill_leader(), *attacks):
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(duration_s + START_S):
                await honest_trainer(place, harm, is_over)
        fight.most = 0
    harm.manager_deaths = int(standby.child.poll() is not None)
    harm.rss_growth_mb, harm.internal = watch.growth_mb, fight.internal.total()
    await asyncio.to_thread(read_state, replace(place, target=pair.second), harm)
    said = standby.log.read_text(errors="replace")
    harm.last_words = said[-LAST_WORDS:]
    return Succession(harm, fight, SERVES.search(said) is not None)


async def _persistent(attack: Callable[[], Coroutine[Any, Any, None]], is_over: Callable[[], bool]) -> None:
    """Attack again after each failure, since the leader dies and the standby refuses everything at first."""
    while not is_over():
        with contextlib.suppress(ClusterError, OSError):
            await attack()
        await asyncio.sleep(SAMPLE_S)


def run_succession(workload: Workload, duration_s: float, seed: int) -> Succession:
    """Return the harm of a siege of two managers."""
    return run_alone(_succession, workload, duration_s, seed)


def _succession(workload: Workload, duration_s: float, seed: int) -> Succession:
    async def measure() -> Succession:
        with temporary_folder() as folder:
            async with _pair(folder, workload) as pair:
                return await _besiege(pair, duration_s, seed)

    return asyncio.run(measure())
