"""The compose file without Docker: its commands exist, and its ports are closed to other machines."""

import contextlib
import re
import ssl
from pathlib import Path

import httpx
import pytest
import yaml
from tests.fakes.commands import background, run

ROOT = Path(__file__).parents[2]
SERVICES = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]
VOLUMES = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["volumes"]


def test_host_ports_are_published_on_loopback_only():
    published = [port for service in SERVICES.values() for port in service.get("ports", ())]
    assert published
    assert all(port.startswith("127.0.0.1:") for port in published)


def test_only_init_and_manager_see_keys_and_all_tokens():
    holders = {
        name
        for name, service in SERVICES.items()
        if any(v.startswith("manager:") for v in service.get("volumes", ()))
    }
    assert holders == {"init", "manager"}
    assert "worker-access:/access:ro" in SERVICES["worker"]["volumes"]
    assert "trainer-access:/access:ro" in SERVICES["trainer"]["volumes"]
    named = {v.partition(":")[0] for service in SERVICES.values() for v in service.get("volumes", ())}
    assert named == set(VOLUMES)


def test_services_wait_for_certificates_and_tokens():
    assert SERVICES["manager"]["depends_on"]["init"] == {"condition": "service_completed_successfully"}
    for name in ("worker", "trainer"):
        assert SERVICES[name]["depends_on"]["manager"] == {"condition": "service_healthy"}


def test_compose_file_contains_no_secret():
    tokens = [service.get("environment", {}).get("EMBOMATRIX_TOKEN", "@") for service in SERVICES.values()]
    assert all(token.startswith("@") for token in tokens)


def test_every_service_is_confined_limited_and_restarted():
    for name, service in SERVICES.items():
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert service["mem_limit"], name
        assert service["pids_limit"], name
        assert ("healthcheck" in service) == (name in ("redis", "manager", "worker")), name
        assert ("restart" in service) == (name in ("redis", "manager", "worker")), name


def placed(arguments, folder):
    """Replace the container's folders with temporary ones and the published ports with free ones."""
    moved = [
        re.sub(r"(=|:)/(data|for-worker|for-trainer|cache|tmp/worker)", rf"\1{folder}/\2", each)
        for each in arguments
    ]
    return [each for each in moved if not each.startswith("--state=")]


@pytest.mark.slow
def test_worker_joins_the_cluster_of_the_compose_commands_with_its_own_token(tmp_path):
    result = run("manager", "init", *placed(SERVICES["init"]["command"], tmp_path))
    assert result.status == 0, result.text
    assert "manager, localhost" in result.text
    again = run("manager", "init", *placed(SERVICES["init"]["command"], tmp_path))
    assert again.status == 0, again.text
    serve = [*placed(SERVICES["manager"]["command"], tmp_path), "--port=0", "--http-port=0"]
    with contextlib.ExitStack() as stack:
        manager = stack.enter_context(background(tmp_path / "manager.log", "manager", "serve", *serve))
        manager.wait_for("status page")
        port, page = re.search(r"serves at \S+:(\d+), status page https://\S+:(\d+)/", manager.text).groups()
        environment = {
            "EMBOMATRIX_CA": str(tmp_path / "for-worker" / "ca.pem"),
            "EMBOMATRIX_TOKEN": f"@{tmp_path / 'for-worker' / 'token'}",
        }
        command = [
            each for each in placed(SERVICES["worker"]["command"], tmp_path) if "--manager" not in each
        ]
        worker = stack.enter_context(
            background(
                tmp_path / "worker.log",
                "worker",
                "run",
                f"--manager=127.0.0.1:{port}",
                *command,
                **environment,
            )
        )
        worker.wait_for("registered with the manager")
        trusted = ssl.create_default_context(cafile=str(tmp_path / "data" / "access" / "ca.pem"))
        viewer = (tmp_path / "data" / "access" / "tokens" / "viewer").read_text().strip()
        with httpx.Client(base_url=f"https://127.0.0.1:{page}", verify=trusted) as http:
            assert http.get("/healthz").status_code == 200
            assert http.get("/api/v1/workers").status_code == 401
            found = http.get("/api/v1/workers", headers={"authorization": f"Bearer {viewer}"}).json()["items"]
            assert [each["state"] for each in found] == ["ready"]
