"""Operator errors in a cluster: addresses, ports, tokens, state, damaged bundles, interrupts."""

import contextlib
import re
import socket
import zlib
from pathlib import Path

import pytest
from tests.fakes.commands import background, run, run_anew

from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.status import InvalidRequestError
from embomatrix.rpc.wire.values import Batch, Completed, Rollout
from embomatrix.skills.parse import plan_from_json
from embomatrix.trainer.config.settings import read_settings
from embomatrix.trainer.data.tasks import load_tasks
from embomatrix.trainer.lifecycle.checkpoint import CheckpointStore, TrainingProgress
from embomatrix.trainer.policy.loading import new_policy
from embomatrix.world.dataset import Dataset

NOWHERE = "127.0.0.1:1"
UNREACHABLE = f"no manager answers at {NOWHERE}: start one with `embomatrix manager serve`, or pass --manager"
REFUSED = "missing or unknown token: pass --token, or set EMBOMATRIX_TOKEN to a token of this manager"
SECRET = "the-secret-of-this-test"


def assert_ended(ended, status, *words):
    assert "Traceback" not in ended.text
    assert "should not have happened" not in ended.text
    assert ended.status == status, ended.text
    for word in words:
        assert word in ended.text


@contextlib.contextmanager
def manager(folder, *options):
    """Yield the command, gRPC address and HTTP address of a manager on free ports."""
    folder.mkdir(exist_ok=True)
    arguments = ("manager", "serve", "--port=0", "--http-port=0", f"--data-dir={folder}", *options)
    with background(folder / "log", *arguments) as command:
        command.wait_for("status page")
        found = re.search(r"manager serves at (\S+), status page (\S+),", command.text)
        yield command, found[1], found[2]


@contextlib.contextmanager
def worker(folder, address, *options):
    arguments = ("worker", "run", f"--manager={address}", "--slots=1", f"--cache-dir={folder}", *options)
    with background(folder.with_suffix(".log"), *arguments) as command:
        command.wait_for("registered with the manager")
        yield command


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    with manager(tmp_path_factory.mktemp("manager") / "data", f"--token={SECRET}") as found:
        yield found


@pytest.fixture(scope="module")
def checkpoint(kitchen, tmp_path_factory):
    """Save an untrained policy in the format of a training run."""
    settings = read_settings(None, {"tiny.layers": 1, "tiny.width": 16, "tiny.heads": 1, "tiny.inner": 16})
    policy = new_policy(settings, load_tasks(kitchen))
    store = CheckpointStore(tmp_path_factory.mktemp("run") / "checkpoints", keep=1)
    return store.save(policy, {}, TrainingProgress(), settings)


@pytest.mark.parametrize(
    "arguments",
    [
        ("train", "--dataset=DATASET", "--out=OUT"),
        ("eval", "--baseline=oracle", "--bench=DATASET", "--out=OUT"),
        ("worker", "run", "--once", "--cache-dir=OUT"),
        ("status",),
    ],
    ids=lambda arguments: " ".join(arguments[:2]),
)
def test_unreachable_manager_is_named(kitchen, checkpoint, tmp_path, arguments):
    places = {"DATASET": kitchen, "OUT": tmp_path / "out", "CHECKPOINT": checkpoint}
    filled = [_placed(item, places) for item in arguments]
    assert_ended(run(*filled, f"--manager={NOWHERE}"), 2, UNREACHABLE)


def _placed(item, places):
    for name, place in places.items():
        item = item.replace(name, str(place))
    return item


@pytest.mark.parametrize(
    ("arguments", "token"),
    [
        (("train", "--dataset=DATASET", "--out=OUT"), "wrong"),
        (("worker", "run", "--cache-dir=OUT"), "wrong"),
        (("status",), "wrong"),
        (("status",), ""),
    ],
    ids=str,
)
def test_wrong_token_is_refused_and_never_shown(served, kitchen, tmp_path, arguments, token):
    _, address, _ = served
    filled = [_placed(item, {"DATASET": kitchen, "OUT": tmp_path / "out"}) for item in arguments]
    ended = run(*filled, f"--manager={address}", f"--token={token}")
    assert_ended(ended, 2, REFUSED)
    assert SECRET not in ended.text


@pytest.mark.parametrize("option", ["", "http-"])
def test_used_port_is_named_and_its_process_keeps_running(tmp_path, option):
    """The second manager shares the first one's data folder; it must bind its ports before it claims the state."""
    with manager(tmp_path / "data") as (first, address, page):
        taken = address if not option else page.removeprefix("http://").rstrip("/")
        port = taken.rpartition(":")[2]
        ports = {"port": "0", "http-port": "0", f"{option}port": port}
        options = [f"--{name}={value}" for name, value in ports.items()]
        ended = run("manager", "serve", f"--data-dir={tmp_path / 'data'}", *options)
        remedy = f"stop the program that uses it, or pass another --{option}port"
        assert_ended(ended, 2, f"{taken} can't be bound (Address already in use): {remedy}")
        assert "add_port.cc" not in ended.text
        assert_ended(run("cluster", "runs", f"--manager={address}"), 0, "no open runs")
        assert first.process.poll() is None, first.text


def test_unreachable_redis_is_named_without_its_password(tmp_path):
    state = "--state=redis://:hidden@127.0.0.1:1/0"
    ended = run("manager", "serve", "--port=0", "--http-port=0", f"--data-dir={tmp_path}", state)
    assert_ended(
        ended, 2, "Redis at redis://:***@127.0.0.1:1/0 can't be reached", "start it, or pass another --state"
    )
    assert "hidden" not in ended.text


@pytest.mark.parametrize("option", ["--host=0.0.0.0", "--http-host=0.0.0.0"])
def test_non_loopback_address_without_tls_is_refused(tmp_path, option):
    ended = run("manager", "serve", option, "--token=secret", f"--data-dir={tmp_path}")
    assert_ended(
        ended, 2, "refusing to serve on 0.0.0.0 without TLS:", "run `embomatrix manager init --data-dir"
    )


async def test_bundle_with_wrong_digest_is_refused(served):
    _, address, _ = served
    wrong = f"sha256:{'0' * 64}"
    async with ClusterClient(address, SECRET) as client:
        with pytest.raises(
            InvalidRequestError, match=rf"digest sha256:\w+, expected {wrong}: it was damaged"
        ):
            await client.put_bundles({wrong: zlib.compress(b"another content")})
        assert await client.list_workers() == ()


async def _reward(address, record, data, run_name):
    """Upload the bundle, execute the oracle's plan once and return the reward; None if the rollout was lost."""
    rollout = Rollout(
        "r", "g", record.bundle_digest, record.task.task_id, plan_from_json(list(record.oracle)), 0
    )
    async with ClusterClient(address) as client:
        run_id = await client.open_run(run_name)
        await client.put_bundles({record.bundle_digest: data})
        [result] = [item async for item in client.execute(Batch(run_id, "b", 1, (rollout,)), deadline_s=60)]
    return result.outcome.reward.total if isinstance(result.outcome, Completed) else None


async def test_damaged_cached_bundle_is_downloaded_again(kitchen, tmp_path):
    dataset = Dataset.load(kitchen)
    record = dataset.train[0]
    data = dataset.bundle_bytes(record.bundle_digest)
    with manager(tmp_path / "data", "--state=memory:") as (serving, address, _):
        with worker(tmp_path / "cache", address, "--name=one"):
            reward = await _reward(address, record, data, "first")
            assert reward > 30
        for folder in (tmp_path / "cache", tmp_path / "data"):
            [file] = (folder / "bundles").iterdir()
            file.write_bytes(file.read_bytes()[:-1])
        with worker(tmp_path / "cache", address, "--name=two") as second:
            assert await _reward(address, record, data, "second") == reward
            assert "bundle damaged on disk, fetching it again" in second.text
        assert "bundle damaged on disk, removed" in serving.text


def test_training_reports_interrupts_and_write_errors(kitchen, tmp_path):
    with manager(tmp_path / "data") as (_, address, _), worker(tmp_path / "cache", address):
        common = ("train", f"--dataset={kitchen}", f"--manager={address}", "--threads=1")
        short = ("--imitate-seconds=0.5", "--steps=1000000")
        with background(
            tmp_path / "early.log", *common, f"--out={tmp_path / 'early'}", "--imitate-seconds=60"
        ) as run_:
            run_.wait_for("imitation")
            assert_ended(run_.interrupt(), 130, f"continue with `--resume --out={tmp_path / 'early'}`")
        [saved] = (tmp_path / "early" / "checkpoints").iterdir()
        assert saved.name.startswith("imitation-")
        with background(tmp_path / "late.log", *common, *short, f"--out={tmp_path / 'late'}") as run_:
            run_.wait_for((tmp_path / "late" / "metrics.jsonl").exists)
            assert_ended(
                run_.interrupt(), 130, f"interrupted: continue with `--resume --out={tmp_path / 'late'}`"
            )
        newest = max((tmp_path / "late" / "checkpoints").iterdir())
        assert newest.name.startswith("step-")
        resumed = ("--resume", "--steps=1000000", f"--out={tmp_path / 'late'}")
        with background(tmp_path / "resumed.log", *common, *resumed) as run_:
            run_.wait_for("GRPO")
            assert_ended(
                run_.terminate(), 130, f"interrupted: continue with `--resume --out={tmp_path / 'late'}`"
            )
        shown = run("cluster", "runs", f"--manager={address}")
        assert_ended(shown, 0, "no open runs; closed ones: --closed")
        full = run_anew(
            *common,
            f"--out={tmp_path / 'full'}",
            "--imitate-seconds=0.5",
            "--processes=1",
            largest_file=64 * 1024,
        )
        assert_ended(full, 2, "can't be written", "free space or fix the")
        shared = run_anew(*common, f"--out={tmp_path / 'shared'}", largest_file=64 * 1024)
        assert_ended(shared, 2, "can't be put into shared memory", "set processes to 1")
        assert not list((tmp_path / "full").glob("reference*"))


def test_interrupted_demo_ends_its_processes(kitchen, tmp_path):
    out = tmp_path / "out"
    arguments = ("demo", f"--dataset={kitchen}", f"--out={out}", "--imitate-steps=5", "--steps=100000")
    with background(tmp_path / "log", *arguments) as demo:
        demo.wait_for((out / "metrics.jsonl").exists)
        address = re.search(r"manager at (\S+),", demo.text)[1]
        ended = demo.interrupt()
    assert_ended(ended, 130, "interrupted: continue with `--resume --out=")
    assert list((out / "checkpoints").glob("step-*"))
    with socket.socket() as probe:
        host, _, port = address.rpartition(":")
        assert probe.connect_ex((host, int(port))) != 0, "the manager outlived the demo"
    assert "Traceback" not in "".join(Path(log).read_text() for log in (out / "cluster" / "logs").iterdir())
