"""Every decoder of foreign bytes gives a value or one of its documented errors, in bounded time and memory."""

import ast
import random
import resource
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.fuzz.corpus import FOLDER, inputs_of
from tests.fuzz.decoder import DEEP, Decoder, SlowError, mutate_bytes
from tests.fuzz.decoders import OWN, decoders, forget_inputs
from tests.fuzz.parsing_calls import ROOT, parsing_functions
from tests.fuzz.search import several
from tests.fuzz.wire import ANSWER_USES, ANSWERS, REQUEST_USES

from embomatrix.bench.adversary.kinds import REQUESTS

NAMES = tuple(decoders())
MEMORY_MB = 400
"""Memory by which all inputs of one decoder may grow the process, with the libraries that it loads late."""
ODD = (
    b"",
    b"\x00",
    b"\xff\xfe",
    b"[" * DEEP,
    b'{"a":' * DEEP,
    b"a = " + b"[" * DEEP,
    b"(" * DEEP,
    b"<a>" * DEEP,
    b"```" + b"\n" * 60_000,
    b"-" * 60_000,
    b'"\\ud800"',
    b"9" * 5_000,
    b"NaN",
    b"1e999",
    b"null",
    b"[[]]",
    b"{}",
    b"\n\n\n",
    b"\x1f\x8b" + bytes(40),
    b"PK\x03\x04" + bytes(40),
)
"""Inputs that broke some decoder."""


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # damaged numbers of meshes
@pytest.mark.parametrize("name", NAMES)
def test_known_inputs_give_values_or_documented_errors(name):
    decoder, before_mb = decoders()[name], peak_mb()
    for data in (*inputs_of(name, decoders()[name]), *ODD):
        decoder.check(data)
    assert peak_mb() - before_mb < MEMORY_MB


def peak_mb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", NAMES)
def test_mutations_of_known_inputs_give_values_or_documented_errors(name):
    decoder, inputs = decoders()[name], inputs_of(name, decoders()[name])

    @settings(max_examples=40)
    @given(st.sampled_from(inputs), st.integers(0, 2**32))
    def check(data, seed):
        decoder.check(several(decoder.mutate, data, random.Random(seed)))

    check()


def test_every_function_with_a_parsing_call_is_listed_once():
    read = {function for decoder in decoders().values() for function in decoder.reads}
    assert parsing_functions() == read | OWN.keys()
    assert not read & OWN.keys()


@pytest.mark.parametrize("name", [name for name in NAMES if decoders()[name].reads])
def test_seeds_reach_the_parsers_that_the_table_lists(name):
    called = set()

    def note(frame, event, _):
        if event == "call" and "/embomatrix/" in frame.f_code.co_filename:
            path = Path(frame.f_code.co_filename)
            parts = path.with_suffix("").parts
            module = ".".join(parts[parts.index("embomatrix", len(ROOT.parts)) + 1 :])
            called.add(f"{module}:{frame.f_code.co_qualname.replace('.<locals>', '')}")

    decoder = decoders()[name]
    forget_inputs()
    sys.setprofile(note)
    try:
        for data in decoder.seeds():
            decoder.check(data)
    finally:
        sys.setprofile(None)
    assert decoder.reads <= called


def test_parsing_calls_are_found_in_any_function():
    assert "world.json_text:parse_json" in parsing_functions()
    assert "skills.parse:_json_values" in parsing_functions()
    assert not any(function.startswith("skills.library") for function in parsing_functions())


def test_every_message_of_the_protocol_is_converted_as_its_receiver_does():
    names = {kind.DESCRIPTOR.name for kind in (*REQUESTS.values(), *ANSWERS.values())}
    assert REQUEST_USES.keys() | ANSWER_USES.keys() <= names
    used = (ROOT / "tests" / "fuzz" / "wire.py").read_text()
    converters = {
        target.id
        for path in (ROOT / "core" / "embomatrix" / "rpc" / "wire").glob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        for target in ast.walk(node)
        if isinstance(target, ast.Name)
        and isinstance(target.ctx, ast.Store)
        and target.id.endswith("_from_proto")
    }
    top = {name for name in converters if not name.startswith("_")}
    inner = {
        "infra_failure_from_proto", "reward_from_proto", "resident_from_proto", "run_event_from_proto"
    }  # fmt: skip
    assert {name for name in top - inner if name not in used} == set()


def test_corpus_is_small_and_belongs_to_decoders():
    files = sorted(FOLDER.glob("*.txt"))
    assert {path.stem for path in files} <= {name.replace(" ", "-") for name in NAMES}
    assert sum(path.stat().st_size for path in files) < 300_000


def test_other_errors_and_slow_inputs_are_findings():
    def failing(data):
        raise KeyError(data)

    with pytest.raises(KeyError):
        Decoder(failing, (ValueError,), list, frozenset(), mutate_bytes).check(b"")
    assert Decoder(failing, (LookupError,), list, frozenset(), mutate_bytes).check(b"") is KeyError

    with pytest.raises(SlowError, match="3 bytes took"):
        Decoder(lambda _: sum(range(10**6)), (), list, frozenset(), mutate_bytes, most_s=0.0).check(b"abc")
