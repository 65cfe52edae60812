"""What a person can mend: each message names the thing and the remedy."""

from __future__ import annotations


class TrainerError(Exception):
    """One sentence for a person; commands show it and end with status 2."""
