"""Faults of a written request: each rule has a name, so that tests and figures can tell them apart."""

from dataclasses import dataclass
from enum import StrEnum


class FaultKind(StrEnum):
    """Rules that a written request can break. The first group is about the wish, the second about its words."""

    UNKNOWN_KIND = "unknown_kind"
    UNKNOWN_ROOM = "unknown_room"
    TOO_MANY = "too_many"
    NOT_PORTABLE = "not_portable"
    NO_HOST = "no_host"
    IMPOSSIBLE_STATE = "impossible_state"
    HOLDS_AT_START = "holds_at_start"
    CONTRADICTION = "contradiction"

    NOT_TEXT = "not_text"
    INJECTION = "injection"
    NO_REQUEST = "no_request"
    RAW_NAME = "raw_name"
    UNKNOWN_PERSON = "unknown_person"
    UNMENTIONED = "unmentioned"
    UNASKED_OBJECT = "unasked_object"
    UNSTATED = "unstated"
    UNSCORED = "unscored"
    WRONG_RELATION = "wrong_relation"
    WRONG_COUNT = "wrong_count"
    WRONG_ROOM = "wrong_room"
    AMBIGUOUS = "ambiguous"

    OTHER_DEMANDS = "other_demands"  # the validation agent reads other demands out of the words


@dataclass(frozen=True, slots=True)
class Fault:
    """Broken rule, with a sentence for the writer that names the remedy."""

    kind: FaultKind
    sentence: str

    def __str__(self) -> str:
        return self.sentence
