"""Joining a guarded cluster: `manager init`, invitations and credentials."""

import asyncio
import json
import stat
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.fakes import simulation
from tests.fakes.commands import background, run
from tests.fakes.guarded import (
    guarded,
)

from embomatrix.manager.commands.next_steps import host_steps
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.trust import Invitation, fingerprint_of
from embomatrix.rpc.wire.tokens import AccessRole
from embomatrix.rpc.wire.values import Resources
from embomatrix.worker.host.settings import WorkerSettings
from embomatrix.worker.link.daemon import Daemon
from embomatrix.worker.link.membership import membership_of

pytestmark = pytest.mark.timeout(120)


def test_serving_beyond_loopback_needs_tls_and_tokens(tmp_path):
    result = run("manager", "serve", "--host=0.0.0.0", "--port=0", "--http-port=0", f"--data-dir={tmp_path}")
    assert result.status == 2
    assert "refusing to serve on 0.0.0.0 without TLS and tokens" in result.text
    assert f"embomatrix manager init --data-dir {tmp_path} --san HOST" in result.text


def test_init_files_are_private_and_never_overwritten(tmp_path):
    result = run("manager", "init", f"--data-dir={tmp_path}", "--san=lab.example", "--san=10.1.2.3")
    assert result.status == 0, result.text
    assert "lab.example" in result.text
    steps = [part.partition(": ")[2] for part in result.text.split(" next ")[1:]]
    assert steps == [step.command for step in host_steps(tmp_path, named=True)]
    assert [step.split(" --")[0] for step in steps] == [
        "embomatrix factory starter",
        "embomatrix manager serve",
        "embomatrix doctor",
        "embomatrix train",
    ]
    assert f"embomatrix manager serve --data-dir={tmp_path} --dataset=build/dataset" in steps
    files = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in files}
    assert {name for name, mode in modes.items() if mode != 0o600} == {"ca.pem", "server.pem"}
    assert not any(
        token.strip() in (tmp_path / "access/tokens.json").read_bytes() for token in tokens_of(files)
    )
    again = run("manager", "init", f"--data-dir={tmp_path}")
    assert " made " not in f" {again.text}"
    assert {path: path.read_bytes() for path in files} == files
    wider = run("manager", "init", f"--data-dir={tmp_path}", "--san=other.example")
    assert "other.example, " in wider.text or "other.example" in wider.text
    assert (tmp_path / "access/ca.pem").read_bytes() == files[tmp_path / "access/ca.pem"]
    assert run("manager", "init", f"--data-dir={tmp_path}", "--san=no name").status == 2


def tokens_of(files):
    return [content.partition(b".")[2] for path, content in files.items() if path.parent.name == "tokens"]


def daemon(membership, folder):
    settings = WorkerSettings(cache_dir=folder / "cache", state_dir=folder / "state")
    program = (sys.executable, str(Path(simulation.__file__)))
    return Daemon(
        settings, Resources(1, 1, 500), np.random.default_rng(0), program=program, membership=membership
    )


async def test_daemon_joins_once_and_then_uses_its_credential(tmp_path):
    async with (
        guarded(tmp_path / "manager", stream_grace_s=60.0) as at,
        ClusterClient(at.address, at.token(AccessRole.VIEWER), ca=at.ca) as viewer,
    ):
        invitation = Invitation(at.address, await at.issue(AccessRole.JOIN), fingerprint_of(at.ca.decode()))
        settings = WorkerSettings(join=str(invitation), name="spare", state_dir=tmp_path / "pc" / "state")
        for joining in (True, False):
            membership = await membership_of(settings)
            assert (membership.joining, membership.name) == (joining, "spare")
            working = daemon(membership, tmp_path / "pc")
            serving = asyncio.create_task(working.run())
            async with asyncio.timeout(20):
                while [w.state for w in await viewer.list_workers()] != ["ready"]:  # noqa: ASYNC110
                    await asyncio.sleep(0.05)
            working.stop()
            await serving
            # The worker announced its departure, so the manager does not wait for the one-minute timeout.
            async with asyncio.timeout(20):
                while [w.state for w in await viewer.list_workers()] != ["left"]:  # noqa: ASYNC110
                    await asyncio.sleep(0.05)
    [kept] = (tmp_path / "pc" / "state").glob("member-*.json")
    assert stat.S_IMODE(kept.stat().st_mode) == 0o600
    assert str(invitation).partition(".")[2][:20] not in kept.read_text()


@pytest.mark.slow
async def test_spare_pc_joins_with_an_invitation(tmp_path):
    """The commands of the operator and of the PC's owner each run as a dedicated process."""
    home = tmp_path / "pc"
    async with guarded(tmp_path / "manager") as at:
        ca = at.folder.ca
        options = (f"--manager={at.address}", f"--token=@{at.folder.token(AccessRole.ADMIN)}", f"--ca={ca}")
        result = await asyncio.to_thread(
            run, "manager", "token", "issue", "--role=join", "--label=spare PC", *options
        )
        invitation = next(word for word in result.text.split() if "@" in word)
        worker_run = ("worker", "run", f"--join={invitation}", "--slots=1", "--name=spare")
        folders = (f"--cache-dir={home / 'cache'}", f"--state-dir={home / 'state'}")
        for start in ("first", "second"):
            with background(tmp_path / f"{start}.log", *worker_run, *folders) as command:
                await asyncio.to_thread(command.wait_for, "registered with the manager")
                text = command.text
            assert ("joined the manager" in text) == (start == "first")
        [kept] = (home / "state").glob("member-*.json")
        assert stat.S_IMODE(kept.stat().st_mode) == 0o600
        assert invitation.partition("@")[0] not in kept.read_text()
        assert json.loads(kept.read_text())["name"] == "spare"
        stolen = await asyncio.to_thread(
            run, *worker_run, f"--cache-dir={home / 'c2'}", f"--state-dir={home / 's2'}"
        )
        assert stolen.status == 2
        assert "used already, by worker spare" in stolen.text
        listed = await asyncio.to_thread(run, "manager", "token", "list", *options)
        assert "spare PC" in listed.text
        async with at.operator() as operator:
            await operator.revoke_worker("spare", "sold")
        refused = await asyncio.to_thread(run, *worker_run, *folders)
        assert refused.status == 2
        assert "revoked (sold)" in refused.text
