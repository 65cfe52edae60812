"""Error messages that users meet most: each names the object at fault and a remedy, in plain English.

The test writes the table of all messages to build/messages.txt, to be read by a person.
"""

import asyncio
import contextlib
import io
import json
import os
import re
import shlex
import sys
from pathlib import Path
from string import Formatter
from unittest.mock import patch

import httpx
import pytest
from tests.fakes.chat_server import ChatServer
from tests.fakes.datasets import write_kitchen_dataset
from tests.integration.message_cases import CALLS, COMMANDS, REQUESTS, SKILLS, write_files
from tests.integration.test_manager_service import manager

from embomatrix.cli.main import main
from embomatrix.manager.web.rest import PREFIX
from embomatrix.rpc.status import ClusterError
from embomatrix.sim.engine import EngineError
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.view import refuse

TABLE = Path(__file__).parents[2] / "build" / "messages.txt"
SENTENCE_CHARS = 400
"""Most characters of a sentence; a digest counts as one word."""
DIGEST = re.compile("[0-9a-f]{64}")
BOX = re.compile("[╭╮╰╯│─]+( Error)?")
MESSAGE = re.compile(r"((?:embomatrix(?: [a-z]+)*: |Usage: |✗ ).*?)(?: (?:Final state|Reward) |$)")
"""Message in the output of a command: behind progress bars, before the tables of `play`."""
FORBIDDEN = re.compile(r"Traceback|should not have happened|\w(Error|Exception)\b[:(]")
"""Signs of an error that no code of ours put into words."""
RIDDLES = re.compile(r"\b(heed|mend|is none|none of|is no [a-z]|anew|errand|knocks?)\b", re.IGNORECASE)
FIELDS = tuple(
    {name for reason in FailureReason for _, name, _, _ in Formatter().parse(reason.sentence) if name}
)
pytestmark = pytest.mark.timeout(120)


def command_message(case, places):
    """Run the command in this process; return its message without progress bars and the frame of usage errors."""
    line = case.line
    for name, value in places.items():
        line = line.replace(name, value)
    output = io.StringIO()
    environment = {"COLUMNS": "1000", "HF_HUB_OFFLINE": "1", "NO_COLOR": "1", "HOME": places["FILES"]}
    with (
        patch.dict(os.environ, environment),
        patch.object(sys, "argv", ["embomatrix", *shlex.split(line)]),
        patch.object(sys, "stdin", io.TextIOWrapper(io.BytesIO(case.stdin.encode()))),
        hidden(case.hidden_package),
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(output),
        contextlib.suppress(SystemExit),
    ):
        main()
    text = " ".join(BOX.sub(" ", output.getvalue()).split())
    return MESSAGE.search(text)[1].strip()


@contextlib.contextmanager
def hidden(package):
    """Let imports of the package fail, also in modules of this project that were imported before."""
    if not package:
        yield
        return
    ours = (
        "embomatrix.trainer",
        "embomatrix.manager",
        "embomatrix.worker",
        "embomatrix.factory",
        "embomatrix.llm",
    )
    removed = {
        name: module for name, module in sys.modules.items() if name.startswith(ours) or name == package
    }
    for name in removed:
        del sys.modules[name]
    sys.modules[package] = None
    try:
        yield
    finally:
        for name in [name for name in sys.modules if name.startswith(ours) or name == package]:
            del sys.modules[name]
        sys.modules.update(removed)


def raised_by(case):
    with pytest.raises((ValueError, ClusterError, EngineError)) as caught:
        case.call()
    return str(caught.value)


async def refusals(folder):
    """Return the messages with which a manager refuses the REST requests."""
    messages = {}
    async with (
        manager(folder, token="secret") as at,
        httpx.AsyncClient(base_url=at.status_url, trust_env=False) as http,
    ):
        for case in REQUESTS:
            headers = {"authorization": f"Bearer {case.token}"} if case.token else {}
            answer = await http.request(
                case.method, f"{PREFIX}/{case.path}", content=case.body or None, headers=headers
            )
            assert 400 <= answer.status_code < 600, case.situation
            is_json = answer.headers["content-type"].startswith("application/json")
            detail = answer.json()["detail"] if is_json else answer.text
            messages[case] = detail if isinstance(detail, str) else json.dumps(detail)
    return messages


def skill_refusal(reason):
    values = {field: field.upper() for field in FIELDS}
    return refuse(reason, **values).sentence


@pytest.fixture(scope="module")
def messages(tmp_path_factory):
    """Messages of all cases, with the dataset's and the files' folders shortened."""
    files, kitchen = tmp_path_factory.mktemp("files"), tmp_path_factory.mktemp("data") / "kitchen"
    write_kitchen_dataset(kitchen)
    write_files(files, kitchen)
    with ChatServer((401, {}, '{"error": "invalid key"}', 0.0)).serving() as url:
        places = {"FILES": str(files), "KITCHEN": str(kitchen), "NOWHERE": "127.0.0.1:1", "URL": url}
        found = {case: command_message(case, places) for case in COMMANDS}
    found |= {case: raised_by(case) for case in CALLS}
    found |= asyncio.run(refusals(tmp_path_factory.mktemp("manager")))
    found |= {case: skill_refusal(case.reason) for case in SKILLS}
    return {
        case: text.replace(str(files), "FILES").replace(str(kitchen), "KITCHEN").replace(url, "URL")
        for case, text in found.items()
    }


def test_every_message_names_the_fault_and_a_remedy(messages):
    TABLE.parent.mkdir(exist_ok=True)
    TABLE.write_text(
        "".join(f"{case.situation}\n    {text}\n" for case, text in messages.items()), encoding="utf-8"
    )
    assert len(messages) >= 100
    faults = [
        f"{case.situation}: {fault}: {text!r}"
        for case, text in messages.items()
        for fault in faults_of(case, text)
    ]
    assert not faults, "\n".join(faults)


def faults_of(case, text):
    if not text:
        yield "empty"
    if FORBIDDEN.search(text):
        yield "shows an exception"
    if RIDDLES.search(text):
        yield "is not plain English"
    sentences = re.split(r"(?<=[.!?]) ", DIGEST.sub("DIGEST", text))
    if max(map(len, sentences), default=0) > SENTENCE_CHARS:
        yield f"has a sentence of more than {SENTENCE_CHARS} characters"
    if case.names not in text:
        yield f"does not name {case.names!r}"
    if case.remedy not in text:
        yield f"lacks the remedy {case.remedy!r}"


def test_every_failure_reason_has_a_case():
    assert [case.reason for case in SKILLS] == list(FailureReason)
