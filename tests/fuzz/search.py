"""Search for inputs that break a decoder: ``python -m tests.fuzz.search [--seconds S] [NAME ...]``.

With `atheris` installed the search is guided by coverage, one process per decoder; without it, Hypothesis draws mutations of
the known inputs. Inputs with new coverage stay in ``build/fuzz/NAME``. The first failing input of a decoder is kept there as
``crash-…`` with its traceback, and the exit status is 1.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import random
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from tests.fuzz.decoder import Mutate

ROOT: Final = Path(__file__).resolve().parents[2]
FOUND: Final = ROOT / "build" / "fuzz"
LONGEST_INPUT: Final = 65_536
MEMORY_MB: Final = 3_000
"""Most memory of the process of one decoder, with its libraries."""
INPUT_S: Final = 20
RUNS: Final = re.compile(r"(?:Done |number_of_executed_units: )(\d+)")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.search", description=__doc__)
    parser.add_argument("names", nargs="*", help="decoders; all of them by default")
    parser.add_argument("--seconds", type=float, default=600.0, help="time for all decoders together")
    parser.add_argument("--section", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.section:
        return _search_one(given.section, given.names[0], given.seconds)
    from tests.fuzz.decoders import SECTIONS, section

    known = {name: part for part in SECTIONS for name in section(part)}
    names = given.names or list(known)
    unknown = sorted(set(names) - set(known))
    if unknown:
        parser.error(f"there is no decoder {unknown[0]!r}: expected some of {', '.join(known)}")
    guided = importlib.util.find_spec("atheris") is not None
    print("guided by coverage (atheris)" if guided else "not guided by coverage: install atheris for that")
    statuses = [_report(known[name], name, given.seconds / len(names)) for name in names]
    return 1 if any(statuses) else 0


def folder_of(name: str) -> Path:
    """Return the folder of a decoder's inputs."""
    return FOUND / name.replace(" ", "-")


def _report(part: str, name: str, seconds: float) -> int:
    """Search in a process of its own, and print a line about it."""
    folder = folder_of(name)
    folder.mkdir(parents=True, exist_ok=True)
    log = FOUND / f"{folder.name}.log"
    began_s = time.monotonic()
    command = [
        sys.executable,
        "-m",
        "tests.fuzz.search",
        "--section",
        part,
        "--seconds",
        f"{seconds:.0f}",
        name,
    ]
    with log.open("wb") as out:
        status = subprocess.run(command, cwd=ROOT, stdout=out, stderr=out, check=False).returncode
    text = log.read_text(errors="replace")
    runs = max((int(found[1]) for found in RUNS.finditer(text)), default=0)
    spent_s = time.monotonic() - began_s
    verdict = "no finding" if status == 0 else f"FINDING, see {log.relative_to(ROOT)}"
    print(
        f"{name:<32} {runs:>9,} inputs in {spent_s:>6.0f} s, {len(list(folder.iterdir())):>5} kept: {verdict}",
        flush=True,
    )
    return status


def _search_one(part: str, name: str, seconds: float) -> int:
    if importlib.util.find_spec("atheris") is None:
        return _search_unguided(part, name, seconds)
    import atheris

    with atheris.instrument_imports(include=["embomatrix"]):
        from tests.fuzz.corpus import inputs_of
        from tests.fuzz.decoders import section

        decoder = section(part)[name]
        # Modules that decoders import late are instrumented only here.
        for data in decoder.seeds():
            decoder.check(data)
    folder = folder_of(name)
    for number, data in enumerate(inputs_of(name, decoder)):
        (folder / f"known-{number}").write_bytes(data)

    def mutate(data: bytes, largest: int, seed: int) -> bytes:
        rng = random.Random(seed)
        changed = decoder.mutate(data, rng) if rng.random() < 0.5 else atheris.Mutate(data, len(data) + 64)
        return changed[:largest]

    options = (
        f"-max_total_time={seconds:.0f}",
        f"-max_len={LONGEST_INPUT}",
        f"-rss_limit_mb={MEMORY_MB}",
        f"-timeout={INPUT_S}",
        f"-artifact_prefix={folder}/",
        "-print_final_stats=1",
        "-len_control=0",
    )
    atheris.Setup([sys.argv[0], *options, str(folder)], decoder.check, custom_mutator=mutate)
    atheris.Fuzz()
    return 0


def _search_unguided(part: str, name: str, seconds: float) -> int:
    """Let Hypothesis choose known inputs and the seeds of their mutations."""
    from hypothesis import HealthCheck, Phase, given, settings
    from hypothesis import strategies as st
    from tests.fuzz.corpus import inputs_of
    from tests.fuzz.decoders import section

    decoder, runs = section(part)[name], 0
    inputs = inputs_of(name, decoder)
    ends_s = time.monotonic() + seconds

    @settings(
        max_examples=500,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        database=None,
        phases=[Phase.generate],
    )
    @given(st.sampled_from(inputs), st.integers(0, 2**64 - 1))
    def search(data: bytes, seed: int) -> None:
        nonlocal runs
        runs += 1
        changed = several(decoder.mutate, data, random.Random(seed))[:LONGEST_INPUT]
        try:
            decoder.check(changed)
        except Exception:
            (folder_of(name) / f"crash-{seed}").write_bytes(changed)
            raise

    while time.monotonic() < ends_s:
        search()
    print(f"Done {runs} runs")
    return 0


def several(mutate: Mutate, data: bytes, rng: random.Random) -> bytes:
    """Return the input after one to four changes."""
    for _ in range(rng.randint(1, 4)):
        data = mutate(data, rng)
    return data


if __name__ == "__main__":
    os.environ.setdefault("PYTHONHASHSEED", "0")
    sys.exit(main())
