"""Design of an experiment: seeds, a shared imitation, and the settings in which the arms differ."""

import hashlib
import json
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.world.whole_file import write_whole

WITH_RELEVANCE: Final = "with-relevance"
WITHOUT_RELEVANCE: Final = "without-relevance"
_NAME: Final = re.compile(r"[a-z0-9][a-z0-9._-]*")
_FILE: Final = "design.json"
SECTION_FILE: Final = "section.md"
"""Report of the experiment in its folder."""


@dataclass(frozen=True, slots=True)
class Arm:
    """Settings of one arm by dotted key, the values as TOML."""

    name: str
    settings: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Budget:
    """Wall time in seconds, or a number of steps, which makes results independent of other load."""

    seconds: float
    steps: int | None = None

    def __str__(self) -> str:
        return f"{self.seconds:g} s" if self.steps is None else f"{self.steps} steps"


@dataclass(frozen=True, slots=True)
class Design:
    """Everything that determines an experiment except the machine. ``shared`` settings hold for imitation and all arms.

    For each seed one policy imitates within its budget and stops early after ``patience`` measurements without a lower loss.
    Each arm starts from that policy. ``dataset`` is the folder's name and the digest of its tasks.
    """

    name: str
    dataset: str
    model: str
    seeds: tuple[int, ...]
    imitation: Budget
    patience: int
    grpo: Budget
    threads: int
    shared: Mapping[str, str]
    arms: tuple[Arm, ...]


RELEVANCE_ARMS: Final = (
    Arm(WITH_RELEVANCE, {}),
    Arm(WITHOUT_RELEVANCE, {"grpo.relevance": "0.0"}),
)
"""Arms of the paper's ablation."""


def dataset_digest(dataset: Path) -> str:
    """First digits of the digest of a dataset's tasks. Raise TrainerError if there is no dataset."""
    tasks = dataset / "tasks.jsonl"
    if not tasks.is_file():
        raise TrainerError(
            f"no dataset at {dataset}: get the shipped one with `embomatrix factory starter --out={dataset}`"
        )
    return hashlib.sha256(tasks.read_bytes()).hexdigest()[:12]


def parse_settings(texts: Iterable[str]) -> dict[str, str]:
    """Parse ``KEY=VALUE`` texts; a value that is no TOML is a string. Raise TrainerError."""
    found: dict[str, str] = {}
    for text in texts:
        key, equals, value = (part.strip() for part in text.partition("="))
        if not (key and equals and value):
            raise TrainerError(f"{text!r}: expected KEY=VALUE, for example grpo.learning_rate=4e-4")
        found[key] = value if _is_toml(value) else json.dumps(value)
    return found


def parse_arm(text: str) -> Arm:
    """Parse ``NAME`` or ``NAME:KEY=VALUE,KEY=VALUE``. Raise TrainerError."""
    name, _, settings = text.partition(":")
    if not _NAME.fullmatch(name):
        raise TrainerError(
            f"the arm {text!r} has the name {name!r}: expected small letters, digits, points and hyphens, then a colon and "
            "settings, for example fast:grpo.learning_rate=4e-4"
        )
    return Arm(name, parse_settings(settings.split(",") if settings else ()))


def checked_arms(arms: Sequence[Arm]) -> tuple[Arm, ...]:
    """Return the arms if their names differ. Raise TrainerError."""
    names = [arm.name for arm in arms]
    if len(set(names)) < len(names) or not names:
        raise TrainerError(f"the arms are called {', '.join(names) or 'nothing'}: expected one name for each")
    return tuple(arms)


def toml_of(settings: Mapping[str, str]) -> str:
    """Settings file for `embomatrix train --settings`."""
    return "".join(f"{key} = {value}\n" for key, value in settings.items())


def keep_design(folder: Path, design: Design) -> None:
    """Write the design into the folder, or check that the folder holds this one. Raise TrainerError, OSError."""
    path = folder / _FILE
    value = json.loads(json.dumps(asdict(design)))
    if path.exists():
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise TrainerError(f"{path} is damaged ({error}): remove it, or pass another --out") from error
        other = sorted(name for name in value if before.get(name) != value[name])
        if other:
            raise TrainerError(
                f"{folder} holds another experiment: {', '.join(other)} differ; repeat its options to resume it, or pass "
                "another --out"
            )
        return
    if (folder / SECTION_FILE).exists():
        raise TrainerError(
            f"{folder / SECTION_FILE} belongs to no experiment: pass another --out, or move it away"
        )
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(path, (json.dumps(value, indent=1) + "\n").encode("utf-8"))


def _is_toml(value: str) -> bool:
    try:
        tomllib.loads(f"value = {value}")
    except tomllib.TOMLDecodeError:
        return False
    return True
