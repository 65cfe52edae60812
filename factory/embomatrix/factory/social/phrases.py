"""Sentence templates of people and robot by speech act. The vocabulary is wider than that of the plain task writer."""

import re
from collections.abc import Mapping, Sequence
from typing import Final

from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.values import Act
from embomatrix.factory.writer.words import Voice, room_words, spoken

CLAUSES: Final[Mapping[str, tuple[str, ...]]] = {
    "ontop": (
        "put {thing} on {place}",
        "drop {thing} off on {place}",
        "set {thing} down on {place}",
        "carry {thing} across and leave it on {place}",
        "find {thing} and place it on top of {place}",
        "get {thing} onto {place}",
        "see to it that {thing} ends up on {place}",
        "move {thing} to {place}",
        "bring {thing} along and place it on {place}",
    ),
    "inside": (
        "put {thing} in {place}",
        "tuck {thing} away in {place}",
        "stow {thing} inside {place}",
        "slip {thing} into {place}",
        "clear {thing} away into {place}",
        "find {thing} and store it in {place}",
        "see to it that {thing} ends up inside {place}",
        "let {thing} disappear into {place}",
        "find a corner in {place} for {thing}",
    ),
    "open": (
        "open {thing}",
        "leave {thing} standing open",
        "pull {thing} open",
        "see to it that {thing} is open",
        "get {thing} open",
    ),
    "not open": (
        "close {thing}",
        "shut {thing} properly",
        "push {thing} shut",
        "see to it that {thing} is closed",
        "leave {thing} closed behind you",
    ),
    "toggled_on": (
        "switch {thing} on",
        "turn on {thing}",
        "leave {thing} switched on",
        "see to it that {thing} is on",
    ),
    "not toggled_on": (
        "switch {thing} off",
        "turn off {thing}",
        "leave {thing} switched off",
        "see to it that {thing} is off",
    ),
    "cooked": (
        "cook {thing} with {place}",
        "use {place} to cook {thing}",
        "get {thing} cooked with {place}",
        "cook {thing} through",
        "prepare {thing} with {place} until it is done",
    ),
    "hot": (
        "warm up {thing} with {place}",
        "heat {thing} with {place}",
        "use {place} to get {thing} hot",
        "see that {thing} is served hot",
        "give {thing} some heat with {place}",
    ),
    "frozen": (
        "freeze {thing} in {place}",
        "use {place} to freeze {thing}",
        "get {thing} frozen in {place}",
        "leave {thing} to freeze in {place}",
        "chill {thing} in {place} until it is frozen",
    ),
}
"""Phrases that request an atom. ``place`` is the host or the source."""

MANNER_CLAUSES: Final[Mapping[str, tuple[str, ...]]] = {
    "toggled_on tap": (
        "turn on the tap of {thing}",
        "let the water run in {thing}",
        "get the water in {thing} running",
        "leave the tap of {thing} running",
    ),
    "not toggled_on tap": (
        "turn off the tap of {thing}",
        "stop the water in {thing}",
        "see to it that the tap of {thing} is off",
        "leave the tap of {thing} turned off",
    ),
    "open drawers": (
        "pull out a drawer of {thing}",
        "open a drawer of {thing}",
        "leave a drawer of {thing} standing open",
        "get a drawer of {thing} open",
    ),
    "not open drawers": (
        "push the drawers of {thing} in",
        "shut the drawers of {thing} properly",
        "see to it that no drawer of {thing} is open",
        "leave the drawers of {thing} closed",
    ),
}
"""Phrases that request an atom of an object with a tap, or with drawers but no door."""

NOUNS: Final[Mapping[str, str]] = {
    "bottom_cabinet": "low cabinet",
    "bottom_cabinet_no_top": "base cabinet",
    "metal_bottom_cabinet": "low metal cabinet",
    "top_cabinet": "wall cabinet",
    "furniture_sink": "cabinet sink",
    "multi_station_furniture_sink": "long cabinet sink",
    "multi_station_tabletop_sink": "long sink",
    "multi_station_wall_mounted_sink": "long wash trough",
    "wall_mounted_sink": "wall sink",
    "drop_in_sink": "built-in sink",
    "tabletop_sink": "washbowl",
    "commercial_kitchen_sink": "kitchen sink",
    "commercial_kitchen_table": "steel worktable",
    "commercial_kitchen_shelf": "kitchen shelf",
    "wall_mounted_tv": "TV on the wall",
    "wall_mounted_loudspeaker": "loudspeaker on the wall",
    "hardback": "hardback book",
    "carpet": "rug",
    "tablefork": "fork",
    "public_trash_can": "rubbish bin",
    "trash_can": "waste bin",
    "clothes_dryer": "tumble dryer",
    "washer": "washing machine",
    "pot_plant": "potted plant",
}
"""Everyday names of categories with technical names. They are unique."""

TURNS: Final[Mapping[Act, tuple[str, ...]]] = {
    Act.NEED: (
        "I am {activity}, and {why}. Now {matter}.",
        "Robot, have you got a moment? I am {activity}, and {matter}. {Why}.",
        "Good that you are here. {Matter}, and I am {activity}: {why}.",
        "{Matter}. Could you help, while I am {activity}? {Why}.",
        "Sorry to bother you, but {matter}. I am {activity}, you see, and {why}.",
        "Listen: {matter}, and I can't see to it, I am {activity}. {Why}.",
    ),
    Act.CLARIFY: (
        "Gladly. {Question}",
        "I can do that. {Question}",
        "Of course. Just so that I get it right: {question}",
        "Let me ask first: {question}",
        "With pleasure. {Question}",
    ),
    Act.ANSWER: (
        "I would say: {clause}.",
        "The simplest would be this: {clause}.",
        "Oh, right. Please {clause}.",
        "Best to {clause}.",
        "Could you {clause}?",
    ),
    Act.REFUSE: (
        "I can't {chore}: {reason}.",
        "That is beyond me, I am afraid. To {chore}, I would need more than I have: {reason}.",
        "Not that, sorry: {reason}. So I can't {chore}.",
        "I wish I could {chore}, but {reason}.",
    ),
    Act.PROPOSE: (
        "What I can do is this: {clause}.",
        "But I could {clause}.",
        "Shall I {clause} in its place?",
        "Would it help if I {clause}?",
    ),
    Act.AMEND: (
        "No, wait. Better {clause}.",
        "On second thoughts: {clause}, please.",
        "Hm, that would be in the way. {Clause}, then.",
        "Not there, I still need the room. Rather {clause}.",
        "Actually, no: {clause}.",
    ),
    Act.ADD: (
        "And while you are at it, {clause}.",
        "One more thing: {clause}.",
        "Oh, and {clause}, would you?",
        "Then also {clause}, or I will forget.",
        "If you pass by, {clause} too.",
    ),
    Act.CONFIRM: (
        "Then I will do this: {clauses}.",
        "Understood: {clauses}.",
        "All right. I will {clauses}.",
        "Consider it done: {clauses}.",
    ),
}
"""Sentences by act. A capitalised placeholder starts with a capital letter."""

AGREEMENTS: Final = ("Yes, do that, please.", "That would help as well.", "Oh, gladly.", "Right, that too.")
"""Replies to a proposal."""

NEEDS: Final[Mapping[str, tuple[str, ...]]] = {
    "place": (
        "{thing} is not where it belongs",
        "{thing} has been lying about since yesterday",
        "I keep running into {thing}",
        "nobody has cleared away {thing}",
        "{thing} is needed elsewhere",
        "I don't know what to do with {thing}",
    ),
    "hot": ("{thing} is still cold", "nobody wants to have {thing} cold"),
    "cooked": ("{thing} is still raw", "somebody should see to {thing}"),
    "frozen": ("{thing} will not keep until tomorrow", "{thing} is too warm as it is"),
    "open": ("{thing} is shut, and I have no hand free", "nobody has thought of {thing}"),
    "not open": ("somebody left {thing} standing open", "everybody walks into {thing}, open as it is"),
    "toggled_on": ("{thing} is off", "nobody has thought of {thing}"),
    "not toggled_on": ("{thing} is running for nobody", "somebody left {thing} on"),
    "toggled_on tap": ("I need water from {thing}", "nobody has thought of {thing}"),
    "not toggled_on tap": ("the water in {thing} is running for nobody", "I hear {thing} dripping"),
    "open drawers": ("{thing} is shut, and I have no hand free", "I need something out of {thing}"),
    "not open drawers": ("everybody bumps into the drawers of {thing}", "a drawer of {thing} sticks out"),
}
"""Statements of a need, by the kind and manner of the request."""

QUESTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "place": (
        "where shall {thing} go?",
        "which place have you got in mind for {thing}?",
        "where would you like to have {thing}?",
    ),
    "thermal": ("what shall I do with {thing}?", "how would you like to have {thing}?"),
    "switch": ("shall I see to it?", "what would you like me to do about it?", "how do you want it?"),
}

INSTRUCTIONS: Final = (
    "{Who} is {activity}, and {why}: {what}.",
    "{Why}, says {who}, who is {activity}. So {what}.",
    "It is {time} and {who} is {activity}. Could you {what}?",
    "Lend a hand to {who}, who is {activity}: {what}. {Why}.",
    "{Who} asks you to {what}, for {why}.",
    "For {who}, the {job}: {what}.",
    "While {who} is {activity}, {what}.",
    "{What}. That is what {who} needs now: {why}.",
    "{Who} will be {activity} at {time}. By then, {what}.",
    "Do {who} a favour and {what}.",
    "{Who} ({age}) is {activity} and can't see to it. Please {what}.",
    "As {who} is {activity} in {room}, {what}.",
    "{Other} says you should {what}, for {who}.",
    "You promised {who} to {what}.",
    "{Who} would rather have time for {hobby}: {what}.",
    "{What}, so that {who} has one thing less to think of.",
    "On behalf of {who}, {what}: {why}.",
    "{Who} has asked twice already, because {why}. Now {what}.",
    "Next on {who}'s list: {what}.",
    "{Who} would be glad if you were to {what}.",
    "{Time}, {room}: {who} is {activity} and needs somebody to {what}.",
    "Help {who} out. {Why}, so {what}.",
    "Could you spare {who} the walk and {what}?",
    "{Who} can't leave {room} just now. {What}, please.",
)
"""Final instructions. Each names a cast member."""

CONJUNCTIONS: Final = (
    ", then ",
    ", and ",
    ", after that ",
    "; also ",
    ", and then ",
    ", and afterwards ",
    "; when that is done, ",
)

ROOM_OF_OBJECT: Final = ("in {room}", "over in {room}")
"""Phrases for the room of an object."""
ROOM_OF_ORIGIN: Final = ("from {room}",)
"""Phrases for the room that an object is taken from."""
_PAUSE: Final = re.compile(r"[,;:.?]")


def spoken_category(category: str) -> str:
    """Return the everyday name of a category."""
    return NOUNS.get(category, spoken(category))


def room_called(view: SceneView, room: str) -> str:
    """Return the everyday name of a room: ``the kitchen``, or ``bedroom 1`` if there are several."""
    return spoken(room_words(view, room)).replace("childs", "child's")


def shorten_repeated_rooms(text: str, view: SceneView) -> str:
    """Replace a room that was just named by ``there``, at most once per clause."""
    rooms = sorted((room_called(view, room.name) for room in view.scene.rooms), key=len, reverse=True)
    named = re.compile(
        rf"(?:(?P<way> from| over in| in) )?\b(?P<room>{'|'.join(map(re.escape, rooms))})\b", re.IGNORECASE
    )
    last, there = "", 0

    def shown(found: re.Match[str]) -> str:
        nonlocal last, there
        room, way = found["room"].lower(), found["way"]
        repeated, last = room == last, room
        if not repeated or not way:
            return found[0]
        said = there and not _PAUSE.search(text, there, found.start())
        there = found.end()
        return f"{way.removesuffix('in').rstrip()} there" if way == " from" or not said else ""

    return named.sub(shown, text)


def fill(template: str, **words: str) -> str:
    """Fill a template with words, capitalised where the placeholder is."""
    capitals = {name.capitalize(): capital(text) for name, text in words.items()}
    return template.format(**words, **capitals)


def joined(clauses: Sequence[str], voice: Voice) -> str:
    """Return several requests as one clause."""
    text = clauses[0]
    for clause in clauses[1:]:
        text += voice.choose(CONJUNCTIONS) + clause
    return text


def capital(text: str) -> str:
    """Capitalise the first letter only."""
    return text[:1].upper() + text[1:]
