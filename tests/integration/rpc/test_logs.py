"""Log lines as text and JSON, with ids and without secrets."""

import asyncio
import contextvars
import json
import logging
import subprocess
import sys

import pytest

from embomatrix.rpc.logs import HumanFormatter, JsonFormatter, bind, hide, log_to_stderr

MANAGER_LINE = "lease expired rollout=%s worker=%s after=%.1f s (%d %% of its life)"


def record(message, *args, error=None):
    info = (type(error), error, error.__traceback__) if error else None
    return logging.LogRecord("embomatrix.test", logging.WARNING, __file__, 1, message, args, info)


def as_json(*args, **kwargs):
    return json.loads(JsonFormatter().format(record(*args, **kwargs)))


def alone(function):
    """Run in a fresh context, so that bound ids neither enter nor leave the test."""
    return contextvars.Context().run(function)


def test_named_values_of_a_message_are_json_fields():
    line = as_json(MANAGER_LINE, "x1", "w1", 2.5, 80)
    assert line["message"] == "lease expired rollout=x1 worker=w1 after=2.5 s (80 % of its life)"
    assert (line["rollout"], line["worker"], line["after"]) == ("x1", "w1", 2.5)
    assert (line["level"], line["logger"]) == ("warning", "embomatrix.test")
    assert line["time"].endswith("Z")


def test_bound_ids_are_on_every_line():
    def logged():
        bind("worker", "w1")
        bind("session", "abc")
        bind("session", "")
        return as_json("scene warm scene=%s", "s1"), HumanFormatter().format(
            record("scene warm scene=%s", "s1")
        )

    line, sentence = alone(logged)
    assert (line["worker"], line["scene"], "session" in line) == ("w1", "s1", False)
    assert sentence.endswith("WARNING scene warm scene=s1 worker=w1")
    assert "worker" not in alone(lambda: as_json("nothing is bound here"))


def test_bound_ids_are_per_task():
    async def serve(run):
        bind("run", run)
        await asyncio.sleep(0)
        return as_json("served")["run"]

    async def both():
        return await asyncio.gather(serve("r1"), serve("r2")), as_json("served")

    runs, line = alone(lambda: asyncio.run(both()))
    assert runs == ["r1", "r2"]
    assert "run" not in line


def test_exception_is_part_of_its_line():
    try:
        raise ValueError("two\nlines")
    except ValueError as error:
        text = JsonFormatter().format(record("it failed", error=error))
    assert "\n" not in text
    assert "ValueError: two\nlines" in json.loads(text)["exception"]


@pytest.mark.parametrize("formatter", [HumanFormatter(), JsonFormatter()])
def test_secrets_are_never_written(formatter):
    hide("s3cret-token")
    hide("ab")
    try:
        raise ValueError("refused s3cret-token")
    except ValueError as error:
        text = formatter.format(
            record("key=%s at %s", "s3cret-token", "redis://me:pw123@host/0", error=error)
        )
    text += formatter.format(record("header %s", "Bearer xyz.987"))
    assert not any(word in text for word in ("s3cret", "pw123", "xyz.987"))
    assert "me:***@host" in text
    assert "about" in formatter.format(record("about")), "a short word is left alone"


def test_message_without_arguments_is_logged_unchanged():
    assert as_json("plain id=%s without arguments")["message"] == "plain id=%s without arguments"


def test_message_fields_cannot_override_time_or_level():
    line = as_json("level=%s message=%s", "info", "all is well")
    assert (line["level"], line["message"]) == ("warning", "level=info message=all is well")


def test_unknown_level_is_refused():
    with pytest.raises(ValueError, match="expected debug, info, warning or error"):
        log_to_stderr("loud", None)


def test_libraries_log_warnings_and_errors_only():
    program = (
        "import logging; from embomatrix.rpc.logs import *; log_to_stderr('debug', LogFormat.JSON)\n"
        "logging.getLogger('asyncio').info('chatter'); logging.getLogger('asyncio').error('trouble')\n"
        "logging.getLogger('embomatrix.x').debug('detail')"
    )
    logged = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stderr
    assert [json.loads(line)["message"] for line in logged.splitlines()] == ["trouble", "detail"]
