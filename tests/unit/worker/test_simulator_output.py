"""Output of the engine: it does not grow without bound, and only its end is read."""

from embomatrix.worker.slots.processes import LAST_BYTES, LOG_BYTES, _last_line, _shorten


def test_last_line_is_found_at_the_end_of_a_long_output(tmp_path):
    log = tmp_path / "simulator.log"
    log.write_bytes(b"b3Warning\n" * LAST_BYTES + b"\xffno libGL\n\n")
    assert _last_line(log) == "\N{REPLACEMENT CHARACTER}no libGL"
    log.write_bytes(b"")
    assert _last_line(log) == ""


def test_only_a_long_output_begins_anew(tmp_path):
    log = tmp_path / "simulator.log"
    _shorten(log)
    log.write_bytes(b"x" * LOG_BYTES)
    _shorten(log)
    assert log.stat().st_size == LOG_BYTES
    log.write_bytes(b"x" * (LOG_BYTES + 1))
    _shorten(log)
    assert log.stat().st_size == 0
