"""`embomatrix doctor`: findings about this machine and about managers."""

import asyncio

import pytest
from tests.integration.test_manager_service import manager as a_manager

from embomatrix.cli.doctor.machine import (
    NEEDED,
    Finding,
    Level,
    disk,
    machine,
    memory,
    parts,
    port,
    python,
    verdict,
)
from embomatrix.cli.doctor.manager import (
    Visit,
    certificate,
    clock,
    manager,
    mistrust,
    ports_held,
    versions,
)
from embomatrix.manager.access.folder import prepare
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.versions import PROTOCOL_VERSION, Capabilities, VersionRange


def levels(findings):
    return {finding.thing: finding.level for finding in findings}


@pytest.mark.parametrize(
    ("version", "system", "processor", "level"),
    [
        ((3, 11), "Linux", "x86_64", Level.FINE),
        ((3, 12), "Linux", "x86_64", Level.NOTE),
        ((3, 11), "Linux", "aarch64", Level.NOTE),
        ((3, 11), "Darwin", "x86_64", Level.NOTE),
        ((3, 10), "Linux", "x86_64", Level.WRONG),
    ],
)
def test_python_is_judged_by_the_wheels_of_the_engine(version, system, processor, level):
    assert python(version, system, processor).level is level


def test_part_with_missing_packages_names_the_extra():
    found = parts({"pybullet", "scipy", *NEEDED["manager"]})
    assert levels(found) == {
        "worker": Level.NOTE,
        "manager": Level.FINE,
        "factory": Level.NOTE,
        "trainer": Level.NOTE,
    }
    assert (found[0].found, found[0].remedy) == (
        "lacks psutil",
        "to run it here: pip install 'embomatrix[worker]'",
    )


def test_low_memory_is_a_note_and_very_low_memory_wrong(tmp_path):
    assert [memory(free_mb).level for free_mb in (4096, 1024, 100)] == [Level.FINE, Level.NOTE, Level.WRONG]
    assert "100 MB are free" in disk(tmp_path, 100.0).found
    assert port("port of the status page", 8070, free=False).level is Level.NOTE


def test_expiring_certificate_and_wrong_clock_are_notes():
    assert [certificate(days).level for days in (300, 29, -1)] == [Level.FINE, Level.NOTE, Level.NOTE]
    assert [clock(offset_s).level for offset_s in (0.7, 3600.0, -3600.0)] == [
        Level.FINE,
        Level.NOTE,
        Level.NOTE,
    ]
    assert "behind" in clock(-3600.0).found


def test_not_yet_valid_certificate_suggests_checking_the_clock():
    assert "clock" in mistrust(9, "certificate is not yet valid").remedy
    assert "clock" in mistrust(10, "certificate has expired").remedy
    assert "--ca" in mistrust(20, "unable to get local issuer certificate").remedy


def test_manager_without_a_common_version_is_wrong_and_another_release_a_note():
    newer = versions(Capabilities(VersionRange(PROTOCOL_VERSION + 5, PROTOCOL_VERSION + 6), "9.0.0"))
    assert newer.level is Level.WRONG
    assert "pip install --upgrade" in newer.remedy
    other = versions(Capabilities(VersionRange(1, PROTOCOL_VERSION), "0.0.9"))
    assert other.level is Level.NOTE


def test_verdict_names_wrong_findings():
    fine, note, wrong = (Finding(level.value, level, "") for level in Level)
    assert verdict([fine]) == "all is well"
    assert verdict([fine, note]) == "nothing is wrong; 1 of 2 things is worth a look"
    assert verdict([fine, wrong, note]) == "1 of 3 things is wrong: wrong"


def test_this_machine_can_run_its_own_tests():
    found = levels(machine())
    assert found["Python"] is not Level.WRONG
    assert found["memory"] is not Level.WRONG


async def test_missing_manager_is_wrong_only_if_it_was_named():
    (named,) = await manager(Visit("127.0.0.1:1"))
    (default,) = await manager(Visit("127.0.0.1:1", expected=False))
    assert (named.level, default.level) == (Level.WRONG, Level.NOTE)


async def test_manager_without_tls_is_fine(tmp_path):
    async with a_manager(tmp_path) as endpoints:
        page_port = int(endpoints.status_url.rstrip("/").rpartition(":")[2])
        found = await manager(Visit(endpoints.address, page_port=page_port))
    assert [finding.thing for finding in found] == ["manager", "TLS", "versions", "token", "cluster", "clock"]
    assert {finding.level for finding in found} == {Level.FINE}


async def test_paused_cluster_is_a_note(tmp_path):
    async with a_manager(tmp_path) as endpoints:
        async with AdminClient(endpoints.address) as client:
            await client.pause_dispatch()
        found = await manager(Visit(endpoints.address, page_port=1))
    assert levels(found)["cluster"] is Level.NOTE
    assert "Dispatch is paused" in next(f.found for f in found if f.thing == "cluster")


async def test_port_of_another_program_is_reported_once(tmp_path):
    async with a_manager(tmp_path) as endpoints:
        page_port = int(endpoints.status_url.rstrip("/").rpartition(":")[2])
        found = await manager(Visit(f"127.0.0.1:{page_port}", page_port=page_port))
    assert [finding.thing for finding in found] == ["manager", "TLS", "versions"]
    assert (found[-1].level, "is this the port" in found[-1].remedy) == (Level.WRONG, True)


async def test_ports_of_a_local_manager_are_fine(tmp_path):
    async with a_manager(tmp_path) as endpoints:
        page_port = int(endpoints.status_url.rstrip("/").rpartition(":")[2])
        here = Visit(endpoints.address, page_port=page_port)
        found = await manager(here)
        pageless = await manager(Visit(endpoints.address, page_port=1))
    assert ports_held(here, found) == {here.port, page_port}
    assert ports_held(here, pageless) == {here.port}
    assert ports_held(Visit("10.0.0.9:50070"), found) == frozenset()
    assert ports_held(here, await manager(here)) == frozenset()
    held = port("port of the status page", page_port, free=False, ours=True)
    assert (held.level, held.remedy) == (Level.FINE, "")


async def test_guarded_manager_reports_each_missing_credential(tmp_path):
    await asyncio.to_thread(prepare, tmp_path, sans=())
    access = tmp_path / "access"
    ca, viewer = (access / "ca.pem").read_bytes(), (access / "tokens" / "viewer").read_text().strip()
    async with a_manager(tmp_path) as endpoints:
        unreachable = await manager(Visit(endpoints.address))
        trusting = await manager(Visit(endpoints.address, ca=ca, page_port=1))
        signed_in = await manager(Visit(endpoints.address, viewer, ca, page_port=1))
        elsewhere = await manager(Visit(endpoints.address.replace("127.0.0.1", "127.0.0.2"), ca=ca))
    assert levels(unreachable)["TLS"] is Level.WRONG
    assert "--ca" in unreachable[-1].remedy
    assert levels(trusting) == {
        "manager": Level.FINE,
        "TLS": Level.FINE,
        "versions": Level.FINE,
        "token": Level.WRONG,
    }
    assert levels(signed_in)["token"] is Level.FINE
    assert elsewhere[0].level is Level.WRONG
