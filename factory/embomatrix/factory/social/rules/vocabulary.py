"""Words that demand a state: predicates with their polarity, read from the tokens of an instruction."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from embomatrix.factory.social.wish import WishPredicate

_GAP: Final = r"(?:(?!(?:on|off|and|then|out)\b)[\w'’-]+ ){1,6}?"
_NO_HOST: Final = r"(?! (?:the|a|an|top|my|his|her|our|their|your|its?|each|every|one|any|all|both)\b)"
_SWITCH: Final = r"(?:switch|turn|power|flick)(?:ed|ing|es|s)?"
_LEFT: Final = r"(?:is|are|be|being|stays?|left|leaves?|keeps?|kept|comes?|go(?:es)?)"

StatedDemand = tuple[WishPredicate, bool]
"""Predicate, and whether it shall hold."""

DEMANDS: Final[Mapping[StatedDemand, str]] = {
    (WishPredicate.OPEN, True): r"open(?:ed|ing|s)?|ajar",
    (WishPredicate.OPEN, False): r"clos(?:e|ed|es|ing)|shut(?:s|ting)?",
    (WishPredicate.TOGGLED_ON, True): (
        rf"{_SWITCH} on|{_SWITCH} {_GAP}on{_NO_HOST}|{_LEFT} (?:\w+ ){{0,2}}?(?:running|on{_NO_HOST})|"
        r"start(?:ed|ing|s)? (?:up )?(?:the|a|my|his|her|our|their)|let \w+ \w+ run"
    ),
    (WishPredicate.TOGGLED_ON, False): (
        rf"{_SWITCH} off|{_SWITCH} {_GAP}off|{_LEFT} (?:\w+ ){{0,2}}?off|stop (?:the|a|my|his|her|our|their)"
    ),
    (WishPredicate.COOKED, True): (
        r"(?:cook|bak|roast|fry|fri|grill|boil|toast|simmer|sear)(?:e|ed|es|ing|s|y)?(?: through)?"
    ),
    (WishPredicate.HOT, True): r"(?:re)?heat(?:ed|ing|s)?(?: up)?|warm(?:ed|ing|s)?(?: up)?|hot",
    (WishPredicate.FROZEN, True): r"freez(?:e|es|ing)|froze|frozen",
    (WishPredicate.STAINED, False): (
        r"clean(?:ed|ing|s)?(?: up)?|wash(?:ed|es|ing)?(?: up)?|wip(?:e|ed|es|ing)|dust(?:ed|ing)?|scrub(?:bed|bing)?|"
        r"rins(?:e|ed|es|ing)|polish(?:ed|ing)?|spotless|(?:free|rid) of (?:the )?(?:dust|stains?)|"
        r"(?:no|without|not|longer) (?:any )?(?:dust|dusty|stains?|stained)"
    ),
    (WishPredicate.SOAKED, True): r"soak(?:ed|ing|s)?|wet(?:ted|ting)?|moisten(?:ed|ing)?|damp(?:en|ened)?",
    (WishPredicate.SLICED, True): (
        r"slic(?:e|ed|es|ing)|cut(?:s|ting)?|chop(?:ped|ping|s)?|dic(?:e|ed|ing)|halv(?:e|ed|ing)|carv(?:e|ed|ing)"
    ),
}
"""Words that demand a state. Dust and stains share their words, since people clean both away."""

_DEMANDING_PLACE: Final = (
    r"put|place|bring|move|carry|take|store|stow|stack|lay|drop|return|"
    r"tidy|fetch|tuck|load|transfer|pack|collect|throw"
)
"""Verbs that demand a place."""
ACTIONS: Final = (
    rf"{_DEMANDING_PLACE}|slip|clear|remove|set|hang|get|pick|open|close|shut|switch|turn|cook|bake|roast|fry|grill|"
    r"boil|toast|heat|warm|reheat|freeze|clean|wash|wipe|dust|scrub|rinse|polish|soak|wet|moisten|slice|cut|chop|dice|"
    r"halve|make|see|leave|keep|help|find|use|give|let|prepare|start|stop|ensure|check|chill|power"
)
"""Verbs that an instruction may begin with."""
OTHER_WORK: Final = (
    r"call|phone|ring|pour|vacuum|hoover|mop|iron|sew|paint|write|read|sing|play|feed|repair|fix|buy|order|shop|drive|"
    r"walk|dance|talk|tell|say|mix|stir|fold|assemble|fill|water|assist|attach|hug|kill|burn|break|smash"
)
"""Verbs of work that the robot does not do."""
NEGATION: Final = (
    r"(?:don['’]t|do not|not|never|no|none|without|nothing|neither|nor|avoid|"
    r"rather than|won['’]t|mustn['’]t|can['’]t)"
)
"""Words that turn a demand into its contrary."""
_NARRATED: Final = re.compile(
    r"\b(?:finished|done|stopped|starts?|starting|begins?|busy|is|are|was|were|been|loves?|likes?|before|after|while|from|of) $"
)
_DETERMINER: Final = r"\b(?:the|a|an|those|these|all|each|every|my|his|her|our|their|any|\w+['’]s)"
_ASSURED: Final = re.compile(r"\b(?:make sure|see to it|see that|ensure|check)\b")
_DEFAULT_STATES: Final = frozenset({"clean", "cleaned", "closed", "shut", "wet"})
"""Adjectives that describe an object as it usually is. They demand nothing before a noun."""


@dataclass(frozen=True, slots=True)
class Stated:
    """Demands that a text states, each with the words that state it."""

    demands: Mapping[StatedDemand, str]
    placing: str
    """Words that demand a place; "" for none."""
    other_work: str
    """Words that demand work that the robot does not do; "" for none."""


def stated_in(text: str, described: frozenset[WishPredicate]) -> Stated:
    """Return the demands of a text. ``described`` are states of objects at the start, which adjectives may name."""
    found: dict[StatedDemand, str] = {}
    for (predicate, holds), words in DEMANDS.items():
        for match in re.finditer(rf"\b(?:{words})\b", text):
            if _is_narrated(text, match) or _is_adjective(text, match, predicate in described):
                continue
            polarity = holds is not _is_negated(text, match.start()) or "no " in match.group()
            found.setdefault((predicate, polarity), match.group())
    return Stated(found, _first(rf"\b(?:{_DEMANDING_PLACE})\b", text), _other_work(text))


def _is_adjective(text: str, match: re.Match[str], is_described: bool) -> bool:
    """True for a description of an object, as in *the open drawer*, that is its usual or its initial state."""
    if not (is_described or match.group() in _DEFAULT_STATES):
        return False
    told = text[: match.start()]
    if not is_described and _ASSURED.search(re.split(r"[.;!?]", told)[-1]):
        return re.search(rf"{_DETERMINER} $", told) is not None  # *make sure that it is closed* demands it
    return re.search(rf"(?:{_DETERMINER}|is|are|still) $", told) is not None


def _is_narrated(text: str, match: re.Match[str]) -> bool:
    """True for something that people do or did themselves, as in *has finished baking*."""
    return match.group().endswith("ing") and _NARRATED.search(text[: match.start()]) is not None


def _is_negated(text: str, at: int) -> bool:
    clause = re.split(r"[.,;:!?]|\b(?:and|but|then)\b", text[:at])[-1]
    return re.search(rf"\b{NEGATION}\b(?: [\w'’-]+){{0,6}} ?$", clause) is not None


def _first(pattern: str, text: str) -> str:
    return next(
        (match.group() for match in re.finditer(pattern, text) if not _is_negated(text, match.start())), ""
    )


def _other_work(text: str) -> str:
    begins = r"(?:^|[.,;:!?] |\b(?:and|then|please|also|you to|could you|can you|would you|will you) )"
    match = re.search(rf"{begins}(?:then |also |please )?({OTHER_WORK})\b", text)
    return match[1] if match else ""
