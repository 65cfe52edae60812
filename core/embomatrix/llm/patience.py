"""How long a batch goes on while an endpoint does not answer: some questions may fail, not all that follow."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from embomatrix.llm.values import EndpointError

MOST_UNANSWERED: Final = 3
"""Questions in a row that nobody answers, each asked several times, after which the endpoint counts as dead."""


class FailureLimit:
    """Counts questions in a row that nobody answered."""

    def __init__(self, most: int = MOST_UNANSWERED) -> None:
        self._most = most
        self._unanswered = 0

    def answered(self) -> None:
        """Somebody is there."""
        self._unanswered = 0

    def unanswered(self, error: EndpointError) -> None:
        """Raises the error where it is one too many: whoever waits for a dead endpoint waits in vain."""
        self._unanswered += 1
        if self._unanswered >= self._most:
            raise error
