"""Rules about the text of an instruction, whatever its wish: one request in plain English, without names of the scene."""

import re
from collections.abc import Iterator
from typing import Final

from embomatrix.factory.social.rules.faults import Fault, FaultKind
from embomatrix.factory.social.rules.nouns import kinds_called
from embomatrix.factory.social.rules.vocabulary import ACTIONS
from embomatrix.world.bddl import ROOM_TYPES

MIN_LENGTH: Final = 12
MAX_LENGTH: Final = 400
"""Characters of an instruction."""
MIN_COMMON_SHARE: Final = 0.2
"""Share of the commonest English words in an instruction."""
_COMMON: Final = frozenset(
    (
        "the", "a", "an", "to", "in", "on", "of", "and", "is", "are", "it", "please", "that", "with", "for", "his",
        "her", "he", "she", "you", "so", "at", "be", "from", "all", "would", "could", "wants", "needs", "off", "into",
        "their", "they", "has", "one", "them", "i", "my", "then", "out", "up", "each", "both", "if", "not", "no",
    )
)  # fmt: skip
_MARKUP: Final = re.compile(r"[<>{}\[\]|`*\\^~=]|https?:|^\s*#|\n|\r|\t")
_INJECTION: Final = re.compile(
    r"\b(?:ignore|disregard|forget|override)\b.{0,40}\b(?:previous|above|prior|earlier|all|instructions?|rules?|prompt)\b|"
    r"\bsystem prompt\b|\bas an ai\b|\blanguage model\b|\byou are (?:now )?(?:a|an|no longer)\b|\bnew instructions?\b|"
    r"\b(?:system|assistant|user) ?:|\bjailbreak|\breward\b|\bgoal (?:is|holds)\b|\bdeveloper mode\b",
    re.IGNORECASE,
)
_RAW: Final = re.compile(
    r"\b\w+_\w+\b|\b(?:index|object|item|row|id|entry)\s+(?:number\s+)?\d+\b|#\s?\d|\b\w+\.n\.\d+|\bn°\s?\d",
    re.IGNORECASE,
)
_NUMBERED: Final = re.compile(r"\b([a-z]+) (\d+)\b", re.IGNORECASE)
_ASKING: Final = re.compile(
    r"\b(?:please|could you|can you|would you|will you|i need|i want|i'd like|wants?|needs?|would like|would love|asks?|asked|"
    r"must|should|shall|has to|have to|make sure|see to it|hopes?|wishes|expects?|let)\b"
)
_BEGINS: Final = re.compile(
    rf"(?:^|[.,;:!?] |\b(?:and|then|so|first|just|robot|now) )(?:please )?(?:{ACTIONS})\b"
)
_NAME: Final = re.compile(r"(?<![.!?:] )(?<!^)(?<![\"“‘'])\b([A-Z][a-zé]+)\b")
_SUBJECT: Final = re.compile(
    r"(?:^|[.!?:] )([A-Z][a-zé]+)(?:['’]s\b| (?:wants|wanted|needs|needed|asks|asked|would|says|hopes|likes|loves|"
    r"prefers|forgot|left|lost|found|bought|plans|expects|thinks|feels|and [A-Z]))"
)
_NO_NAMES: Final = frozenset(
    (
        "I", "TV", "She", "He", "They", "We", "It", "The", "This", "That", "There", "Everyone", "Everybody",
        "Somebody", "Someone", "Nobody", "What", "Who", "Here", "Each", "All", "One", "Both", "None", "Nothing",
        "Dinner", "Breakfast", "Lunch", "Monday", "Tuesday", "Wednesday", "Thursday", "Friday", "Saturday", "Sunday",
        "Robot", "Please", "Mum", "Mom", "Dad", "Grandma", "Grandpa", "English", "Christmas", "Could", "Can", "Would",
    )
)  # fmt: skip


def text_faults(text: str, people: frozenset[str]) -> tuple[Fault, ...]:
    """Return the broken rules of a text. ``people`` are the names of the cast; unreadable text has one fault."""
    unreadable = tuple(_unreadable(text))
    if unreadable:
        return unreadable[:1]
    return (*_not_a_request(text), *_raw_names(text), *_unknown_people(text, people))


def _unreadable(text: str) -> Iterator[Fault]:
    if not MIN_LENGTH <= len(text) <= MAX_LENGTH:
        yield Fault(
            FaultKind.NOT_TEXT,
            f"the instruction has {len(text)} characters: expected {MIN_LENGTH} to {MAX_LENGTH}",
        )
    found = _INJECTION.search(text)
    if found:
        yield Fault(FaultKind.INJECTION, f"{found.group()!r} is no part of a household request: leave it out")
    mark = _MARKUP.search(text)
    if mark:
        yield Fault(FaultKind.NOT_TEXT, f"{mark.group()!r} is markup: write plain sentences")
    letters = [letter for letter in text if letter.isalpha()]
    words = re.findall(r"[a-z']+", text.lower())
    common = sum(word in _COMMON for word in words)
    if any(ord(letter) > 0x24F for letter in letters) or common < MIN_COMMON_SHARE * max(1, len(words)):
        yield Fault(FaultKind.NOT_TEXT, "the instruction is no English sentence: write one or two")


def _not_a_request(text: str) -> Iterator[Fault]:
    lowered = text.lower()
    if not (_ASKING.search(lowered) or _BEGINS.search(lowered)):
        yield Fault(
            FaultKind.NO_REQUEST,
            "the instruction asks for nothing: begin with a verb such as put, or say who wants it",
        )


def _raw_names(text: str) -> Iterator[Fault]:
    found = _RAW.search(text)
    if found:
        yield Fault(FaultKind.RAW_NAME, f"people do not say {found.group()!r}: call the object as they do")
        return
    for match in _NUMBERED.finditer(text):
        noun = match[1].lower()
        if kinds_called(noun) and noun not in ROOM_TYPES:
            yield Fault(
                FaultKind.RAW_NAME, f"people do not say {match.group()!r}: describe which one is meant"
            )
            return


def _noun_from(text: str, match: re.Match[str]) -> str:
    """Return the capitalised word and the one after it: *Eames chair* is no person."""
    return " ".join(text[match.start(1) :].lower().split()[:2]).rstrip(".,;:!?")


def _unknown_people(text: str, people: frozenset[str]) -> Iterator[Fault]:
    parts = {part for name in people for part in name.split()}
    for match in (*_SUBJECT.finditer(text), *_NAME.finditer(text)):
        name = match[1]
        if name not in parts | _NO_NAMES and not kinds_called(_noun_from(text, match)):
            known = ", ".join(sorted(people))
            yield Fault(FaultKind.UNKNOWN_PERSON, f"nobody here is called {name}: the people are {known}")
            return
