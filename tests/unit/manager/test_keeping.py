"""Result logs, bundles, figures and settings of the manager."""

import asyncio
import dataclasses
import hashlib
import os
import zlib
from pathlib import Path

import pytest
from pydantic import ValidationError
from tests.fakes.worker import completed
from typer.testing import CliRunner

from embomatrix.manager.commands import app as commands
from embomatrix.manager.commands.app import app
from embomatrix.manager.control.dispatch.state import DispatchLimits
from embomatrix.manager.control.reputation import AuditRules
from embomatrix.manager.control.schedule.scheduler import ScheduleLimits
from embomatrix.manager.observe.metrics import Meter, quantile
from embomatrix.manager.runtime.bundles import BundleStore
from embomatrix.manager.runtime.registry import LivenessLimits
from embomatrix.manager.runtime.results import PER_MESSAGE, BatchLog, ResultLogs
from embomatrix.manager.runtime.serialization import group_and_kind, result_row, timed_row
from embomatrix.manager.services.app import limits_of
from embomatrix.manager.settings import ManagerSettings
from embomatrix.manager.store.protocol import ResultRow
from embomatrix.proto.v1.types_pb2 import RolloutResult as RolloutResultMessage
from embomatrix.rpc.status import InvalidRequestError, NotFoundError, OverloadedError
from embomatrix.rpc.wire.outcome import rollout_result_from_proto
from embomatrix.rpc.wire.values import Cancelled, Completed, GroupDone, InfraCode, InfraFailure, RolloutResult
from embomatrix.world.bundle import decode_bundle
from embomatrix.world.inflation import BundleError

MIB = 1024 * 1024


def rows(first, last):
    return [ResultRow(cursor, f"x{cursor}", b"") for cursor in range(first, last + 1)]


async def test_reader_waits_for_results_and_ends_with_the_batch():
    log = BatchLog("r1", "b1", "d")
    reader = asyncio.create_task(log.after(0))
    await asyncio.sleep(0)
    log.append(rows(1, 2))
    assert await reader == rows(1, 2)
    log.finish(0.0)
    assert await log.after(2) == []


async def test_results_of_a_batch_are_yielded_until_it_ends():
    log = BatchLog("r1", "b1", "d", rows(1, 2))
    sent = []
    async for message in log.messages(0):
        sent.append(message)
        if len(sent) == 1:
            log.append(rows(3, 3))
            log.append(rows(4, 4))
            log.finish(0.0)
    assert sent == [rows(1, 2), rows(3, 4)]


async def test_message_holds_a_bounded_number_of_results():
    log = BatchLog("r1", "b1", "d", rows(1, PER_MESSAGE + 1))
    assert await log.after(0) == rows(1, PER_MESSAGE)
    assert await log.after(PER_MESSAGE) == rows(PER_MESSAGE + 1, PER_MESSAGE + 1)


def test_group_ends_with_its_last_result_from_any_cursor():
    log = BatchLog("r1", "b1", "d", groups={"g1": 3, "g2": 1})
    outcomes = (("g1", Completed), ("g2", Cancelled), ("g1", InfraFailure), ("g1", Completed))
    for cursor, (group_id, kind) in enumerate(outcomes, start=1):
        log.ends.take(cursor, group_id, kind)
    assert log.ends.among(rows(1, 4)) == [GroupDone("g2", cancelled=1), GroupDone("g1", 2, 1)]
    assert log.ends.among(rows(3, 4)) == [GroupDone("g1", 2, 1)]
    assert log.ends.among(rows(3, 3)) == []


def test_delivery_time_is_added_to_the_row():
    result = RolloutResult("x1", "g1", 1, 1, completed())
    row = timed_row(result_row(result), 0.25)
    stored = rollout_result_from_proto(RolloutResultMessage.FromString(row.payload))
    timings = dataclasses.replace(result.outcome.timings, deliver_s=0.25)
    assert stored == dataclasses.replace(result, outcome=dataclasses.replace(result.outcome, timings=timings))
    assert group_and_kind(row) == ("g1", Completed, 1)


async def test_dropped_log_ends_its_readers():
    log = BatchLog("r1", "b1", "d")
    reader = asyncio.create_task(log.after(0))
    await asyncio.sleep(0)
    log.drop()
    assert await reader == []


async def test_old_or_excess_finished_logs_are_discarded():
    logs = ResultLogs(ttl_s=100, limit=25)
    for name, finished_s in (("old", 0.0), ("mid", 60.0), ("new", 70.0)):
        log = BatchLog("r1", name, "d", rows(1, 10))
        log.finish(finished_s)
        logs.add(log)
    logs.add(BatchLog("r1", "open", "d"))
    assert [log.batch_id for log in logs.outdated(80.0)] == ["old"]
    assert [log.batch_id for log in logs.outdated(165.0)] == ["old", "mid"]


async def pieces(*parts):
    for part in parts:
        yield part


def digest_of(data):
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


def packed(content):
    """Return a complete zlib stream, 11 bytes longer than its content."""
    return zlib.compress(content, level=0)


async def test_bundle_appears_only_when_its_digest_is_right(tmp_path):
    store = BundleStore(tmp_path, total_bytes=1000)
    data = packed(b"something")
    with pytest.raises(InvalidRequestError, match="expected sha256:"):
        await store.put(digest_of(b"other"), pieces(data[:5], data[5:]))
    assert list(tmp_path.iterdir()) == []
    await store.put(digest_of(data), pieces(data[:5], data[5:]))
    assert b"".join([part async for part in store.get(digest_of(data))]) == data


async def test_damaged_bundle_is_requested_again(tmp_path):
    store = BundleStore(tmp_path, total_bytes=1000)
    data = packed(b"content")
    digest = digest_of(data)
    await store.put(digest, pieces(data))
    assert await store.missing_or_damaged([digest, digest]) == []
    next(tmp_path.iterdir()).write_bytes(b"contemt")
    assert await store.missing_or_damaged([digest, digest]) == [digest]
    assert list(tmp_path.iterdir()) == []


async def counted(data, size, taken):
    for start in range(0, len(data), size):
        taken.append(start)
        yield data[start : start + size]


@pytest.mark.parametrize(
    ("data", "sentence", "pieces_taken"),
    [
        (os.urandom(9 * MIB), "not zlib-compressed", 1),
        (packed(os.urandom(9 * MIB)), "over 8,388,608 bytes", 9),
        (zlib.compress(bytes(40 * MIB)), "expected at most 100 to 1", 1),
        (packed(b"content")[:-3], "cut short", 1),
        (packed(b"content") + b"more", "bytes follow its end", 1),
    ],
    ids=["noise", "too large", "bomb", "cut short", "too long"],
)
async def test_unloadable_bundle_is_refused_during_upload(tmp_path, data, sentence, pieces_taken):
    store, taken = BundleStore(tmp_path, total_bytes=100 * MIB), []
    with pytest.raises(InvalidRequestError, match=sentence):
        await store.put(digest_of(data), counted(data, MIB, taken))
    assert list(tmp_path.iterdir()) == []
    assert len(taken) == pieces_taken
    with pytest.raises(BundleError, match=sentence if len(data) <= 8 * MIB else "over 8,388,608 bytes"):
        decode_bundle(data)


async def test_full_folder_refuses_bundles(tmp_path):
    store = BundleStore(tmp_path, total_bytes=70)
    await store.put(digest_of(packed(b"a" * 40)), pieces(packed(b"a" * 40)))
    with pytest.raises(OverloadedError, match="no room"):
        await store.put(digest_of(packed(b"b" * 40)), pieces(packed(b"b" * 40)))


async def test_missing_folder_is_named(tmp_path):
    store = BundleStore(tmp_path / "bundles", total_bytes=50)
    (tmp_path / "bundles").rmdir()
    with pytest.raises(OverloadedError, match=r"bundles can't be written \(No such file or directory\)"):
        await store.put(digest_of(b"a"), pieces(b"a"))


async def test_unknown_bundle_is_not_found(tmp_path):
    store = BundleStore(tmp_path, total_bytes=1000)
    with pytest.raises(NotFoundError, match="upload it first"):
        await anext(store.get(digest_of(b"nothing")))


def test_meter_counts_outcomes_and_keeps_reasons():
    meter = Meter()
    failure = InfraFailure(InfraCode.SLOT_CRASHED, "signal 11", "w1")
    for cursor, outcome in enumerate([completed(), completed(), failure, Cancelled()]):
        meter.observe("r1", RolloutResult(f"x{cursor}", "g", cursor, 1, outcome), 10.5)
    assert meter.outcomes == {"completed": 2, "slot_crashed": 1, "cancelled": 1}
    assert sum(meter.completed_by.values()) == 2
    assert meter.throughput(11.0)[-1] == 2
    assert meter.throughput(12.0)[-2:] == [2, 0]
    assert meter.latency_s(0.5) == pytest.approx(0.001)
    assert meter.failures[0].message == "signal 11"


def test_quantiles_of_few_values():
    assert quantile([], 0.5) == 0.0
    assert [quantile([1.0, 2.0, 3.0], share) for share in (0.0, 0.5, 0.95, 1.0)] == [1.0, 2.0, 3.0, 3.0]


def test_unknown_settings_are_refused_and_the_token_is_never_shown():
    with pytest.raises(ValidationError, match="Extra inputs"):
        ManagerSettings(prot=1)
    assert "secret" not in repr(ManagerSettings(token="secret"))


def test_options_override_the_settings_file(tmp_path, monkeypatch):
    served = []
    monkeypatch.setattr(commands, "_serve", served.append)
    file = tmp_path / "manager.toml"
    file.write_text("heartbeat_s = 2.5\nport = 1\n")
    answer = CliRunner().invoke(app, ["serve", f"--config={file}", "--port=2"])
    assert answer.exit_code == 0, answer.output
    assert (served[0].heartbeat_s, served[0].port) == (2.5, 2)


def test_token_of_the_settings_file_guards_the_manager(tmp_path, monkeypatch):
    monkeypatch.delenv("EMBOMATRIX_TOKEN", raising=False)
    served = []
    monkeypatch.setattr(commands, "_serve", served.append)
    (tmp_path / "token").write_text("kept-apart\n")
    file = tmp_path / "manager.toml"
    for token, options in (("plain", []), (f"@{tmp_path}/token", []), ("plain", ["--token=other"])):
        file.write_text(f'token = "{token}"\n')
        answer = CliRunner().invoke(app, ["serve", f"--config={file}", *options])
        assert answer.exit_code == 0, answer.output
    assert [settings.token for settings in served] == ["plain", "kept-apart", "other"]
    file.write_text("token = 5\n")
    answer = CliRunner().invoke(app, ["serve", f"--config={file}"])
    assert answer.exit_code == 2
    assert "--token: expected visible ASCII characters" in answer.output


def test_limits_have_the_values_of_the_settings_of_the_same_names():
    audit = AuditRules()
    assert limits_of(DispatchLimits, ManagerSettings(), audit=audit) == DispatchLimits()
    limits = limits_of(DispatchLimits, ManagerSettings(lease_ttl_s=7.0, max_attempts=5), audit=audit)
    assert limits == DispatchLimits(lease_ttl_s=7.0, max_attempts=5)
    assert limits_of(ScheduleLimits, ManagerSettings()) == ScheduleLimits()
    assert limits_of(LivenessLimits, ManagerSettings(lost_after_s=3.0)) == LivenessLimits(lost_after_s=3.0)


def test_state_file_is_in_the_data_folder_by_default():
    assert ManagerSettings(data_dir=Path("/d")).state_url == "sqlite:/d/state.sqlite"
    assert ManagerSettings(state="memory:").state_url == "memory:"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--host", "0.0.0.0"], "without TLS and tokens"),
        (["--tls-cert", "x"], "belong together"),
        (["--port", "70000"], "--port"),
        (["--state", "mysql://x"], "expected memory:, sqlite:PATH or redis://"),
        (["--state", "redis://127.0.0.1:1/0"], "can't be reached"),
        (["--log-level", "loud"], "expected debug, info"),
    ],
)
def test_bad_options_get_one_sentence_and_status_2(arguments, sentence, tmp_path):
    result = CliRunner().invoke(
        app, ["serve", "--data-dir", str(tmp_path), "--port", "0", "--http-port", "0", *arguments]
    )
    assert result.exit_code == 2
    assert sentence in result.output
    assert "Traceback" not in result.output


def test_data_folder_that_is_a_file_is_explained(tmp_path):
    (tmp_path / "file").write_text("")
    result = CliRunner().invoke(
        app, ["serve", "--data-dir", str(tmp_path / "file"), "--port", "0", "--http-port", "0"]
    )
    assert result.exit_code == 2
    assert "--data-dir" in result.output


def test_unreachable_manager_error_names_the_serve_command():
    result = CliRunner().invoke(app, ["token", "list", "--manager", "127.0.0.1:1"])
    assert result.exit_code == 2
    assert "embomatrix manager serve" in result.output
