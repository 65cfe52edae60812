"""Deployment files are valid and confined, and name existing commands, options and metrics."""

import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import kubernetes_validate
import pytest
import typer
import yaml
from tests.fakes.systemd import assert_valid_unit, needs_systemd

from embomatrix.manager.commands.app import app as manager_app
from embomatrix.worker.commands.app import app as worker_app

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
MANAGER_UNIT = DEPLOY / "systemd" / "embomatrix-manager.service"
GUIDE = (ROOT / "docs" / "operations.md").read_text()
MANIFESTS = yaml.safe_load((DEPLOY / "kubernetes" / "kustomization.yaml").read_text())["resources"]
OBJECTS = [
    item for name in MANIFESTS for item in yaml.safe_load_all((DEPLOY / "kubernetes" / name).read_text())
]
PODS = {
    item["metadata"]["name"]: item["spec"]["template"]["spec"]
    for item in OBJECTS
    if "template" in item.get("spec", {})
}
PROMETHEUS = DEPLOY / "prometheus"
needs_promtool = pytest.mark.skipif(
    shutil.which("promtool") is None, reason="needs promtool, which Debian's package prometheus provides"
)
METRIC = re.compile(r"\bembo_\w+")


def options(app, name):
    """Return the options of one of our commands."""
    return {
        option for parameter in typer.main.get_command(app).commands[name].params for option in parameter.opts
    }


def named(arguments):
    return {word.split("=")[0] for word in arguments if word.startswith("--")}


@pytest.mark.parametrize("item", OBJECTS, ids=lambda item: f"{item['kind']}-{item['metadata']['name']}")
def test_kubernetes_manifests_match_the_schema(item):
    kubernetes_validate.validate(item, "1.30", strict=True)


def test_pods_run_unprivileged_on_a_read_only_system():
    assert set(PODS) == {"redis", "manager", "worker"}
    for name, pod in PODS.items():
        assert pod["securityContext"]["runAsNonRoot"], name
        assert not pod["automountServiceAccountToken"], name
        for container in (*pod["containers"], *pod.get("initContainers", ())):
            allowed = container["securityContext"]
            assert allowed["readOnlyRootFilesystem"], name
            assert allowed["capabilities"] == {"drop": ["ALL"]}, name
            assert not allowed["allowPrivilegeEscalation"], name
            assert container["resources"]["limits"]["memory"], name


def test_pod_options_exist():
    (manager,) = PODS["manager"]["containers"]
    (init,) = PODS["manager"]["initContainers"]
    (worker,) = PODS["worker"]["containers"]
    assert named(manager["args"]) <= options(manager_app, "serve")
    assert named(init["args"]) <= options(manager_app, "init")
    assert named(worker["args"]) <= options(worker_app, "run")


def test_slurm_task_runs_a_worker_with_its_cores_and_a_unique_name(tmp_path):
    fake = tmp_path / "srun"
    fake.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    fake.chmod(0o755)
    known = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "SLURM_CPUS_PER_TASK": "4"}
    variables = {"EMBOMATRIX_MANAGER": "m:50070", "SLURM_ARRAY_JOB_ID": "7", "SLURM_ARRAY_TASK_ID": "3"}
    script = ("bash", str(DEPLOY / "slurm" / "workers.sbatch"))
    ran = subprocess.run(script, env=known | variables, capture_output=True, text=True, check=True)
    words = ran.stdout.splitlines()
    assert words[:3] == ["embomatrix", "worker", "run"]
    assert named(words) <= options(worker_app, "run")
    assert (words[words.index("--name") + 1], words[words.index("--slots") + 1]) == ("slurm-7-3", "4")
    nameless = subprocess.run(
        script, env=known | {"SLURM_JOB_ID": "7"}, capture_output=True, text=True, check=False
    )
    assert (nameless.returncode, "set it to the HOST:PORT" in nameless.stderr) == (1, True)


def test_manager_unit_options_exist():
    calls = re.findall(
        r"^ExecStart(?:Pre)?=\S+ manager (\w+) (.*)$", MANAGER_UNIT.read_text(), flags=re.MULTILINE
    )
    assert [command for command, _ in calls] == ["init", "serve"]
    assert all(named(words.split()) <= options(manager_app, command) for command, words in calls)


@needs_systemd
def test_systemd_accepts_the_manager_unit(tmp_path):
    unit = tmp_path / MANAGER_UNIT.name
    unit.write_text(MANAGER_UNIT.read_text().replace("/opt/embomatrix/bin/embomatrix", shutil.which("true")))
    assert_valid_unit(unit, system=True)


def test_manager_image_contains_all_imported_packages():
    built = (DEPLOY / "docker" / "Dockerfile").read_text().replace("\\\n", " ")
    (modules,) = re.findall(r"slim\.py (.*embomatrix\.manager\.services\.app.*)", built)
    lacked = packages_of("worker", "factory", "trainer") - packages_of("manager")
    assert {"pybullet", "scipy", "torch"} <= lacked
    hidden = f"import importlib, sys\nsys.modules.update(dict.fromkeys({sorted(lacked)}))"
    asked = f"{hidden}\nfor name in sys.argv[1:]: importlib.import_module(name)"
    ran = subprocess.run(
        (sys.executable, "-c", asked, *modules.split()), capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr


def packages_of(*extras):
    """Return the import names of the installed requirements of extras."""
    command = (sys.executable, DEPLOY / "docker" / "requirements.py", ROOT / "pyproject.toml", *extras)
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    wanted = {re.match(r"[\w-]+", line).group().lower() for line in lines}
    found = importlib.metadata.packages_distributions()
    return {name for name, owners in found.items() if wanted & {owner.lower() for owner in owners}}


def local_bases(folder, docker):
    """Run the script as a user without root and debootstrap; ``docker`` is a shell script in place of the engine's client."""
    for name, script in (("docker", docker), ("id", "echo 1000")):
        (folder / name).write_text(f"#!/bin/sh\n{script}\n")
        (folder / name).chmod(0o755)
    return subprocess.run(
        (DEPLOY / "docker" / "local_bases.sh",),
        env={"PATH": f"{folder}:/usr/bin:/bin", "TMPDIR": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )


def test_script_of_base_images_says_what_it_needs_before_it_pulls(tmp_path):
    asked = tmp_path / "pulled"
    done = local_bases(tmp_path, f"case $1 in info) ;; pull) echo $3 >> {asked}; exit 1;; *) exit 1;; esac")
    needs, _, refusal = (done.stdout + done.stderr).partition("local_bases.sh needs")
    assert (done.returncode, asked.read_text()) == (2, "python:3.11-slim-bookworm\n")
    assert "missing  root, for debootstrap: run it with sudo" in needs
    assert "missing  debootstrap: apt-get install debootstrap" in needs
    assert f"there    500 MB free in {tmp_path}" in needs
    assert "what is missing above, because no registry has python:3.11-slim-bookworm" in refusal


def test_script_of_base_images_asks_for_an_engine_and_leaves_present_images_alone(tmp_path):
    without_engine = local_bases(tmp_path, "exit 1")
    assert without_engine.returncode == 2
    assert "needs a running Docker engine" in without_engine.stderr
    present = local_bases(tmp_path, 'case $1 in info|image) ;; *) echo "not expected: $*" >&2; exit 1;; esac')
    assert (present.returncode, present.stdout) == (0, "local_bases.sh: both base images are there\n")


@pytest.mark.parametrize("name", ["prometheus/rules.yml", "grafana/dashboard.json"])
def test_alarms_and_panels_use_documented_metrics(name):
    explained = set(re.findall(r"^\| `(embo_\w+)` \|", GUIDE, flags=re.MULTILINE))
    asked = {re.sub(r"_bucket$", "", metric) for metric in METRIC.findall((DEPLOY / name).read_text())}
    assert asked
    assert asked <= explained


def test_grafana_panels_do_not_overlap():
    panels = json.loads((DEPLOY / "grafana" / "dashboard.json").read_text())["panels"]
    taken = set()
    for panel in panels:
        at = panel["gridPos"]
        cells = {(x, y) for x in range(at["x"], at["x"] + at["w"]) for y in range(at["y"], at["y"] + at["h"])}
        assert not cells & taken, panel["title"]
        taken |= cells
    assert max(x for x, _ in taken) < 24


def test_every_alarm_names_a_remedy():
    (group,) = yaml.safe_load((DEPLOY / "prometheus" / "rules.yml").read_text())["groups"]
    for rule in group["rules"]:
        assert rule["annotations"]["action"], rule["alert"]
        assert rule["labels"]["severity"] in ("warning", "critical")


def test_every_alarm_has_a_firing_and_a_silent_test():
    (group,) = yaml.safe_load((PROMETHEUS / "rules.yml").read_text())["groups"]
    quiet, idle, *loud = [
        {case["alertname"]: case.get("exp_alerts") for case in test["alert_rule_test"]}
        for test in yaml.safe_load((PROMETHEUS / "rules_test.yml").read_text())["tests"]
    ]
    alarms = {rule["alert"] for rule in group["rules"]}
    assert set(quiet) == set(idle) == alarms
    assert not any([*quiet.values(), *idle.values()])
    assert {name for test in loud for name, said in test.items() if said} == alarms


@needs_promtool
@pytest.mark.parametrize(
    "asked",
    [
        ("check", "rules", "rules.yml"),
        ("check", "config", "--syntax-only", "prometheus.yml"),
        ("test", "rules", "rules_test.yml"),
    ],
    ids=" ".join,
)
def test_prometheus_accepts_the_rules_and_fires_each_alarm(asked):
    ran = subprocess.run(("promtool", *asked), cwd=PROMETHEUS, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
