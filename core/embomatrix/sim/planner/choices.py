"""Ways to make a goal true: conjunctions of ground literals, those that change least first."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.world.evaluate import substitute
from embomatrix.world.goal import (
    And,
    Atom,
    Exists,
    Forall,
    Formula,
    ForN,
    ForNPairs,
    ForPairs,
    Imply,
    Not,
    Or,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from embomatrix.world.goal import Facts

    Types = Mapping[str, tuple[str, ...]]

WIDTH: Final = 12
"""Alternatives that are kept of each part of a goal."""


@dataclass(frozen=True, slots=True)
class GroundLiteral:
    """A ground atom that must hold, or must not."""

    atom: Atom
    positive: bool


Choice = tuple[GroundLiteral, ...]


def choices(
    goal: Formula,
    types: Types,
    facts: Facts,
    liking: Callable[[str], int] = lambda name: 0,
    hopeless: Callable[[GroundLiteral], bool] = lambda literal: False,
) -> tuple[Choice, ...]:
    """Up to ``WIDTH`` ways to make the goal true, by how many of their literals do not hold yet.

    Of equal ones those come first whose objects are liked most, and ways with a hopeless literal come last. Each is enough
    for the goal; together they need not be all there are. A way that contradicts itself is left out.
    """
    return tuple(_Choices(types, facts, liking, hopeless).of(goal, positive=True))


class _Choices:
    def __init__(
        self,
        types: Types,
        facts: Facts,
        liking: Callable[[str], int],
        hopeless: Callable[[GroundLiteral], bool],
    ) -> None:
        self._types = types
        self._facts = facts
        self._liking = liking
        self._hopeless = hopeless
        self._known: dict[GroundLiteral, tuple[bool, bool]] = {}

    def of(self, formula: Formula, *, positive: bool) -> list[Choice]:
        match formula:
            case Atom():
                return [(GroundLiteral(formula, positive),)]
            case Not(body):
                return self.of(body, positive=not positive)
            case And(parts):
                return self._joined(parts, positive=positive, every=positive)
            case Or(parts):
                return self._joined(parts, positive=positive, every=not positive)
            case Imply(premise, conclusion):
                return self.of(Or((Not(premise), conclusion)), positive=positive)
            case Forall(variable, type_name, body):
                grounded = self._ground(body, variable, type_name)
                return self._joined(grounded, positive=positive, every=positive)
            case Exists(variable, type_name, body):
                grounded = self._ground(body, variable, type_name)
                return self._joined(grounded, positive=positive, every=not positive)
            case ForN(count, variable, type_name, body):
                return self._exactly(count, self._ground(body, variable, type_name), positive=positive)
            case ForPairs() | ForNPairs():
                return self._paired(formula) if positive else self._unpaired(formula)

    def _ground(self, body: Formula, variable: str, type_name: str) -> list[Formula]:
        return [substitute(body, {variable: name}) for name in self._types.get(type_name, ())]

    def _joined(self, parts: Iterable[Formula], *, positive: bool, every: bool) -> list[Choice]:
        """All of the parts, or any one of them."""
        each = [self.of(part, positive=positive) for part in parts]
        if not every:
            return self._best(itertools.chain.from_iterable(each))
        found: list[Choice] = [()]
        for options in each:
            found = self._best(_merge(left, right) for left in found for right in options)
        return found

    def _exactly(self, count: int, parts: Sequence[Formula], *, positive: bool) -> list[Choice]:
        """``count`` of the parts and no other; for the negation, one number of them more or fewer."""
        counts = [count] if positive else [n for n in (count + 1, count - 1) if 0 <= n <= len(parts)]
        ranked = sorted(range(len(parts)), key=lambda index: self._cost_of(parts[index]))
        found: list[Choice] = []
        for number in counts:
            # The cheapest parts come first, so the first subsets are those that change least.
            for chosen in itertools.islice(itertools.combinations(ranked, number), WIDTH):
                asked = [parts[i] if i in chosen else Not(parts[i]) for i in range(len(parts))]
                found += self._joined(asked, positive=True, every=True)
        return self._best(found)

    def _paired(self, formula: ForPairs | ForNPairs) -> list[Choice]:
        """One-to-one pairs, as many as the quantifier asks for."""
        rows, columns = (self._types.get(name, ()) for name in (formula.type_a, formula.type_b))
        needed = formula.count if isinstance(formula, ForNPairs) else min(len(rows), len(columns))
        found: list[Choice] = []
        for picked in itertools.islice(itertools.combinations(rows, needed), WIDTH):
            for partners in itertools.islice(itertools.permutations(columns, needed), 4 * WIDTH):
                pairs = list(zip(picked, partners, strict=True))
                if any(a == b for a, b in pairs):
                    continue
                bodies = [
                    substitute(formula.body, {formula.variable_a: a, formula.variable_b: b}) for a, b in pairs
                ]
                found += self._joined(bodies, positive=True, every=True)
        return self._best(found)

    def _unpaired(self, formula: ForPairs | ForNPairs) -> list[Choice]:
        """So many rows, or so many columns, without a true cell that too few are left."""
        rows, columns = (self._types.get(name, ()) for name in (formula.type_a, formula.type_b))
        needed = formula.count if isinstance(formula, ForNPairs) else min(len(rows), len(columns))
        found: list[Choice] = []
        for cleared, others, turned in ((rows, columns, False), (columns, rows, True)):
            for picked in itertools.islice(itertools.combinations(cleared, len(cleared) - needed + 1), WIDTH):
                pairs = [(b, a) if turned else (a, b) for a in picked for b in others if a != b]
                cells = [
                    substitute(formula.body, {formula.variable_a: a, formula.variable_b: b}) for a, b in pairs
                ]
                found += self._joined(cells, positive=False, every=True)
        return self._best(found)

    def _cost_of(self, formula: Formula) -> int:
        options = self.of(formula, positive=True)
        return min((self._cost(choice) for choice in options), default=len(self._types))

    def _cost(self, choice: Choice) -> int:
        return sum(self._judge(item)[0] for item in choice)

    def _judge(self, item: GroundLiteral) -> tuple[bool, bool]:
        """Whether the literal is still to be made true, and whether that is hopeless."""
        if item not in self._known:
            missing = self._facts.holds(item.atom.predicate, item.atom.args) != item.positive
            self._known[item] = (missing, self._hopeless(item))
        return self._known[item]

    def _best(self, found: Iterable[Choice | None]) -> list[Choice]:
        kept = [choice for choice in found if choice is not None]
        return sorted(kept, key=self._rank)[:WIDTH]

    def _rank(self, choice: Choice) -> tuple[bool, int, int, int]:
        hopeless = any(self._judge(item)[1] for item in choice)
        return (hopeless, self._cost(choice), _chained(choice), -self._liked(choice))

    def _liked(self, choice: Choice) -> int:
        return sum(self._liking(name) for item in choice for name in item.atom.args if item.positive)


def _chained(choice: Choice) -> int:
    """How many things go onto, or beside, what is to be carried itself."""
    carried = {item.atom.args[0] for item in choice if item.positive and len(item.atom.args) > 1}
    return sum(item.positive and item.atom.args[-1] in carried for item in choice if len(item.atom.args) > 1)


def _merge(left: Choice, right: Choice) -> Choice | None:
    """Both conjunctions, without repetition; None when one denies what the other asks."""
    known = {item.atom: item.positive for item in left}
    extra: list[GroundLiteral] = []
    for item in right:
        if item.atom not in known:
            extra.append(item)
        elif known[item.atom] != item.positive:
            return None
    return (*left, *extra)
