"""Text of other machines on its way to logs and terminals."""

import json
import logging

from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from embomatrix.cli.cluster.tables import run_table
from embomatrix.host.printable import printable
from embomatrix.rpc.logs import LINES, HumanFormatter, JsonFormatter, LineLimit, LogTail, hide
from embomatrix.rpc.wire.values import RunInfo, RunStats


def record(message: str, *values: object, at_s: float = 0.0) -> logging.LogRecord:
    made = logging.LogRecord("embomatrix.x", logging.WARNING, "f.py", 1, message, values, None)
    made.created = at_s
    return made


@given(st.text())
def test_printable_text_has_no_control_characters_and_keeps_the_others(text: str) -> None:
    shown = printable(text)
    assert all(character >= " " and not "\x7f" <= character <= "\x9f" for character in shown)
    assert [c for c in text if c.isalnum()] == [c for c in text if c.isalnum() and c in shown]


@given(st.text())
def test_json_stays_json_of_the_same_value(text: str) -> None:
    assert json.loads(printable(json.dumps([text], ensure_ascii=False, indent=1), lines=True)) == [text]


@given(st.text())
def test_a_log_line_about_any_name_is_one_line(name: str) -> None:
    for formatter in (HumanFormatter(), JsonFormatter()):
        line = formatter.format(record("opened run=%s", name))
        assert len(line.splitlines()) == 1
        assert "\x1b" not in line


def test_a_json_line_about_a_hostile_name_is_valid_json() -> None:
    line = JsonFormatter().format(record("opened run=%s", "a\x1b[2J\u202e\n{"))
    assert json.loads(line)["run"] == "a\\u001b[2J\\u202e\n{"


def test_lines_of_a_kind_are_limited_and_the_next_one_counts_the_suppressed() -> None:
    limit = LineLimit()
    passed = [limit.filter(record("refused %s", index)) for index in range(1000)]
    assert sum(passed) == LINES
    assert limit.filter(record("another kind"))
    later = record("refused %s", 7, at_s=60.0)
    assert limit.filter(later)
    assert later.getMessage() == f"refused 7 ({1000 - LINES} similar lines suppressed)"


def test_a_run_named_with_markup_and_escape_sequences_is_shown_as_text() -> None:
    console = Console(width=200, record=True, force_terminal=False)
    console.print(run_table([RunInfo("r1", "[/bold]\x1b[2J\nforged", RunStats(), 0)]))
    text = console.export_text()
    assert "[/bold]\\u001b[2J\\nforged" in text


def test_log_tail_keeps_the_latest_lines_and_hands_each_out_once() -> None:
    tail = LogTail(kept=3, characters=60)
    assert tail.lines(0, 20) == ((), 0)
    for number in range(5):
        tail.handle(record("line=%s", number))
    first, last = tail.lines(0, 2)
    assert [line[-6:] for line in first] == ["line=2", "line=3"]
    more, end = tail.lines(last, 20)
    assert ([line[-6:] for line in more], end) == (["line=4"], 5)
    assert tail.lines(end, 20) == ((), 5)


def test_log_tail_masks_secrets_cuts_long_lines_and_leaves_debug_lines_out() -> None:
    hide("the-credential-of-tail")
    tail = LogTail(kept=3, characters=80)
    logger = logging.getLogger("embomatrix.tail")
    logger.addHandler(tail)
    logger.setLevel(logging.DEBUG)
    try:
        logger.debug("not sent")
        logger.info("joined with the-credential-of-tail")
        logger.error("a\nb %s", "x" * 200)
    finally:
        logger.removeHandler(tail)
    (joined, long), _ = tail.lines(0, 20)
    assert joined.endswith("joined with ***")
    assert len(long) == 80
    assert long.endswith("…")
    assert "\n" not in long
