"""Alternative ways to make a goal true: conjunctions of ground literals, those that change least first."""

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from embomatrix.world.evaluate import Types, expand, instance, instances, pair_sides
from embomatrix.world.goal import And, Atom, Facts, Formula, Not, Or, Quantified, Quantifier
from embomatrix.world.state import Relation

WIDTH: Final = 12
"""Alternatives kept for each part of a goal."""
CONTACTS: Final = frozenset({Relation.ONTOP, Relation.INSIDE, Relation.TOUCHING})
"""Relations to a surface that an object may get into when it is left there."""


@dataclass(frozen=True, slots=True)
class GroundLiteral:
    """A ground atom that must hold, or must not hold."""

    atom: Atom
    positive: bool

    def holds(self, facts: Facts) -> bool:
        """True if the literal holds now."""
        return facts.holds(self.atom.predicate, self.atom.args) == self.positive


Choice = tuple[GroundLiteral, ...]
"""Conjunction of literals that is sufficient for a goal."""


def may_lie_on(choice: Choice, name: str, surface: str, room: str) -> bool:
    """True if leaving an object on a surface in this room makes no literal of the choice false."""
    for item in choice:
        predicate, args = item.atom.predicate, item.atom.args
        if args[0] != name:
            continue
        if predicate == Relation.INROOM and (args[1] == room) is not item.positive:
            return False
        if predicate in CONTACTS and not item.positive and args[1] == surface:
            return False
    return True


def belongs_at(choice: Choice, name: str, target: str) -> bool:
    """True if a literal of the choice requires some relation of the object to the target."""
    return any(item.positive and item.atom.args == (name, target) for item in choice)


def choices(
    goal: Formula,
    types: Types,
    facts: Facts,
    preference: Callable[[str], int] = lambda name: 0,
    impossible: Callable[[GroundLiteral], bool] = lambda literal: False,
) -> tuple[Choice, ...]:
    """Return up to ``WIDTH`` choices, ordered by the number of their literals that do not hold yet.

    Ties go to choices with preferred objects. Choices with an impossible literal come last, and contradictory ones are left
    out. Each choice is sufficient for the goal; the list need not be complete.
    """
    return tuple(_Alternatives(types, facts, preference, impossible).of(goal, positive=True))


@dataclass(slots=True)
class _Alternatives:
    types: Types
    facts: Facts
    preference: Callable[[str], int]
    impossible: Callable[[GroundLiteral], bool]
    judged: dict[GroundLiteral, tuple[bool, bool]] = field(default_factory=dict)

    def of(self, formula: Formula, *, positive: bool) -> list[Choice]:
        match expand(formula, self.types):
            case Atom() as atom:
                return [(GroundLiteral(atom, positive),)]
            case Not(body):
                return self.of(body, positive=not positive)
            case And(parts):
                return self._joined(parts, positive=positive, every=positive)
            case Or(parts):
                return self._joined(parts, positive=positive, every=not positive)
            case Quantified(Quantifier.FORN, count=int(count)) as counted:
                return self._exactly(count, instances(counted, self.types), positive=positive)
            case Quantified() as pairs:
                return self._paired(pairs) if positive else self._unpaired(pairs)

    def _joined(self, parts: Iterable[Formula], *, positive: bool, every: bool) -> list[Choice]:
        """Return choices for all of the parts if ``every``, else for any one of them."""
        each = [self.of(part, positive=positive) for part in parts]
        if not every:
            return self._best(itertools.chain.from_iterable(each))
        found: list[Choice] = [()]
        for options in each:
            found = self._best(_merge(left, right) for left in found for right in options)
        return found

    def _exactly(self, count: int, parts: Sequence[Formula], *, positive: bool) -> list[Choice]:
        """Return choices with exactly ``count`` true parts; for the negation, with one more or one fewer."""
        counts = [count] if positive else [n for n in (count + 1, count - 1) if 0 <= n <= len(parts)]
        ranked = sorted(range(len(parts)), key=lambda index: self._cost_of(parts[index]))
        found: list[Choice] = []
        for number in counts:
            # The cheapest parts come first, so the first subsets are those that change least.
            for chosen in itertools.islice(itertools.combinations(ranked, number), WIDTH):
                wanted = [parts[i] if i in chosen else Not(parts[i]) for i in range(len(parts))]
                found += self._joined(wanted, positive=True, every=True)
        return self._best(found)

    def _paired(self, formula: Quantified) -> list[Choice]:
        """Return choices of one-to-one pairs."""
        rows, columns, needed = pair_sides(formula, self.types)
        found: list[Choice] = []
        for picked in itertools.islice(itertools.combinations(rows, needed), WIDTH):
            for partners in itertools.islice(itertools.permutations(columns, needed), 4 * WIDTH):
                pairs = list(zip(picked, partners, strict=True))
                if all(a != b for a, b in pairs):
                    cells = [instance(formula, a, b) for a, b in pairs]
                    found += self._joined(cells, positive=True, every=True)
        return self._best(found)

    def _unpaired(self, formula: Quantified) -> list[Choice]:
        """Return choices that leave too few rows, or too few columns, with a true cell."""
        rows, columns, needed = pair_sides(formula, self.types)
        found: list[Choice] = []
        for cleared, others, transposed in ((rows, columns, False), (columns, rows, True)):
            for picked in itertools.islice(itertools.combinations(cleared, len(cleared) - needed + 1), WIDTH):
                pairs = [(b, a) if transposed else (a, b) for a in picked for b in others if a != b]
                cells = [instance(formula, a, b) for a, b in pairs]
                found += self._joined(cells, positive=False, every=True)
        return self._best(found)

    def _cost_of(self, formula: Formula) -> int:
        options = self.of(formula, positive=True)
        return min((self._cost(choice) for choice in options), default=len(self.types))

    def _cost(self, choice: Choice) -> int:
        return sum(self._judge(item)[0] for item in choice)

    def _judge(self, item: GroundLiteral) -> tuple[bool, bool]:
        """Return two flags: the literal does not hold yet; the literal is impossible."""
        if item not in self.judged:
            self.judged[item] = (not item.holds(self.facts), self.impossible(item))
        return self.judged[item]

    def _best(self, found: Iterable[Choice | None]) -> list[Choice]:
        kept = [choice for choice in found if choice is not None]
        return sorted(kept, key=self._rank)[:WIDTH]

    def _rank(self, choice: Choice) -> tuple[bool, int, int, int]:
        impossible = any(self._judge(item)[1] for item in choice)
        preferred = sum(self.preference(name) for item in choice for name in item.atom.args if item.positive)
        return (impossible, self._cost(choice), _chained(choice), -preferred)


def _chained(choice: Choice) -> int:
    """Count the literals that relate an object to one that is carried itself."""
    carried = {item.atom.args[0] for item in choice if item.positive and len(item.atom.args) > 1}
    return sum(item.positive and item.atom.args[-1] in carried for item in choice if len(item.atom.args) > 1)


def _merge(left: Choice, right: Choice) -> Choice | None:
    """Join two conjunctions without repetition; None if they contradict each other."""
    known = {item.atom: item.positive for item in left}
    extra: list[GroundLiteral] = []
    for item in right:
        if item.atom not in known:
            extra.append(item)
        elif known[item.atom] != item.positive:
            return None
    return (*left, *extra)
