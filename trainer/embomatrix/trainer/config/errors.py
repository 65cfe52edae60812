"""What a person can mend: each message names the thing and the remedy."""

from __future__ import annotations

import pickle
from typing import Final

DAMAGE: Final = (OSError, ValueError, LookupError, TypeError, RuntimeError, EOFError, pickle.UnpicklingError)
"""What reading a damaged file may raise: torch's reader lets its own slips through."""


class TrainerError(Exception):
    """One sentence for a person; commands show it and end with status 2."""


def reason_of(error: BaseException) -> str:
    """What another library says, in short, for a message: torch writes essays with its traces in them."""
    text = (error.strerror or "") if isinstance(error, OSError) else ""
    lines = (text or str(error)).strip().splitlines() or [type(error).__name__]
    return lines[0].split(". ")[0].rstrip(".")
