"""Examples of README and the documents do what is printed: shell lines end well and write their files, the rest is parsed.

Every fenced block is listed: it is run here, or another test checks it, or its line needs more than a test of seconds has.
"""

import ast
import importlib
import json
import logging
import plistlib
import re
import shutil
import subprocess
import sys
import textwrap
import tomllib
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from tests.fakes.terminal import typed
from tests.integration.cli.test_documented_commands import problems_of
from torch.utils.data import DataLoader
from typer.testing import CliRunner

from embomatrix.factory.commands import scenes as scene_commands
from embomatrix.rpc.logs import JsonFormatter
from embomatrix.trainer.config.settings import checked_settings
from embomatrix.worker.host.settings import WorkerSettings

ROOT = Path(__file__).parents[3]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
CHECKED = Counter(
    {
        # test_python_example_names_nothing_that_is_missing, and tests/peers with the libraries
        ("adapters.md", "python"): 7,
        ("training.md", "python"): 1,  # test_lookahead_of_the_page_announces_coming_batches
        ("episodes.md", "python"): 4,  # tests/integration/test_episodes.py
        ("episodes.md", "text"): 1,
        ("skills.md", "json"): 1,  # tests/unit/skills/test_docs.py
        ("skills.md", "plan"): 1,
        ("rewards.md", "lisp"): 1,  # tests/unit/reward/test_docs.py
        ("rewards.md", "toml"): 1,
        ("tasks.md", "toml"): 1,  # tests/integration/factory/test_trial.py
        ("tasks.md", "text"): 1,
        ("tasks.md", "lisp"): 1,  # tests/integration/factory/test_docs.py
        ("scenes.md", "toml"): 1,  # tests/integration/factory/test_scene_report.py
        ("scenes.md", "text"): 1,  # test_refusal_of_a_house_is_the_printed_one
        ("training.md", "text"): 1,  # tests/integration/trainer/test_memory.py
        ("training.md", "toml"): 1,  # test_settings_of_the_pages_are_valid
        ("spare_pcs.md", "toml"): 1,
        ("spare_pcs.md", "xml"): 1,  # test_property_list_of_the_page_runs_a_worker
        ("operations.md", "json"): 1,  # test_log_line_of_the_page_has_the_fields_of_a_log_line
        ("README.md", "python"): 2,  # tests/integration/test_episodes.py, tests/peers/test_adapters.py
        ("README.md", "plan"): 1,  # test_plan_of_the_readme_earns_the_printed_reward
        ("README.md", "mermaid"): 1,  # `make diagrams`
        ("architecture.md", "mermaid"): 2,
        ("protocol.md", "mermaid"): 1,
        ("simulation.md", "mermaid"): 1,
    }
)
"""Blocks with a language, by page, and the tests that check them."""
NOT_COMMANDS = (
    "reward.custom_reward_function.",
    "actor_rollout_ref.",
    "--reward.remote_url",
    "reward = ",
    "format ",
)
"""Beginnings of blocks without a language that are settings of other programs, or formulas."""
ELSEWHERE = {
    r"^(make|pip|source|docker|PYTHONPATH=|ACCESS=)": "prepares the machine",
    r"^inspect eval": "needs a model: tests/peers/test_inspect_ai.py",
    r"manager|worker|embomatrix (train|cluster|doctor|experiment|bench)|--llm|--endpoint": "needs a cluster or a model",
    r"HOST|URL|FOLDER|…|eai|--join": "has a placeholder, or needs a download",
    r"embomatrix eval|--policy|--answers": "judges 200 tasks, or needs a policy: tests/integration/cli/test_evaluate.py",
    r"factory (build|generate|corpus|audit|evaluate (?!lies)|difficulty --policy)": "takes minutes",
    r"--all|--physical": "takes minutes",
    r"my_assets|scenes/Rs_int.json --out": "needs the package coacd: tests/integration/factory imports without it",
    r"--interactive": "is played by a person: tests/integration/factory/test_trial.py",
    r"vllm serve|sglang\.launch_server": "is a server that needs a GPU",
    r"plan\.txt": "reads a plan of a person's own: tests/integration/cli/test_play.py",
    r"merge .* --resolve|--activity cook_bacon|merge mine talks imported": "is one of several forms of a command",
}
"""Lines that aren't run here, and the reason."""
NAMED = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
FILE = re.compile(r"(?<![\w/.])[\w./-]+\.(?:png|jpg|html|json|jsonl|parquet|toml|md|txt)\b")


class ShellLine(NamedTuple):
    page: str
    text: str
    comment: str


def shell_lines() -> list[ShellLine]:
    """Return the lines of all blocks without a language, continuations joined."""
    found = []
    for page in PAGES:
        for language, block in FENCE.findall(page.read_text(encoding="utf-8")):
            if not language and not block.startswith(NOT_COMMANDS):
                for line in filter(None, block.replace("\\\n", " ").splitlines()):
                    text, _, comment = line.partition("  #")
                    found.append(ShellLine(page.name, text.strip(), comment.strip()))
    return found


def reason_elsewhere(line: ShellLine) -> str:
    return next((reason for pattern, reason in ELSEWHERE.items() if re.search(pattern, line.text)), "")


RUN = [line for line in shell_lines() if not reason_elsewhere(line)]


def prepared(folder: Path) -> None:
    """Write the inputs that the pages speak of: a dataset, task files, a floor plan, a model, a house of ProcTHOR."""
    shutil.copytree(
        DOCS / "examples", folder / "docs" / "examples", ignore=shutil.ignore_patterns("__pycache__")
    )
    flat = (DOCS / "examples" / "two_bedroom_flat.toml").read_text(encoding="utf-8")
    (folder / "my_flat.toml").write_text(
        re.sub(r"^scene = .*", 'scene = "my_flat"', flat, flags=re.MULTILINE)
    )
    tidy = (DOCS / "examples" / "tidy_kitchen.toml").read_text(encoding="utf-8")
    # The page's flat has no dining room.
    (folder / "tidy.toml").write_text(tidy.replace("inroom dining_room", "inroom kitchen"))
    (problem,) = re.findall(r"```lisp\n(.*?)```", (DOCS / "tasks.md").read_text(encoding="utf-8"), re.DOTALL)
    (folder / "apples.bddl").write_text(problem)
    (folder / "problems.jsonl").write_text(json.dumps({"name": "apples", "bddl": problem}))
    (folder / "cupboard.obj").write_text(box(0.0, 1.0))
    floor = [{"x": x, "z": z} for x, z in ((0, 0), (0, 4), (4, 4), (4, 0))]
    house = {"rooms": [{"id": "room|1", "roomType": "Kitchen", "floorPolygon": floor}]}
    (folder / "house_7.json").write_text(json.dumps(house))
    for name in ("talks", "mine", "all"):
        write_kitchen_dataset(folder / name)


def in_shell(line: str) -> tuple[int, str]:
    """Run a line with pipes in a shell; return its exit status and its output."""
    script = f'embomatrix() {{ "{sys.executable}" -m embomatrix.cli "$@"; }}; {line}'
    script = script if "embomatrix factory" in line else script.replace(line, f"embomatrix {line}")
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", script], capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout + done.stderr


def box(low: float, high: float) -> str:
    """Return a cube as OBJ text."""
    corners = [(x, y, z) for x in (low, high) for y in (low, high) for z in (low, high)]
    faces = ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
    return "".join([*(f"v {x} {y} {z}\n" for x, y, z in corners), *(f"f {face}\n" for face in faces)])


@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "page",
    [
        # The other pages take a minute each.
        pytest.param(page, marks=[] if page in {"README.md", "index.md"} else pytest.mark.slow)
        for page in sorted({line.page for line in RUN})
    ],
)
def test_lines_of_the_page_run_and_write_their_files(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("EMBOMATRIX_DATASET", raising=False)
    lines = [line for line in RUN if line.page == page]
    if any("scenes/my_flat.json" in line.text for line in lines):
        assert typed("scene build my_flat.toml --out scenes")[0] == 0
    task = ""
    for line in lines:
        command = line.text.removeprefix("embomatrix ")
        if "--dataset talks" in command:
            command = command.replace("TASK", "apple_to_counter")
        status, output = (in_shell if re.search("[|>]", command) else typed)(command.replace("TASK", task))
        assert status == 0, f"{line.text}\n{output}"
        if command == "factory list":
            task = output.split()[0]
        if "--oracle" in command:
            assert "success" in output, output
        missing = [name for name in FILE.findall(f"{line.text} {line.comment}") if not Path(name).exists()]
        assert not missing, f"{line.text} does not write {missing}"
        for count in re.findall(r"\d+ (?:training|held-out)", line.comment):
            assert count in output, line


def test_every_block_of_the_pages_is_checked_or_has_a_reason() -> None:
    blocks: Counter[tuple[str, str]] = Counter()
    for page in PAGES:
        for language, _ in FENCE.findall(page.read_text(encoding="utf-8")):
            blocks[page.name, language] += bool(language)
    assert +blocks == CHECKED
    unknown = [line for line in RUN if not re.match(r"(echo .* \| )?embomatrix ", line.text)]
    assert not unknown, "a line is neither run nor excused"
    unused = [
        pattern for pattern in ELSEWHERE if not any(re.search(pattern, line.text) for line in shell_lines())
    ]
    assert not unused
    assert len(RUN) > 40


def test_commands_that_other_tests_run_name_no_missing_option() -> None:
    lines = [line.text for line in shell_lines() if line.text.startswith("embomatrix ")]
    assert not {line: found for line in lines if (found := problems_of(line))}


def test_refusal_of_a_house_is_the_printed_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (printed,) = re.findall(
        r"```text\n(.*?)\n```", (DOCS / "scenes.md").read_text(encoding="utf-8"), re.DOTALL
    )
    monkeypatch.chdir(tmp_path)
    rooms = ("kitchen_0", "living_room_0", "bedroom_0", "bathroom_0")
    places = "".join(
        f"[rooms.{name}]\nrect_m = [{4 * at}, 0, {4 * at + 4}, 4]\n" for at, name in enumerate(rooms)
    )
    pairs = [*pairwise(rooms), (rooms[0], rooms[-1])]
    doors = ", ".join(f'{{rooms = ["{one}", "{other}"]}}' for one, other in pairs)
    Path("my_flat.toml").write_text(f'scene = "my_flat"\ndoors = [{doors}]\n{places}')
    refused = CliRunner().invoke(scene_commands.app, ["build", "my_flat.toml", "--out", "scenes"])
    assert refused.exit_code == 2
    assert refused.stderr.strip() == f"embomatrix: {printed}"


def test_plan_of_the_readme_earns_the_printed_reward(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (plan,) = re.findall(r"```plan\n(.*?)```", readme, re.DOTALL)
    (task,) = re.findall(r"embomatrix play (\w+-heldout-\S+) --oracle", readme)
    monkeypatch.chdir(tmp_path)  # without a dataset: of the shipped tasks
    monkeypatch.delenv("EMBOMATRIX_DATASET", raising=False)
    Path("plan.txt").write_text(plan)
    status, output = typed(f"play {task} --plan plan.txt")
    assert status == 0, output
    (reward,) = re.findall(r"the reward is (\d+\.\d):", readme)
    assert re.search(rf"total\s*│ success\s*│\s*{reward}0 ", output), output
    (request,) = re.findall(r"^> (.*)$", readme, re.MULTILINE)
    assert request in " ".join(output.split())


def test_settings_of_the_pages_are_valid() -> None:
    (training,) = re.findall(
        r"```toml\n(.*?)```", (DOCS / "training.md").read_text(encoding="utf-8"), re.DOTALL
    )
    settings = checked_settings(tomllib.loads(training))
    assert (settings.lora.rank, settings.grpo.learning_rate) == (16, 1e-4)
    (worker,) = re.findall(
        r"```toml\n(.*?)```", (DOCS / "spare_pcs.md").read_text(encoding="utf-8"), re.DOTALL
    )
    lent = WorkerSettings(**tomllib.loads(worker))
    assert (lent.cache_mb, lent.labels, lent.preferences.mains_only) == (2048, {"room": "lab"}, True)


def test_property_list_of_the_page_runs_a_worker() -> None:
    (text,) = re.findall(r"```xml\n(.*?)```", (DOCS / "spare_pcs.md").read_text(encoding="utf-8"), re.DOTALL)
    words = plistlib.loads(text.encode())["ProgramArguments"]
    options = words[words.index("embomatrix-worker") + 1 :]
    assert options
    assert not problems_of(f"embomatrix worker run {' '.join(options)}")


def test_log_line_of_the_page_has_the_fields_of_a_log_line() -> None:
    (text,) = re.findall(
        r"```json\n(.*?)```", (DOCS / "operations.md").read_text(encoding="utf-8"), re.DOTALL
    )
    printed = json.loads(text)
    more = list(printed)[4:]
    message = "lease failed " + " ".join(f"{name}=%s" for name in more)
    record = logging.LogRecord(
        printed["logger"], logging.WARNING, "", 0, message, tuple(printed[name] for name in more), None
    )
    logged = json.loads(JsonFormatter().format(record))
    assert list(logged) == list(printed)
    assert {name: logged[name] for name in ("level", "logger", *more)} == {
        name: printed[name] for name in ("level", "logger", *more)
    }
    assert re.sub(r"\d", "0", logged["time"]) == re.sub(r"\d", "0", printed["time"])


PYTHON = [
    pytest.param(page, block, id=f"{page.name}-{number}")
    for page in PAGES
    for number, (language, block) in enumerate(FENCE.findall(page.read_text(encoding="utf-8")))
    if language == "python"
]


@pytest.mark.parametrize(("page", "block"), PYTHON)
def test_python_example_names_nothing_that_is_missing(page: Path, block: str) -> None:
    source = f"async def example():\n{textwrap.indent(block, '    ')}" if "async with" in block else block
    given = "loader = announce = None\n" if page.name == "training.md" else ""
    checked = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--isolated", "--select=F821,E9", "-"],
        input=given + source,
        capture_output=True,
        text=True,
        check=False,
    )
    assert checked.returncode == 0, checked.stdout
    imports = re.findall(r"^from (embomatrix[\w.]*) import \(?([^)]*?)(?:\)|$)", block, re.MULTILINE)
    assert imports or "import embomatrix" in block
    for module, names in imports:
        assert set(re.findall(r"\w+", names)) <= names_in(module), module


def names_in(module: str) -> set[str]:
    """Return what a module defines, or what the ``__init__`` of a package offers."""
    place = module.replace(".", "/")
    path = next(iter([*ROOT.glob(f"*/{place}.py"), *ROOT.glob(f"*/{place}/__init__.py")]))
    nodes = [*ast.walk(ast.parse(path.read_text()))]
    defined = {node.name for node in nodes if isinstance(node, NAMED)}
    return defined | {
        alias.name for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names
    }


@pytest.mark.parametrize(
    ("module", "package"),
    [
        ("embomatrix.envs.gym", "gymnasium"),
        ("embomatrix.envs.openenv", "openenv"),
        ("embomatrix.trainer.adapters.verifiers", "verifiers"),
    ],
)
def test_module_without_its_library_prints_the_pip_line(
    module: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, module, raising=False)
    with pytest.raises(
        ModuleNotFoundError, match=rf"^{module} needs the package {package}\S*: pip install '{package}>="
    ):
        importlib.import_module(module)


def test_lookahead_of_the_page_announces_coming_batches() -> None:
    (block,) = [param.values[1] for param in PYTHON if param.values[0].name == "training.md"]
    announced: list[list[list[int]]] = []
    known = {
        "loader": DataLoader(range(8), batch_size=2, collate_fn=list),
        "announce": lambda window: announced.append([list(batch) for batch in window]),
    }
    exec(compile(block, "training.md", "exec"), known)
    assert announced[0] == [[0, 1], [2, 3], [4, 5], [6, 7]], "this batch and the three after it"
    assert announced[-1] == [[6, 7]]
