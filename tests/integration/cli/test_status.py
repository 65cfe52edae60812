"""`embomatrix status` and `top`: sentences, screen, and a real manager."""

import asyncio
import io

import pytest
from rich.console import Console
from tests.fakes.commands import run
from tests.fakes.worker import FakeWorker
from tests.integration.test_manager_service import manager

from embomatrix.cli.cluster.status import Glance, earliest, rate, screen, sentences, status, top
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.wire.values import (
    FleetStatus,
    PlanCell,
    Resident,
    ResidentState,
    Resources,
    RunInfo,
    RunStats,
    Warmth,
    WorkerInfo,
)


def worker(name="w1", state="ready", *, running=0, completed=0, reason="", residents=()):
    return WorkerInfo(name, state, Resources(2, 4, 1024), residents, running, completed, 0.5, reason)


def test_start_of_a_worker_is_suggested_where_none_is_present():
    empty = sentences(FleetStatus((), "No worker has joined yet."), (), ())
    assert empty[1].startswith("Start a worker with `embomatrix worker run`")


def test_health_sentence_of_the_manager_comes_first():
    full = "Nothing can be written down, so nothing goes on: no space left on device."
    assert sentences(FleetStatus((worker(),), full), (), ())[0] == full
    assert sentences(FleetStatus((), full), (), ())[0] == full, "also without a worker"
    assert full in "\n".join(drawn(Glance(0.0, FleetStatus((worker(),), full), ()), 24))


def test_sentences_cover_runs_warm_scenes_and_idle_workers():
    warm = Resident("sha256:aa", ResidentState.WARM)
    stats = RunStats(delivered=40, warm_starts=30, cold_starts=10, infra_failures=2, redispatched=5)
    plan = [
        PlanCell("r1", 7, "sha256:aa", 8, Warmth.WARM),
        PlanCell("r1", 7, "sha256:bb", 8, Warmth.UNPLACEABLE),
    ]
    shown = sentences(
        FleetStatus(
            (worker(running=1, residents=(warm,)), worker("w2", "paused", reason="somebody uses it"))
        ),
        (RunInfo("r1", "evening", stats, pending=3),),
        plan,
    )
    assert shown[1:] == [
        "Workers: 1 ready, 1 paused; 1 of 2 slots busy; 1 scene is in memory.",
        "Run evening: 40 rollouts done, 75% of them in warm scenes; 2 lost by the infrastructure, 5 re-dispatched; "
        "3 under way.",
        "Look-ahead: 1 of 2 scenes of the next step warm; 1 without room: give workers memory, or start more.",
        "w2 is paused: somebody uses it.",
    ]


def test_workers_that_left_in_order_are_only_counted():
    ready = "Ready: 1 worker waits for a run."
    shown = sentences(FleetStatus((worker(), worker("w2", "left", reason="it left")), ready), (), ())
    assert shown == [
        ready,
        "Workers: 1 ready, 1 left; 0 of 2 slots busy; 0 scenes are in memory.",
    ]


def test_sentences_about_a_thousand_workers_fit_on_a_screen():
    assert len(sentences(FleetStatus(tuple(worker(f"w{n}", "lost") for n in range(1000))), (), ())) < 16


def drawn(now, lines):
    console = Console(file=io.StringIO(), width=120)
    console.print(screen(now, now, lines=lines))
    return console.file.getvalue().splitlines()


def test_screen_shows_idle_workers_first_and_fits_the_terminal():
    crowd = (*(worker(f"w{n:04}", running=n % 3) for n in range(1000)), worker("broken", "lost"))
    lines = drawn(Glance(0.0, FleetStatus(crowd, "All is well."), ()), 24)
    assert len(lines) <= 24
    (first,) = [line for line in lines if line.startswith("broken")]
    assert lines.index(first) < min(n for n, line in enumerate(lines) if line.startswith("w0"))
    assert lines[-1].startswith("and 9")


def test_workers_that_left_have_no_slots_on_the_screen():
    (head, *_) = drawn(Glance(0.0, FleetStatus((worker(running=1), worker("w2", "left"))), ()), 24)
    assert head.split("   ")[1:] == ["1 of 2 slots busy", "1 of 2 workers at work", "0 runs"]


def test_throughput_covers_the_last_seconds_and_is_never_negative():
    glances = [Glance(float(at_s), FleetStatus((worker(completed=100 * at_s),)), ()) for at_s in range(10)]
    assert rate(earliest(glances, 5.0), glances[-1]) == 100.0
    assert rate(glances[-1], Glance(10.0, FleetStatus(()), ())) == 0.0
    assert rate(glances[-1], glances[-1]) == 0.0


async def test_status_and_top_show_a_real_manager(tmp_path, capsys):
    async with manager(tmp_path) as endpoints, FakeWorker(endpoints.address, "w1"):
        await asyncio.to_thread(status, manager=endpoints.address)
        words = capsys.readouterr().out
        await asyncio.to_thread(top, manager=endpoints.address, rounds=1)
        live = capsys.readouterr().out
        async with AdminClient(endpoints.address) as client:
            await client.pause_dispatch()
        await asyncio.to_thread(status, manager=endpoints.address)
        paused = capsys.readouterr().out
    assert "Workers: 1 ready" in words
    assert words.startswith("Ready: 1 worker waits for a run.")
    assert paused.startswith("Dispatch is paused: no new rollouts start")
    assert "0 rollouts/s" in live
    assert "w1" in live


@pytest.mark.parametrize("name", ["status", "top"])
def test_unreachable_manager_is_reported_in_a_sentence(name):
    shown = run(name, "--manager=127.0.0.1:1")
    assert (shown.status, shown.text.startswith(f"embomatrix {name}: no manager answers")) == (2, True)
