"""Errors that a user can fix. Each message names the object, the finding, the expectation and the remedy."""

import pickle
from typing import Final

DAMAGE: Final = (OSError, ValueError, LookupError, TypeError, RuntimeError, EOFError, pickle.UnpicklingError)
"""Exceptions that reading a damaged file may raise. ``torch.load`` raises the errors of its internal readers."""


class TrainerError(Exception):
    """Error with a one-sentence message for the user. Commands print it and exit with status 2."""


def reason_of(error: BaseException) -> str:
    """Return the first sentence of another library's error: torch puts stack traces into its messages."""
    text = (error.strerror or "") if isinstance(error, OSError) else ""
    lines = (text or str(error)).strip().splitlines() or [type(error).__name__]
    return lines[0].split(". ")[0].rstrip(".")


def first_of(errors: ExceptionGroup[Exception]) -> Exception:
    """Return the first single error of a group."""
    first = errors.exceptions[0]
    return first_of(first) if isinstance(first, ExceptionGroup) else first
