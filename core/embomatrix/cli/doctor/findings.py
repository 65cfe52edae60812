"""What `embomatrix doctor` finds: one line about one thing, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


class Level(StrEnum):
    """How much it matters."""

    FINE = "fine"
    NOTE = "note"
    """Some part can't be used here, or will be in want of something."""
    WRONG = "wrong"


@dataclass(frozen=True, slots=True)
class Finding:
    """``thing`` is what was looked at, ``found`` what it is; ``remedy`` is empty where nothing needs to be done."""

    thing: str
    level: Level
    found: str
    remedy: str = ""


def verdict(findings: Sequence[Finding]) -> str:
    """All of them in one sentence."""
    wrong = [finding.thing for finding in findings if finding.level is Level.WRONG]
    if wrong:
        return f"{len(wrong)} of {len(findings)} things {_are(len(wrong))} wrong: {', '.join(wrong)}"
    notes = sum(finding.level is Level.NOTE for finding in findings)
    return (
        "all is well"
        if not notes
        else f"nothing is wrong; {notes} of {len(findings)} things {_are(notes)} worth a look"
    )


def _are(number: int) -> str:
    return "is" if number == 1 else "are"
