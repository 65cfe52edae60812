"""How many of the drafts that a build judged were admitted, by its ledger."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final

from embomatrix.factory.evaluate.figures import EvaluationError
from embomatrix.factory.pipeline.store import ATTEMPTS_FILE
from embomatrix.pages.figures import Better, Figure

if TYPE_CHECKING:
    from pathlib import Path

GOAL_PERCENT: Final = 90.0


def admitted_share(folder: Path) -> tuple[Figure, ...]:
    """The one figure, in percent of drafts; none for a dataset without ledger. Raises EvaluationError for a damaged one."""
    path = folder / ATTEMPTS_FILE
    if not path.is_file():
        return ()
    try:
        outcomes = [json.loads(line)["outcome"] for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise EvaluationError(
            f"{path} can't be read as a ledger ({error}): call the build again, which writes it anew"
        ) from error
    if not outcomes:
        return ()
    share = 100 * outcomes.count("admitted") / len(outcomes)
    return (Figure("admitted_share", share, "%", Better.HIGHER, len(outcomes), GOAL_PERCENT),)
