"""The compose file without Docker: its commands exist, and its ports are closed to other machines."""

import contextlib
import re
import shlex
import ssl
import subprocess
from pathlib import Path

import httpx
import pytest
import yaml
from tests.fakes.commands import background, run, run_anew

from embomatrix.manager.commands.next_steps import COMPOSE_STEPS

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docker-compose.yml").read_text()
SERVICES = yaml.safe_load(TEXT)["services"]
VOLUMES = yaml.safe_load(TEXT)["volumes"]
WRITE_TASKS, TRAIN, COPY_RESULTS = (step.command for step in COMPOSE_STEPS)


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


def test_only_the_trainer_writes_the_dataset_and_the_manager_shows_it():
    holders = {
        name: [volume for volume in service.get("volumes", ()) if volume.startswith("dataset:")]
        for name, service in SERVICES.items()
    }
    assert {name: volumes for name, volumes in holders.items() if volumes} == {
        "manager": ["dataset:/dataset:ro"],
        "trainer": ["dataset:/dataset"],
    }
    assert "--dataset=/dataset" in SERVICES["manager"]["command"]
    assert SERVICES["trainer"]["environment"]["EMBOMATRIX_DATASET"] == "/dataset"


def test_the_same_commands_for_tasks_training_and_results_are_documented_everywhere():
    operations = (ROOT / "docs" / "operations.md").read_text()
    readme = (ROOT / "README.md").read_text()
    for step in COMPOSE_STEPS:
        assert f"#   {step.command}\n" in TEXT
        assert f"    {step.command}" in operations
        assert step.command in readme
    assert "--compose" in SERVICES["init"]["command"]


def placed(arguments, folder):
    """Replace the container's folders with temporary ones and the published ports with free ones."""
    moved = [
        re.sub(
            r"(=|:)/(data|dataset|runs|for-worker|for-trainer|cache|tmp/worker)\b", rf"\1{folder}/\2", each
        )
        for each in arguments
    ]
    return [each for each in moved if not each.startswith("--state=")]


def in_trainer(command, folder, *more, **environment):
    """Run a documented `docker compose run` of the trainer here, with the service's environment."""
    compose = shlex.split(command)
    assert compose[:5] == ["docker", "compose", "run", "--rm", "trainer"]
    variables = {
        "EMBOMATRIX_DATASET": f"{folder}/dataset",
        "EMBOMATRIX_CA": f"{folder}/for-trainer/ca.pem",
        "EMBOMATRIX_TOKEN": f"@{folder}/for-trainer/token",
        **environment,
    }
    result = run_anew(*placed(compose[5:], folder), *more, **variables)
    assert result.status == 0, result.text
    return result.text


@contextlib.contextmanager
def serving(folder):
    """Run the commands of `init` and `manager`. Yields the manager's address and a client of its pages."""
    result = run("manager", "init", *placed(SERVICES["init"]["command"], folder))
    assert result.status == 0, result.text
    assert "manager, localhost" in result.text
    assert all(f"next {step.purpose}: {step.command}" in result.text for step in COMPOSE_STEPS)
    again = run("manager", "init", *placed(SERVICES["init"]["command"], folder))
    assert again.status == 0, again.text
    # Docker makes the mount point of an empty volume.
    (folder / "dataset").mkdir()
    serve = [*placed(SERVICES["manager"]["command"], folder), "--port=0", "--http-port=0"]
    with background(folder / "manager.log", "manager", "serve", *serve) as manager:
        manager.wait_for("status page")
        assert "holds no tasks yet" in manager.text
        port, page = re.search(r"serves at \S+:(\d+), status page https://\S+:(\d+)/", manager.text).groups()
        trusted = ssl.create_default_context(cafile=str(folder / "data" / "access" / "ca.pem"))
        viewer = (folder / "data" / "access" / "tokens" / "viewer").read_text().strip()
        with httpx.Client(
            base_url=f"https://127.0.0.1:{page}",
            verify=trusted,
            headers={"authorization": f"Bearer {viewer}"},
        ) as http:
            yield f"127.0.0.1:{port}", http


def test_manager_shows_the_tasks_that_ship_by_name(tmp_path):
    serve = ("--port=0", "--http-port=0", "--state=memory:", f"--data-dir={tmp_path / 'data'}")
    with background(tmp_path / "manager.log", "manager", "serve", "--dataset=search", *serve) as manager:
        manager.wait_for("status page")
        page = re.search(r"status page (http://\S+),", manager.text)[1]
        assert httpx.get(f"{page}api/v1/tasks", trust_env=False).json()["total"] > 2000


def test_manager_of_an_empty_volume_shows_the_shipped_tasks_once_they_are_written(tmp_path):
    with serving(tmp_path) as (_, http):
        before = http.get("/api/v1/tasks").json()
        assert (before["total"], "holds no tasks yet" in before["notice"]) == (0, True)
        in_trainer(WRITE_TASKS, tmp_path)
        after = http.get("/api/v1/tasks").json()
        assert (after["total"] > 600, after["notice"]) == (True, "")
        card = after["items"][0]
        assert http.get(f"/api/v1/tasks/{card['task_id']}").json()["moments"]
        assert http.get(f"/api/v1/scenes/{card['bundle_digest']}/floor").json()["rooms"]


@pytest.mark.slow
def test_worker_joins_and_the_documented_commands_train_and_copy_the_results(tmp_path):
    with contextlib.ExitStack() as stack:
        address, http = stack.enter_context(serving(tmp_path))
        environment = {
            "EMBOMATRIX_CA": str(tmp_path / "for-worker" / "ca.pem"),
            "EMBOMATRIX_TOKEN": f"@{tmp_path / 'for-worker' / 'token'}",
        }
        command = [
            each for each in placed(SERVICES["worker"]["command"], tmp_path) if "--manager" not in each
        ]
        worker = stack.enter_context(
            background(
                tmp_path / "worker.log", "worker", "run", f"--manager={address}", *command, **environment
            )
        )
        worker.wait_for("registered with the manager")
        assert http.get("/healthz").status_code == 200
        assert http.get("/api/v1/workers", headers={"authorization": ""}).status_code == 401
        found = http.get("/api/v1/workers").json()["items"]
        assert [each["state"] for each in found] == ["ready"]
        in_trainer(WRITE_TASKS, tmp_path)
        few = tmp_path / "few.toml"  # one answer for each of 200 held-out tasks: ten take minutes
        few.write_text("[evaluation]\nsamples = 1\n")
        options = ("--steps=1", "--imitate-steps=2", f"--settings={few}")
        in_trainer(TRAIN, tmp_path, *options, EMBOMATRIX_MANAGER=address)
    assert COPY_RESULTS.startswith("docker compose run --rm -T --no-deps --entrypoint=tar trainer ")
    copy = COPY_RESULTS.partition(" trainer ")[2].replace(" / ", f" {shlex.quote(str(tmp_path))} ")
    (tmp_path / "here").mkdir()
    subprocess.run(f"tar {copy}", shell=True, cwd=tmp_path / "here", check=True)
    assert (tmp_path / "here" / "runs" / "first" / "report.html").is_file()
