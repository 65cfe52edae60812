"""Siege of `bench adversary`: attacks on a manager with honest workers and an honest trainer, and their measured harm.

Every attacker has a token of its own role. Honest results are known in advance, so each delivered result is checked.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import tempfile
import time
import urllib.request
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import psutil

from embomatrix.bench.adversary.attackers import (
    Fight,
    Target,
    browser,
    fast_liar,
    hostile_worker,
    stranger,
    trainer,
)
from embomatrix.bench.cluster.null_worker import prepared_result
from embomatrix.bench.cluster.processes import SERVES, Process, running_manager, running_process
from embomatrix.bench.report.figures import BenchError
from embomatrix.pages.figures import Better, Figure
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.status import ClusterError
from embomatrix.rpc.wire.rollout import rollout_to_proto
from embomatrix.rpc.wire.tokens import AccessRole
from embomatrix.rpc.wire.values import Batch, Completed, GroupPolicy, RolloutResult, RunTerms
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from embomatrix.bench.engine.workload import Workload

ResultT = TypeVar("ResultT")

HONEST: Final = "embomatrix.bench.adversary.honest"
ADMIN: Final = "adversary-benchmark-admin"
"""Secret of the benchmark's own manager, which serves on loopback until the benchmark ends."""
SLOTS: Final = 4
START_S: Final = 60.0
SAMPLE_S: Final = 0.05
BATCH: Final = 40
LAST_WORDS: Final = 2_000
"""Characters of the manager's log that are kept."""
PROBATION: Final = 50
"""Default of the manager's ``audit_probation``: the unaudited results that a new worker may deliver at most."""
LAG: Final = re.compile(r"^embo_manager_longest_lag_seconds (\S+)", re.MULTILINE)
ERRORS: Final = re.compile(r"^embo_errors_total (\S+)", re.MULTILINE)
OPENER: Final = urllib.request.build_opener(urllib.request.ProxyHandler({}))
"""Opens loopback addresses even where a proxy is configured."""


@dataclass(frozen=True, slots=True)
class SiegeSizes:
    """Sizes of a siege: ``messages`` hostile messages, then ``lies`` rollouts in each run beside a fast liar."""

    messages: int = 110_000
    lies: int = 600
    limit_s: float = 540.0
    seed: int = 0


QUICK_SIEGE: Final = SiegeSizes(messages=5_000, lies=200, limit_s=60.0)


@dataclass
class Harm:
    """Harm that the attackers did, and its measure."""

    manager_deaths: int = 0
    fabricated: int = 0
    """Delivered results that no honest worker made."""
    submitted: int = 0
    completed: int = 0
    """Honest rollouts that were delivered with the honest result."""
    rss_growth_mb: float = 0.0
    loop_stall_s: float = 0.0
    """Longest lag of the manager's clock."""
    internal: int = 0
    """Calls that the manager answered with INTERNAL."""
    alarms: int = 0
    """Errors that the manager counted in ``embo_errors_total``."""
    unreadable: list[str] = field(default_factory=list)
    """Lists of the manager that were no valid JSON, or were not served, after the attack."""

    last_words: str = ""
    """End of the manager's log."""

    @property
    def lost(self) -> int:
        return self.submitted - self.completed - self.fabricated


@dataclass
class Field:
    """Manager with honest workers and uploaded scenes."""

    manager: Process
    target: Target
    client: ClusterClient
    workload: Workload
    reward: float
    """Total of every honest result."""


@contextlib.asynccontextmanager
async def battlefield(
    folder: Path, workload: Workload, *options: str, honest: int = 2
) -> AsyncIterator[Field]:
    """Start a manager with tokens and honest workers. Raise BenchError if they don't serve in time."""
    with contextlib.ExitStack() as processes:
        store = (f"--state=sqlite:{folder / 'state.sqlite'}", f"--data-dir={folder / 'manager'}")
        manager = processes.enter_context(running_manager(folder, admin_token(folder), *store, *options))
        served = await asyncio.to_thread(manager.wait_for, SERVES, time.monotonic() + START_S)
        page = served[2].removeprefix("http://").rstrip("/")
        async with occupied(folder, manager, served[1], (served[1], page), workload, honest) as place:
            yield place


def admin_token(folder: Path) -> str:
    """Return the option of a manager whose operator has the secret ``ADMIN``."""
    secret = folder / "admin.token"
    secret.write_text(ADMIN, encoding="ascii")
    return f"--token=@{secret}"


@contextlib.asynccontextmanager
async def occupied(
    folder: Path, manager: Process, addresses: str, target: tuple[str, str], workload: Workload, honest: int
) -> AsyncIterator[Field]:
    """Start honest workers that know the ``addresses``, and upload the scenes.

    ``target`` holds the gRPC and the HTTP address that the attackers use.
    """
    with contextlib.ExitStack() as processes:
        tokens = {f"honest-{number}": folder / f"{number}.token" for number in range(1, honest + 1)}
        for name, file in tokens.items():
            # They start before this process opens a channel: a fork beside gRPC's threads may hang.
            processes.enter_context(
                running_process(folder, name, HONEST, addresses, name, str(file), str(SLOTS))
            )
        async with ClusterClient(addresses, ADMIN) as client:

            async def join() -> str:
                return (await client.issue_token(AccessRole.JOIN))[0]

            for file in tokens.values():
                write_whole(file, (await join()).encode("ascii"))
            await _ready(client, tuple(tokens))
            await client.put_bundles(workload.bundles)
            trainer_token = (await client.issue_token(AccessRole.TRAINER))[0]
            rollouts = [rollout_to_proto(rollout) for rollout in workload.rollouts]
            reward = prepared_result(workload.rollouts[0].plan).reward.total
            yield Field(manager, Target(*target, trainer_token, rollouts, join), client, workload, reward)


async def _ready(client: ClusterClient, names: tuple[str, ...]) -> None:
    try:
        async with asyncio.timeout(START_S):
            while not set(names) <= {worker.worker_id for worker in await client.list_workers()}:  # noqa: ASYNC110  # polls a server
                await asyncio.sleep(SAMPLE_S)
    except TimeoutError:
        raise BenchError(
            f"the honest workers did not join in {START_S:g} s: measure on an idle machine"
        ) from None


def _batch(field_: Field, run_id: str, number: int, size: int) -> Batch:
    known = field_.workload.rollouts
    rollouts = tuple(
        replace(
            known[(number * size + index) % len(known)],
            rollout_id=f"{run_id}-{number}-{index}",
            group_id=f"{number}-{index}",
        )
        for index in range(size)
    )
    return Batch(run_id, f"{run_id}-{number}", number, rollouts)


def _count(harm: Harm, results: list[RolloutResult], reward: float) -> None:
    for result in results:
        if isinstance(result.outcome, Completed):
            honest = abs(result.outcome.reward.total - reward) < 1e-9
            harm.completed += honest
            harm.fabricated += not honest


async def honest_trainer(place: Field, harm: Harm, is_over: Callable[[], bool]) -> None:
    """Submit batch after batch to a verified run until the attack is over, and check every result."""
    terms = RunTerms(GroupPolicy.PARTIAL, verified=True)
    run_id = await place.client.open_run("siege", "siege", terms)
    number = 0
    while number == 0 or not is_over():
        batch = _batch(place, run_id, number, BATCH)
        harm.submitted += len(batch.rollouts)
        results: list[RolloutResult] = []
        with contextlib.suppress(ClusterError):
            results = [result async for result in place.client.execute(batch)]
        _count(harm, results, place.reward)
        number += 1


class Watch:
    """Samples of the manager's memory, as a context manager."""

    def __init__(self, process: Process) -> None:
        self._process = psutil.Process(process.child.pid)
        self._first = self.most = self._rss()

    def _rss(self) -> float:
        with contextlib.suppress(psutil.NoSuchProcess):
            return float(self._process.memory_info().rss) / 1e6
        return 0.0

    @property
    def growth_mb(self) -> float:
        return self.most - self._first

    async def sample(self) -> None:
        while True:
            self.most = max(self.most, self._rss())
            await asyncio.sleep(SAMPLE_S)


@contextlib.asynccontextmanager
async def beside(*coroutines: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
    """Run the coroutines beside the body and cancel them at its end. Raise the first of their errors."""
    tasks = [asyncio.create_task(each) for each in coroutines]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        ended = await asyncio.gather(*tasks, return_exceptions=True)
    for error in ended:
        if isinstance(error, Exception):
            raise error


async def besiege(place: Field, messages: int, seed: int, limit_s: float = 60.0) -> tuple[Harm, Fight]:
    """Send hostile messages of all kinds beside an honest trainer; return the harm and the messages.

    The attack ends early after ``limit_s`` seconds, or when the manager ends.
    """
    harm, fight = Harm(), Fight(messages)
    watch = Watch(place.manager)
    ends_s = time.monotonic() + limit_s
    foreign: deque[Any] = deque(maxlen=64)

    def is_over() -> bool:
        return fight.over or time.monotonic() >= ends_s or place.manager.child.poll() is not None

    attacks = (
        hostile_worker(place.target, fight, 3 * seed + 1, foreign),
        hostile_worker(place.target, fight, 3 * seed + 2, foreign),
        trainer(place.target, fight, seed),
        browser(place.target, fight, seed),
        stranger(place.target, fight, seed),
    )
    async with beside(watch.sample(), *map(_repeated, attacks)):
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(limit_s + START_S):
                await honest_trainer(place, harm, is_over)
    harm.manager_deaths = int(place.manager.child.poll() is not None)
    harm.rss_growth_mb, harm.internal = watch.growth_mb, fight.internal.total()
    await asyncio.to_thread(read_state, place, harm)
    return harm, fight


async def _repeated(attack: Coroutine[Any, Any, None]) -> None:
    """Run an attack to its end. The death of the manager ends it too; it is counted elsewhere."""
    with contextlib.suppress(ClusterError, OSError):
        await attack


def read_state(place: Field, harm: Harm) -> None:
    """Read the lists and metrics that operators see. A list with NaN counts as unreadable: NaN is not valid JSON."""
    for path in ("/api/v1/snapshot", "/api/v1/workers", "/api/v1/runs"):
        try:
            json.loads(_page(place, path), parse_constant=_refuse)
        except (OSError, ValueError) as error:
            harm.unreadable.append(f"{path}: {error}")
    with contextlib.suppress(OSError):
        metrics = _page(place, "/metrics")
        harm.loop_stall_s = float(found[1]) if (found := LAG.search(metrics)) else 0.0
        harm.alarms = int(float(found[1])) if (found := ERRORS.search(metrics)) else 0


def _refuse(constant: str) -> float:
    raise ValueError(f"found {constant}, which is no JSON")


def _page(place: Field, path: str) -> str:
    url = f"http://{place.target.http}{path}"
    request = urllib.request.Request(url, headers={"Authorization": f"Bearer {ADMIN}"})
    with OPENER.open(request, timeout=10) as answer:
        return str(answer.read().decode())


async def tempt(place: Field, rollouts: int, *, verified: bool) -> Harm:
    """Execute a run beside a fast liar, close it at once, and count the made-up results that were delivered."""
    harm = Harm()
    run_id = f"lies-{verified}"
    await place.client.open_run(run_id, run_id, RunTerms(GroupPolicy.PARTIAL, verified=verified))
    async with beside(fast_liar(place.target, f"liar-{run_id}")):
        await _ready(place.client, (f"liar-{run_id}",))
        batch = _batch(place, run_id, 0, rollouts)
        harm.submitted = len(batch.rollouts)
        results = [result async for result in place.client.execute(batch)]
        with contextlib.suppress(ClusterError):
            await place.client.close_run(run_id)
    _count(harm, results, place.reward)
    return harm


def bench_adversary(
    workload: Workload, sizes: SiegeSizes, on_step: Callable[[str], None]
) -> tuple[Figure, ...]:
    """Measure the harm of all attacks. Raise BenchError if the processes don't start."""
    on_step(f"{sizes.messages:,} hostile messages")
    harm, fight = run_siege(workload, sizes)
    on_step("a fast liar")
    return _figures(harm, fight, {each: run_temptation(workload, sizes, each) for each in (True, False)})


def run_siege(workload: Workload, sizes: SiegeSizes) -> tuple[Harm, Fight]:
    """Return the harm of a siege, and the messages of the attackers."""
    return run_alone(_siege, workload, sizes)


def run_temptation(workload: Workload, sizes: SiegeSizes, verified: bool) -> Harm:
    """Return the harm of a fast liar beside two honest workers."""
    return run_alone(_temptation, workload, sizes, verified)


def run_alone(work: Callable[..., ResultT], *arguments: Any) -> ResultT:
    """Run the function in a fresh process. A process with gRPC's threads must not fork the processes of a cluster."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def _siege(workload: Workload, sizes: SiegeSizes) -> tuple[Harm, Fight]:
    async def measure() -> tuple[Harm, Fight]:
        with temporary_folder() as folder:
            async with battlefield(folder, workload) as place:
                harm, fight = await besiege(place, sizes.messages, sizes.seed, sizes.limit_s)
                harm.last_words = place.manager.log.read_text(errors="replace")[-LAST_WORDS:]
                return harm, fight

    return asyncio.run(measure())


def _temptation(workload: Workload, sizes: SiegeSizes, verified: bool) -> Harm:
    async def measure() -> Harm:
        with temporary_folder() as folder:
            async with battlefield(folder, workload, "--audit") as place:
                return await tempt(place, sizes.lies, verified=verified)

    return asyncio.run(measure())


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="embomatrix-bench-") as name:
        yield Path(name)


def _figures(harm: Harm, fight: Fight, lies: dict[bool, Harm]) -> tuple[Figure, ...]:
    sent, low = fight.sent.total(), Better.LOWER
    fabricated = harm.fabricated + lies[True].fabricated
    lost = harm.lost + sum(each.lost for each in lies.values())
    honest = harm.submitted + sum(each.submitted for each in lies.values())
    return (
        Figure("manager_deaths", harm.manager_deaths, "count", low, sent, 0.0),
        Figure("fabricated_delivered", fabricated, "count", low, harm.submitted + lies[True].submitted, 0.0),
        Figure(
            "fabricated_delivered_unverified",
            lies[False].fabricated,
            "count",
            low,
            lies[False].submitted,
            PROBATION,
        ),
        Figure("honest_lost", lost, "count", low, honest, 0.0),
        Figure("rss_growth_mb", harm.rss_growth_mb, "MB", low, sent, 200.0),
        Figure("loop_stall_ms", harm.loop_stall_s * 1e3, "ms", low, sent, 250.0),
        Figure("internal_without_alarm", max(0, harm.internal - harm.alarms), "count", low, sent, 0.0),
        Figure("lists_unreadable", len(harm.unreadable), "count", low, 3, 0.0),
        Figure("hostile_messages", sent, "count", Better.HIGHER, sent, 100_000.0),
        Figure("hostile_kinds", len(fight.sent), "count", Better.HIGHER, sent, 60.0),
    )
