"""Parser of BDDL problems in the dialects of BEHAVIOR-1K and of the paper's factory.

``?`` before an object is optional; text is lower-cased except for the problem's name; ``;`` starts a comment. A *wildcard*
(``sink.n.01_*``) stands for the further objects of its type in the room that ``:init`` names; it is expanded when the rooms
are known. Goals over scenes may name a substance by its synset without declaring it.

The parser accepts three habits of published problems: a stray backslash at a line's end, an object declared again with the
same type, and a room instance (``closet_0``) as an argument. Every error names the line and the column, from 1.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final, NoReturn

from embomatrix.world.evaluate import GoalError, atoms_of, check_size, render
from embomatrix.world.goal import And, Atom, Formula, Imply, Not, Or, Quantified, Quantifier
from embomatrix.world.state import THERMAL, SubstanceRelation
from embomatrix.world.substances import is_substance

_UNARY: Final = (
    "cooked", "frozen", "open", "folded", "unfolded", "toggled_on", "hot", "on_fire", "future", "real", "broken",
    "dusty", "stained", "soaked", "sliced",
)  # fmt: skip
_BINARY: Final = (
    "saturated", "covered", "filled", "contains", "ontop", "nextto", "under", "touching", "inside", "overlaid",
    "attached", "draped", "insource", "inroom",
)  # fmt: skip
ARITIES: Final[Mapping[str, tuple[int, ...]]] = {
    **dict.fromkeys(_UNARY, (1,)),
    **dict.fromkeys(_BINARY, (2,)),
    **dict.fromkeys(THERMAL, (1, 2)),
    "grasped": (1, 2),  # the paper's tasks omit the agent
}
"""Predicates of both dialects with the argument counts that each accepts.

The second argument of ``cooked``, ``frozen`` and ``hot`` is our own extension: the source that brought the state about.
"""
ROOM_TYPES: Final = frozenset(
    (
        "bar", "bathroom", "bedroom", "biology_lab", "break_room", "chemistry_lab", "childs_room",
        "classroom", "closet", "computer_lab", "conference_hall", "copy_room", "corridor", "dining_room",
        "empty_room", "entryway", "exercise_room", "garage", "garden", "grocery_store", "gym", "hammam",
        "infirmary", "kitchen", "living_room", "lobby", "locker_room", "meeting_room", "pantry_room",
        "phone_room", "playroom", "private_office", "sauna", "shared_office", "spa", "staircase",
        "storage_room", "television_room", "utility_room",
    )
)  # fmt: skip
"""Room types of the 51 base scenes; a room instance is a type and a number: ``kitchen_0``."""
WILDCARD: Final = "_*"
"""Suffix of a wildcard's name."""
MAX_DEPTH: Final = 64
"""Nesting limit: no published goal comes near it."""


class BddlError(ValueError):
    """Unreadable BDDL text. ``line`` and ``column`` count from 1."""

    def __init__(self, message: str, line: int, column: int) -> None:
        super().__init__(f"line {line}, column {column}: {message}")
        self.line = line
        self.column = column


@dataclass(frozen=True, slots=True)
class InitLiteral:
    """Atom of ``:init``; ``positive`` is False under ``not``."""

    atom: Atom
    positive: bool = True


@dataclass(frozen=True, slots=True)
class BddlProblem:
    """BDDL problem. ``objects`` maps the name of an object to its type, in the order of the text."""

    name: str
    objects: Mapping[str, str]
    init: tuple[InitLiteral, ...]
    goal: Formula

    @property
    def types(self) -> Mapping[str, tuple[str, ...]]:
        """Object names by type, without wildcards: the range of quantifiers."""
        members: dict[str, list[str]] = {type_name: [] for type_name in self.objects.values()}
        for name, type_name in self.objects.items():
            if not name.endswith(WILDCARD):
                members[type_name].append(name)
        return {type_name: tuple(names) for type_name, names in members.items()}

    @property
    def wildcards(self) -> Mapping[str, str]:
        """Wildcards of the problem with the rooms that ``:init`` gives them."""
        return {
            item.atom.args[0]: item.atom.args[1] for item in self.init if item.atom.args[0].endswith(WILDCARD)
        }

    def initial_pairs(self, *relations: str) -> list[tuple[str, str]]:
        """Arguments of the true atoms of ``:init`` with one of these predicates of two arguments."""
        true = [item.atom for item in self.init if item.positive]
        return [(atom.args[0], atom.args[1]) for atom in true if atom.predicate in relations]

    def spelt_out(self, members: Mapping[str, tuple[str, ...]]) -> BddlProblem:
        """Replace each wildcard by objects of these names, which may be none."""
        objects: dict[str, str] = {}
        for name, type_name in self.objects.items():
            objects |= dict.fromkeys(members.get(name, (name,)), type_name)
        init = [
            replace(item, atom=replace(item.atom, args=(name, *item.atom.args[1:])))
            for item in self.init
            for name in members.get(item.atom.args[0], item.atom.args[:1])
        ]
        return replace(self, objects=objects, init=tuple(init))


@dataclass(frozen=True, slots=True)
class _Node:
    """Word, or a list if ``word`` is empty."""

    word: str
    items: tuple[_Node, ...]
    line: int
    column: int

    def fail(self, message: str) -> NoReturn:
        raise BddlError(message, self.line, self.column)

    @property
    def head(self) -> str:
        """First word of a list in lower case, or the word itself."""
        return self.items[0].word.lower() if self.items else self.word.lower()


def parse_problem(text: str) -> BddlProblem:
    """Read a whole ``(define (problem ...) ...)``. Raises BddlError."""
    root = _read(text)
    if root.head != "define":
        root.fail(f"found {root.head or '()'!r}: expected '(define (problem NAME) ...)'")
    sections: dict[str, _Node] = {}
    for node in root.items[1:]:
        head = node.head
        if head not in {"problem", ":domain", ":requirements", ":objects", ":init", ":goal"} or node.word:
            node.fail(
                f"unknown section {head!r}: expected (problem ...), (:domain ...), (:objects ...), "
                "(:init ...) or (:goal ...)"
            )
        if head in sections:
            node.fail(f"section {head!r} stands here twice: keep one")
        sections[head] = node
    for needed in (":objects", ":init", ":goal"):
        if needed not in sections:
            root.fail(f"section ({needed} ...) is missing: add it to the problem")
    name_node = sections.get("problem", root)
    if name_node is root or len(name_node.items) != 2 or not name_node.items[1].word:
        name_node.fail("expected (problem NAME), one word")
    objects = _parse_objects(sections[":objects"])
    reader = _Reader(objects, frozenset(objects.values()))
    problem = BddlProblem(
        name=name_node.items[1].word,
        objects=objects,
        init=tuple(reader.literal(node) for node in sections[":init"].items[1:]),
        goal=reader.goal(sections[":goal"]),
    )
    try:
        check_size(problem.goal, problem.types)
    except GoalError as error:
        sections[":goal"].fail(str(error))
    return problem


def render_problem(problem: BddlProblem) -> str:
    """Return BDDL text that `parse_problem` reads as an equal problem."""
    grouped: dict[str, list[str]] = {}
    for name, type_name in problem.objects.items():
        grouped.setdefault(type_name, []).append(name)
    objects = "\n".join(f"        {' '.join(names)} - {type_name}" for type_name, names in grouped.items())
    init = "\n".join(
        f"        {render(item.atom if item.positive else Not(item.atom))}" for item in problem.init
    )
    return (
        f"(define (problem {problem.name})\n    (:domain omnigibson)\n    (:objects\n{objects}\n    )\n"
        f"    (:init\n{init}\n    )\n    (:goal\n        {render(problem.goal)}\n    )\n)\n"
    )


def parse_formula(text: str, objects: Mapping[str, str]) -> Formula:
    """Read one formula over ``objects`` (name to type). Raises BddlError."""
    return _Reader(objects, frozenset(objects.values())).formula(_read(text), {})


def is_room_instance(name: str) -> bool:
    """True for the name of one room of a scene, ``kitchen_0``; False for a bare room type."""
    stem, _, number = name.rpartition("_")
    return number.isdigit() and stem in ROOM_TYPES


def _tokens(text: str) -> Iterator[tuple[str, int, int]]:
    for line, content in enumerate(text.splitlines(), start=1):
        for match in re.finditer(r"[()]|[^\s()\\]+", content.split(";", 1)[0]):
            yield match.group(), line, match.start() + 1


def _read(text: str) -> _Node:
    """Parse the single expression of the text. A section nested too deep shows the place of a missing parenthesis."""
    open_lists: list[tuple[list[_Node], int, int]] = []
    root: _Node | None = None
    for token, line, column in _tokens(text):
        if root is not None:
            raise BddlError(f"found {token!r} after the last closing parenthesis: remove it", line, column)
        if token == "(":
            if len(open_lists) >= MAX_DEPTH:
                raise BddlError(f"nested deeper than {MAX_DEPTH} parentheses", line, column)
            open_lists.append(([], line, column))
            continue
        if not open_lists:
            raise BddlError(f"the text begins with {token!r}: expected '('", line, column)
        if token == ")":
            items, start_line, start_column = open_lists.pop()
            node = _Node("", tuple(items), start_line, start_column)
        else:
            if token.startswith(":") and not open_lists[-1][0] and len(open_lists) > 2:
                _, at_line, at_column = open_lists[-2]
                raise BddlError(
                    f"section {token!r} stands inside the list opened at line {at_line}, column {at_column}: "
                    "a closing parenthesis is missing before it",
                    line,
                    column,
                )
            node = _Node(token, (), line, column)
        if open_lists:
            open_lists[-1][0].append(node)
        else:
            root = node
    if open_lists:
        _, line, column = open_lists[-1]
        raise BddlError("the parenthesis opened here is never closed: add ')'", line, column)
    if root is None:
        raise BddlError("the text is empty: expected '(define (problem NAME) ...)'", 1, 1)
    return root


def _parse_objects(section: _Node) -> dict[str, str]:
    objects: dict[str, str] = {}
    pending: list[_Node] = []
    items = iter(section.items[1:])
    for node in items:
        if not node.word:
            node.fail("found a list in :objects: expected object names and '- TYPE'")
        if node.word != "-":
            pending.append(node)
            continue
        type_node = next(items, None)
        if type_node is None or not type_node.word or not pending:
            node.fail("expected 'NAME ... - TYPE' around this hyphen")
        for name_node in pending:
            name = name_node.word.lower()
            type_name = type_node.word.lower()
            if objects.setdefault(name, type_name) != type_name:
                name_node.fail(
                    f"object {name!r} is declared as {objects[name]!r} and as {type_name!r}: keep one"
                )
        pending = []
    if pending:
        pending[0].fail(f"object {pending[0].word!r} has no type: add '- TYPE' after it")
    return objects


@dataclass(frozen=True, slots=True)
class _Reader:
    """Formulas over declared objects of these types. ``scope`` maps a bound variable to its type."""

    objects: Mapping[str, str]
    types: frozenset[str]

    def literal(self, node: _Node) -> InitLiteral:
        if node.head == "not" and not node.word:
            self._expect(node, 1)
            return InitLiteral(self._atom(node.items[1], {}), positive=False)
        return InitLiteral(self._atom(node, {}))

    def goal(self, section: _Node) -> Formula:
        parts = tuple(self.formula(node, {}) for node in section.items[1:])
        for atom in (atom for part in parts for atom in atoms_of(part)):
            if any(arg.endswith(WILDCARD) for arg in atom.args):
                section.fail(f"the goal names a wildcard in {render(atom)}: range over its type instead")
        if not parts:
            section.fail("the goal is empty: expected one formula")
        return parts[0] if len(parts) == 1 else And(parts)

    def formula(self, node: _Node, scope: Mapping[str, str]) -> Formula:
        rest = node.items[1:]
        match "" if node.word else node.head:
            case "and":
                return And(tuple(self.formula(item, scope) for item in rest))
            case "or":
                return Or(tuple(self.formula(item, scope) for item in rest))
            case "not":
                self._expect(node, 1)
                return Not(self.formula(rest[0], scope))
            case "imply":
                self._expect(node, 2)
                return Imply(self.formula(rest[0], scope), self.formula(rest[1], scope))
            case word if word in set(Quantifier):
                return self._quantified(node, Quantifier(word), scope)
            case _:
                return self._atom(node, scope)

    def _quantified(self, node: _Node, quantifier: Quantifier, scope: Mapping[str, str]) -> Quantified:
        counted = quantifier in {Quantifier.FORN, Quantifier.FORNPAIRS}
        paired = quantifier in {Quantifier.FORPAIRS, Quantifier.FORNPAIRS}
        self._expect(node, 2 + counted + paired)
        rest = node.items[1:]
        count = _count(rest[0]) if counted else None
        binders = tuple(self._binder(item) for item in rest[int(counted) : -1])
        return Quantified(quantifier, binders, self.formula(rest[-1], {**scope, **dict(binders)}), count)

    def _binder(self, node: _Node) -> tuple[str, str]:
        words = [item.word.lower() for item in node.items]
        if len(words) != 3 or words[1] != "-" or not words[0].startswith("?") or not words[2]:
            node.fail("expected a variable and its type: (?NAME - TYPE)")
        if words[2] not in self.types:
            known = ", ".join(sorted(self.types)) or "none"
            node.items[2].fail(f"unknown type {words[2]!r}: the types in :objects are {known}")
        return words[0], words[2]

    def _atom(self, node: _Node, scope: Mapping[str, str]) -> Atom:
        if node.word or not node.items or not node.items[0].word:
            node.fail(f"found {node.word or 'a list'!r}: expected (PREDICATE ARGUMENT ...)")
        predicate = node.head
        if predicate not in ARITIES:
            node.fail(f"unknown predicate {predicate!r}: expected one of {', '.join(sorted(ARITIES))}")
        args = node.items[1:]
        if len(args) not in ARITIES[predicate]:
            expected = " or ".join(map(str, ARITIES[predicate]))
            node.fail(f"the number of arguments of {predicate!r} is {len(args)}: expected {expected}")
        return Atom(
            predicate, tuple(self._name(arg, scope, predicate, index) for index, arg in enumerate(args))
        )

    def _name(self, node: _Node, scope: Mapping[str, str], predicate: str, index: int) -> str:
        if not node.word:
            node.fail("found a list: expected a name")
        word = node.word.lower()
        bare = word.removeprefix("?")
        for name in (word, f"?{bare}"):  # both dialects omit the mark now and then
            if name in scope:
                return name
        if bare.endswith(WILDCARD) and predicate != "inroom":
            node.fail(f"the wildcard {bare!r} can only be said to be in a room: range over its type instead")
        free = predicate == "inroom" and index == 1
        of_substance = index == 1 and predicate in set(SubstanceRelation) and is_substance(bare)
        if not (free or of_substance or bare in self.objects or is_room_instance(bare)):
            node.fail(f"object {bare!r} is not declared: add it to :objects, or correct its name")
        return bare

    def _expect(self, node: _Node, count: int) -> None:
        found = len(node.items) - 1
        if found != count:
            node.fail(f"the number of parts of {node.head!r} is {found}: expected {count}")


def _count(node: _Node) -> int:
    word = node.items[0].word if len(node.items) == 1 else node.word
    if not word.isascii() or not word.isdigit():
        node.fail("expected a whole number: (N)")
    return int(word)
