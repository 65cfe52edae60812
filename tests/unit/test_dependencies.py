"""Each package that the source imports is declared: by the extra of the command that loads it, or by that of an option."""

import ast
import re
import sys
import tomllib
from collections import deque
from functools import cache
from pathlib import Path

import pytest

from embomatrix.cli.doctor.machine import NEEDED
from embomatrix.cli.main import COMMANDS

ROOT = Path(__file__).parents[2]
MANIFEST = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = MANIFEST["project"]
EXTRAS = PROJECT["optional-dependencies"]
ENTRIES = PROJECT["entry-points"]["embomatrix.commands"]
PACKAGES = [ROOT / name for name in MANIFEST["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]]
DISTRIBUTIONS = {
    "PIL": "pillow",
    "google": "protobuf",
    "grpc": "grpcio",
    "grpc_health": "grpcio-health-checking",
    "grpc_reflection": "grpcio-reflection",
    "yaml": "pyyaml",
}
"""Names of distributions that differ from the names of their packages."""
HOSTS = {
    "behavior_eval": "EAI's judge, in an environment of its own",
    "bddl": "the source of the catalog tables, and EAI's judge",
    "datasets": "comes with TRL",
    "gymnasium": "the user's library, for envs.gym",
    "inspect_ai": "the user's library, for envs.inspect_ai",
    "openenv": "the user's library, for envs.openenv",
    "trackio": "experiment tracker of the user",
    "trl": "the user's library, for the adapter",
    "verifiers": "the user's library, for the adapter",
    "verl": "the user's library, for envs.verl",
    "wandb": "experiment tracker of the user",
}
"""Libraries that no extra installs: users who have them get a connection to them."""
NAMED_BY_THE_CODE = {
    "av": "film",
    "coacd": "importers",
    "huggingface_hub": "hf",
    "jinja2": "hf",
    "peft": "hf",
    "pyarrow": "export",
    "pybullet": "physics",
    "ray": "ray",
    "safetensors": "hf",
    "tokenizers": "hf",
    "transformers": "hf",
}
"""Packages of an option, by the extra that an error of the code itself names, or an error of code that runs earlier."""
USED_BY_OTHERS = {
    "accelerate": "transformers reads GGUF files with it",
    "atheris": "tests/fuzz",
    "build": "`bench first-hour` runs it",
    "gguf": "transformers reads GGUF files with it",
    "hatch-vcs": "the build reads the version with it",
    "hatchling": "builds the wheel",
}


def modules():
    """Path of every module of the wheel by its name."""
    found = {}
    for package in PACKAGES:
        for file in package.rglob("*.py"):
            parts = file.relative_to(package.parent).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


MODULES = modules()


def names_in(source):
    """Names that a source imports: at its own import, and later, in functions or as programs that it starts."""
    names = (set(), set())
    waiting = [(ast.parse(source), False)]
    while waiting:
        node, later = waiting.pop()
        match node:
            case ast.If(test=ast.Name("TYPE_CHECKING")):
                continue
            case ast.Import():
                names[later].update(name.name for name in node.names)
            case ast.ImportFrom():
                assert node.level == 0, "imports are absolute"
                names[later].update((node.module, *(f"{node.module}.{name.name}" for name in node.names)))
            case ast.Call(
                ast.Attribute(attr="import_module") | ast.Name("import_module"), [ast.Constant(name)]
            ):
                names[later].add(name)
            case ast.Constant(str(text)) if text in MODULES:
                names[True].add(text)
        later = later or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        waiting += [(child, later) for child in ast.iter_child_nodes(node)]
    return names


@cache
def imported(module):
    """Modules of this project, packages around them included, and packages of others: at import and later."""
    found = []
    for names in names_in(MODULES[module].read_text(encoding="utf-8")):
        own, others = set(), set()
        for name in names:
            parts = name.split(".")
            if parts[0] == "embomatrix":
                own |= {".".join(parts[:end]) for end in range(1, len(parts) + 1)} & MODULES.keys()
            elif parts[0] not in sys.stdlib_module_names:
                others.add(parts[0])
        found.append((own, others))
    return found


@cache
def loaded(start, *, later):
    """Packages of others that a module loads: at its import, or with ``later`` at any time."""
    seen, packages, waiting = {start}, set(), deque([start])
    while waiting:
        for own, others in imported(waiting.popleft())[: 1 + later]:
            packages |= others
            waiting += own - seen
            seen |= own
    return packages


def distribution(package):
    return DISTRIBUTIONS.get(package, package.replace("_", "-"))


def distributions(packages):
    return {distribution(package) for package in packages}


def declared(*extras):
    """Distributions that the project and some extras declare; extras inside extras are resolved."""
    lines = [*PROJECT["dependencies"], *(line for extra in extras for line in EXTRAS[extra])]
    found = set()
    for line in lines:
        name, inner = re.match(r"([\w-]+)(?:\[([\w,]+)\])?", line).groups()
        if name == "embomatrix":
            found |= declared(*inner.split(","))
        else:
            found.add(name)
    return found


def test_imports_are_found_where_python_finds_them():
    source = (
        "import torch.nn\nfrom typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import rich\n"
        "def f():\n    from PIL import Image\n    importlib.import_module('pyarrow')\n"
    )
    assert names_in(source) == (
        {"torch.nn", "typing", "typing.TYPE_CHECKING"},
        {"PIL", "PIL.Image", "pyarrow"},
    )
    assert "scipy" in loaded("embomatrix.cli.play", later=False)
    assert "scipy" in loaded("embomatrix.worker.commands.app", later=True), "a slot is a program of its own"


def test_every_command_names_an_extra():
    assert COMMANDS.keys() == ENTRIES.keys()


@pytest.mark.parametrize("name", ENTRIES)
def test_extra_of_a_command_installs_what_the_command_imports(name):
    packages = loaded(ENTRIES[name].split(":")[0], later=False)
    assert packages
    assert distributions(packages) - declared(COMMANDS[name].extra) == set()


@pytest.mark.parametrize("name", ENTRIES)
def test_packages_of_a_commands_options_are_in_an_extra_that_the_message_names(name):
    command = COMMANDS[name]
    packages = loaded(ENTRIES[name].split(":")[0], later=True) - HOSTS.keys()
    further = {package for package in packages if distribution(package) not in declared(command.extra)}
    assert command.optional.keys() == further - NAMED_BY_THE_CODE.keys()


def test_extras_named_for_options_install_their_packages():
    named = {
        *NAMED_BY_THE_CODE.items(),
        *(pair for each in COMMANDS.values() for pair in each.optional.items()),
    }
    wrong = {package: extra for package, extra in named if distribution(package) not in declared(extra)}
    assert wrong == {}


def test_every_imported_package_is_declared_and_every_declared_one_imported():
    packages = set().union(*(others for module in MODULES for _, others in imported(module)))
    given = declared(*(EXTRAS.keys() - {"dev"}))
    assert distributions(packages - HOSTS.keys()) == given - USED_BY_OTHERS.keys()
    assert HOSTS.keys() <= packages


def test_tests_and_tools_import_only_packages_of_the_development_environment():
    files = [*(ROOT / "tests").rglob("*.py"), *(ROOT / "deploy").rglob("*.py"), ROOT / "bench" / "house.py"]
    names = set().union(*(names for file in files for names in names_in(file.read_text(encoding="utf-8"))))
    packages = (
        {name.split(".")[0] for name in names}
        - sys.stdlib_module_names
        - {"embomatrix", "tests"}
        - HOSTS.keys()
    )
    assert distributions(packages) - declared("dev", "fuzz") == set()


@pytest.mark.parametrize("extra", NEEDED)
def test_doctor_looks_for_all_packages_of_an_extra(extra):
    assert distributions(NEEDED[extra]) == declared(extra) - declared()
