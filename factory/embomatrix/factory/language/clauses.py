"""Clauses of requests: verbs and sentence forms of ``phrases.toml``, inflected for their subject."""

import functools
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, Final

from embomatrix.factory.language.kinds import is_held_out
from embomatrix.factory.language.nouns import gerund
from embomatrix.factory.writer.words import Voice

FILE: Final = "phrases.toml"
HELD_OUT_PHRASES: Final = 4
"""One in this many verbs, states and sentence forms belongs to the held-out split."""
_LEAVES_CHOICE: Final = re.compile(
    r"(either|exactly|only|just|any|some|something|one|an?|all but)\b|\w+ of the\b"
)
"""Words for objects that may be chosen, which have no single right place."""
_PARTICIPLES: Final[Mapping[str, str]] = {
    "put": "put", "set": "set", "lay": "laid", "leave": "left", "bring": "brought", "stand": "stood", "get": "got",
    "drop": "dropped", "keep": "kept", "take": "taken", "cut": "cut", "shut": "shut", "let": "left",
    "run": "run", "have": "had", "wet": "wetted", "freeze": "frozen", "pick": "picked", "light": "lit", "scrub": "scrubbed",
    "stop": "stopped", "free": "freed",
    "transfer": "transferred", "throw": "thrown", "slide": "slid",
}  # fmt: skip
"""Past participles that do not end in a plain ``-ed``."""
_NO_PASSIVE: Final = (
    "let",
    "have",
    "run",
    "get",
    "use",
    "keep",
    "bring",
    "wipe the",
    "scrub the",
    "free",
    "empty",
    "wash the",
    "clean the",
    "see",
    "give",
    "start",
    "power",
    "stand",
    "park",
)
"""Beginnings of imperatives without a natural passive."""


PLACED: Final = ("ontop", "inside", "inside bin", "under", "nextto")
TAP: Final = " tap"
"""Ending of the keys of sinks, whose tap is turned on and off."""
LONG_WORDS: Final = 3
"""Spaces in a noun phrase from which on a particle does not follow it."""
_HAS_PLACE: Final = re.compile(r" (?:on|in|under|with) ")
"""Prepositions in a noun phrase that tells a thing by its place."""
_WHERE: Final = re.compile(r"(?<!cook) (?:on|in) (?=the |an? |one of |[a-z' ]+ \d)")
"""Preposition before the place of a thing; that of *something to cook in* is none."""
_STOOD_ON: Final = re.compile(r"\b(?:stoves?|burners?|grills?|griddles?|tops?)\b")
"""Appliances on which food is cooked; it is cooked in others."""
_KEPT: Final = re.compile(r"(?:store|stow|pack|tuck|put \{x\} away) ")
"""Verbs for what stays in its place, as nothing does in a sink."""
_SINK: Final = re.compile(r"\bsinks?\b")
"""Place in which things are, and not inside which."""
_MOVING: Final = ("move ", "transfer ", "get ", "take ", "bring ")
"""Verbs that part a thing from its place: *move the mugs from the desk to the sink*, where *put* would heap up places."""
_PARTICLE_FIRST: Final = re.compile(r"\w+ (?:on|off|up|down|out) \{x\}")
"""Verbs that no pronoun follows: *turn it on*, not *turn on it*."""
_PARTICLE: Final = re.compile(r"\{x\} (?:up|down|off|on|open|shut|over|away|again|through)\b(?! \{y\})")


@functools.cache
def _phrases() -> Mapping[str, Any]:
    text = (resources.files("embomatrix.factory.language") / FILE).read_text(encoding="utf-8")
    return tomllib.loads(text)


@dataclass(frozen=True, slots=True)
class NounPhrase:
    """Words for objects. ``count`` is 1 for *it* and more for *them*."""

    words: str
    count: int = 1

    @property
    def it(self) -> str:
        return "it" if self.count == 1 else "them"

    @property
    def subject_pronoun(self) -> str:
        return "it" if self.count == 1 else "they"

    def agree(self, singular: str, plural: str) -> str:
        return singular if self.count == 1 else plural


@dataclass(frozen=True, slots=True)
class Speaker:
    """Speaker of a request: the first person, or somebody by name."""

    name: str = ""

    def fields(self) -> dict[str, str]:
        """Return the words for the speaker's wishes."""
        if not self.name:
            return {
                "I": "I",
                "want": "want",
                "like": "would like",
                "need": "need",
                "count": "am counting",
            }
        return {
            "I": self.name,
            "want": "wants",
            "like": "would like",
            "need": "needs",
            "count": "is counting",
        }


@dataclass(frozen=True, slots=True)
class Clause:
    """Request in terms of words. ``key`` selects its verbs; ``whence`` is the present place of the thing as a phrase."""

    key: str
    thing: NounPhrase
    place: str = ""
    whence: str = ""
    bare: bool = False
    """True if the thing's words are a pronoun: only imperatives fit."""


class PhraseBook:
    """Verbs, states and sentence forms that tasks of one split may use."""

    def __init__(self, split: str, seed: int) -> None:
        self._split = split
        self._seed = seed

    def verbs(self, key: str, *, sourced: bool = False) -> tuple[str, ...]:
        """Return imperatives for a predicate."""
        table = _phrases()[key]
        return self.of_split(key, table["sourced"] if sourced else table["verbs"])

    def states(self, key: str) -> tuple[str, ...]:
        return self.of_split(key, _phrases()[key]["states"])

    def forms(self, kind: str) -> tuple[str, ...]:
        """Return sentence forms: ``do``, ``done``, ``state``, ``belongs`` or ``moved``."""
        return self.of_split(kind, _phrases()["forms"][kind])

    def joints(self, kind: str) -> tuple[str, ...]:
        return tuple(_phrases()["joints"][kind])

    def of_split(self, key: str, options: Sequence[str]) -> tuple[str, ...]:
        """Return the options of the split: those not held out for training, and mostly held-out ones for the other."""
        held_out = [
            option for option in options[1:] if is_held_out(f"{key}:{option}", self._seed, HELD_OUT_PHRASES)
        ]
        if self._split == "heldout":
            return tuple(options) if not held_out else (*options, *held_out, *held_out)
        return tuple(option for option in options if option not in held_out)


def discourse_forms(key: str) -> int:
    """Return the number of different sentences with which one thing can be requested under this key."""
    table, forms = _phrases()[key], _phrases()["forms"]
    passive = [verb for verb in table["verbs"] if _passive(verb) is not None]
    placed = key in PLACED
    return (
        len(forms["do"]) * len(table["verbs"])
        + len(forms["done"]) * len(passive)
        + len(forms["state"]) * len(table["states"])
        + (len(forms["belongs"]) + len(forms["moved"])) * len(table["states"]) * placed
    )


def sentence_of(clause: Clause, book: PhraseBook, voice: Voice, speaker: Speaker) -> str:
    """Return the clause as a sentence of its own."""
    placed = clause.key in PLACED
    leaves_choice = _LEAVES_CHOICE.match(clause.thing.words) is not None
    told_by_place = _HAS_PLACE.search(clause.thing.words) is not None
    kinds = ["do", "do", "do"]
    if not clause.bare and not clause.key.endswith(TAP):
        # *The book on the desk should be on the shelf* sounds as if it were on both.
        has_state = not _is_sourced(clause) and not (placed and told_by_place)
        kinds += ["done", "state", "state"] if has_state else ["done"]
        # *Either the juice or the soda belongs on the table* tells where things are kept, and asks for nothing.
        kinds += ["belongs"] * (placed and not leaves_choice and not told_by_place)
        one_by_one = clause.thing.words.startswith(("each ", "every "))
        kinds += ["moved", "moved"] * (
            placed and bool(clause.whence) and not (one_by_one or told_by_place or leaves_choice)
        )
    if clause.thing.words.startswith("any ") or clause.place.startswith("each "):
        # *Any book must be on the table* could mean every book, *a cup is on each saucer* one cup.
        kinds = ["do"]
    kind = voice.choose(kinds)
    fields = _fields(clause, speaker)
    passives = [p for v in _verbs(clause, book) if (p := _passive(v)) is not None] if kind == "done" else []
    if kind == "do" or (kind == "done" and not passives):
        verb = _verb(clause, book, voice)
        return _written(
            voice.choose(book.forms("do")), {**fields, **_active(verb, _parted(clause, verb, fields))}
        )
    if kind == "done":
        forms = book.forms("done")
        if told_by_place:
            # *I want the meat on the counter cooked* could mean cooked on the counter.
            forms = tuple(form for form in forms if "{x} {done}" not in form) or forms
        return _written(voice.choose(forms), {**fields, "done": _filled(voice.choose(passives), fields)})
    states = book.states(clause.key)
    if _SINK.search(clause.place):
        states = tuple(each for each in states if "inside" not in each) or states
    state = _filled(voice.choose(states), fields)
    forms = book.forms(kind)
    if told_by_place:
        # *I want the milk in the fridge on the table* misleads; a verb must part thing and place.
        forms = tuple(form for form in forms if "{x} {state}" not in form) or forms
    if clause.thing.words.startswith(("all ", "both ")):
        # *All the drinks can't stay* could mean that some can.
        forms = tuple(form for form in forms if "can't" not in form) or forms
    it = {**fields, "x": clause.thing.it}
    do_it = _filled(_verb(clause, book, voice), it)
    return _written(voice.choose(forms), {**fields, "state": state, "do_it": do_it})


def imperative_of(clause: Clause, book: PhraseBook, voice: Voice) -> str:
    """Return the clause as an imperative without a full stop, for lists and dialogues."""
    verb = _verb(clause, book, voice)
    return _filled(verb, _parted(clause, verb, _fields(clause, Speaker())))


def passive_of(clause: Clause, book: PhraseBook, voice: Voice) -> str:
    """Return ``the mug will be put in the sink`` without a full stop."""
    fields = _fields(clause, Speaker())
    passives = [p for v in _verbs(clause, book) if (p := _passive(v)) is not None]
    if not passives:
        return f"I will {_filled(_verb(clause, book, voice), fields)}"
    return f"{clause.thing.words} will be {_filled(voice.choose(passives), fields)}"


def _is_sourced(clause: Clause) -> bool:
    """True if the words name the appliance that brings a thermal state about."""
    return bool(clause.place) and clause.key in ("cooked", "hot", "frozen")


def _verbs(clause: Clause, book: PhraseBook) -> tuple[str, ...]:
    """Return suitable imperatives. A particle does not follow a long noun phrase: *turn on the lamp on the desk*."""
    verbs = book.verbs(clause.key, sourced=_is_sourced(clause))
    if clause.thing.count == 1:
        verbs = tuple(verb for verb in verbs if not verb.startswith("arrange")) or verbs
    if clause.place.startswith("the floor of "):
        verbs = tuple(verb for verb in verbs if "on top" not in verb) or verbs
    if _SINK.search(clause.place):
        verbs = tuple(verb for verb in verbs if not _KEPT.match(verb) and "inside" not in verb) or verbs
    if clause.key in PLACED and _WHERE.search(clause.thing.words):
        verbs = tuple(verb for verb in verbs if verb.startswith(_MOVING)) or verbs
    if clause.bare:
        return tuple(verb for verb in verbs if not _PARTICLE_FIRST.match(verb)) or verbs
    if clause.thing.words.count(" ") < LONG_WORDS:
        return verbs
    return tuple(verb for verb in verbs if not _PARTICLE.search(verb)) or verbs


def _verb(clause: Clause, book: PhraseBook, voice: Voice) -> str:
    return voice.choose(_verbs(clause, book))


def _parted(clause: Clause, verb: str, fields: Mapping[str, str]) -> Mapping[str, str]:
    """Return the fields with *from* before the place of the thing, if the verb moves it and it is a single phrase."""
    words = clause.thing.words
    if clause.key not in PLACED or not verb.startswith(_MOVING) or re.search(r" (?:and|or) ", words):
        return fields
    return {**fields, "x": _WHERE.sub(" from ", words, count=1)}


def _fields(clause: Clause, speaker: Speaker) -> dict[str, str]:
    thing = clause.thing
    return {
        **speaker.fields(),
        "x": thing.words,
        "X": thing.words,
        "y": clause.place,
        "at_y": f"{'on' if _STOOD_ON.search(clause.place) else 'in'} {clause.place}",
        "it": thing.it,
        "they": thing.subject_pronoun,
        "They": capitalised(thing.subject_pronoun),
        "whence": clause.whence,
        "is": thing.agree("is", "are"),
        "has": thing.agree("has", "have"),
        "needs": thing.agree("needs", "need"),
        "belongs": thing.agree("belongs", "belong"),
        "goes": thing.agree("goes", "go"),
    }


def _active(verb: str, fields: Mapping[str, str]) -> dict[str, str]:
    first, _, rest = verb.partition(" ")
    doing = re.sub(r"\band (\w+)", lambda match: f"and {gerund(match[1])}", f"{gerund(first)} {rest}")
    return {"do": _filled(verb, fields), "doing": _filled(doing, fields)}


def _passive(verb: str) -> str | None:
    """Return the participle with its complements, such as *put in {y}*; None without a natural passive."""
    if (
        verb.startswith(_NO_PASSIVE)
        or " and " in verb
        or " until " in verb
        or "{x}" not in verb
        or "the tap" in verb
    ):
        return None
    first, _, rest = verb.partition(" ")
    participle = _PARTICIPLES.get(first) or (f"{first}d" if first.endswith("e") else f"{first}ed")
    return " ".join(f"{participle} {rest.replace('{x}', '')}".split())


def _filled(template: str, fields: Mapping[str, str]) -> str:
    text = template
    for name, words in fields.items():
        text = text.replace(f"{{{name}}}", words)
    return text


def _written(form: str, fields: Mapping[str, str]) -> str:
    return capitalised(_filled(form, fields)).replace("on top of the floor", "on the floor")


def capitalised(text: str) -> str:
    """Return the text with a capital first letter."""
    return f"{text[:1].upper()}{text[1:]}"
