"""What may follow in a plan of the ``names`` codec: a policy that is held to it calls nothing that it was not told of.

A grammar is bound to a vocabulary, ``Names`` to a batch of prompts. Both are tables, so that the words which may come next
are looked up for all rows at once.

Shapes: Q prompts of P tokens, R rows (plans), T tokens of a plan, V words, N number words (``_0`` ``_1`` ...).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final

import torch

from embomatrix.skills.syntax import SIGNATURES, Arg, PlaceRelation
from embomatrix.trainer.policy.vocabulary import BREAK, END, PAD

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

    from embomatrix.trainer.policy.vocabulary import Vocabulary


class _Place(IntEnum):
    """Places of a call, by what may stand there."""

    SKILL = 0
    THING = 1
    ROOM = 2
    RELATION = 3
    QUANTITY = 4
    CALL_END = 5


_PLACE_OF: Final[Mapping[Arg, _Place]] = {
    Arg.OBJECT: _Place.THING,
    Arg.SOURCE: _Place.THING,
    Arg.RELATION: _Place.RELATION,
    Arg.YAW: _Place.QUANTITY,
    Arg.DISTANCE: _Place.QUANTITY,
    Arg.ROOM: _Place.ROOM,
}
_MOST_PLACES: Final = max(map(len, SIGNATURES.values())) + 1


@dataclass(frozen=True, slots=True)
class Names:
    """The names that prompts tell.

    ``heads`` (Q, 2, V): first words of names of things and of rooms. ``bare`` (Q, V): those that are names by themselves.
    ``numbers`` (Q, V, N): number words that may follow a first word.
    """

    heads: Tensor
    bare: Tensor
    numbers: Tensor

    def of_rows(self, prompts: Tensor) -> Names:
        """The prompts with these indices (R,), each as often as it is named."""
        return Names(self.heads[prompts], self.bare[prompts], self.numbers[prompts])


@dataclass(frozen=True, slots=True)
class Cursor:
    """Where plans stand, all (R,): the skill of the call begun (PAD: none), its places filled, and the first word of a name
    that may still get a number (PAD: none)."""

    skill: Tensor
    filled: Tensor
    head: Tensor

    def of_rows(self, rows: Tensor) -> Cursor:
        return Cursor(self.skill[rows], self.filled[rows], self.head[rows])


class PlanGrammar:
    """Tables over one vocabulary."""

    def __init__(self, vocabulary: Vocabulary, device: torch.device) -> None:
        size, index = len(vocabulary), vocabulary.index
        self._break, self._task = index[BREAK], index["task"]
        self._numbers = torch.tensor(vocabulary.numbers, dtype=torch.long, device=device)  # (N,)
        self._number_at = torch.full((size,), -1, device=device)
        self._number_at[self._numbers] = torch.arange(len(self._numbers), device=device)
        self._named = torch.zeros(2, size, dtype=torch.bool, device=device)
        self._named[0, list(vocabulary.things)] = True
        self._named[1, list(vocabulary.rooms)] = True
        self._places = torch.full((size, _MOST_PLACES), int(_Place.SKILL), device=device)
        self._fixed = torch.zeros(len(_Place), size, dtype=torch.bool, device=device)
        for skill, signature in SIGNATURES.items():
            if skill.value in index:
                places = [*(_PLACE_OF[argument] for argument in signature), _Place.CALL_END]
                self._places[index[skill.value], : len(places)] = torch.tensor(places, device=device)
                self._fixed[_Place.SKILL, index[skill.value]] = True
        self._fixed[_Place.RELATION, [index[relation.value] for relation in PlaceRelation]] = True
        self._fixed[_Place.QUANTITY, list(vocabulary.quantities)] = True
        self._fixed[_Place.CALL_END, [self._break, END]] = True

    def names(self, prompts: Tensor) -> Names:
        """The names in prompts (Q, P): those before the line that tells the task."""
        count, size = len(prompts), len(self._number_at)
        lines = torch.roll(prompts, 1, dims=1) == self._break
        told = ((prompts == self._task) & lines).flip(1).cumsum(dim=1).flip(1) > 0  # (Q, P): before the task
        number = torch.roll(self._number_at[prompts], -1, dims=1)  # (Q, P): of the word after
        number[:, -1] = -1
        heads = torch.zeros(count, 2, size, dtype=torch.bool, device=prompts.device)
        bare = torch.zeros(count, size, dtype=torch.bool, device=prompts.device)
        numbers = torch.zeros(count, size, len(self._numbers), dtype=torch.bool, device=prompts.device)
        for kind in range(2):
            row, at = (told & self._named[kind][prompts]).nonzero(as_tuple=True)
            word, follows = prompts[row, at], number[row, at]
            heads[row, kind, word] = True
            bare[row[follows < 0], word[follows < 0]] = True
            numbers[row[follows >= 0], word[follows >= 0], follows[follows >= 0]] = True
        return Names(heads, bare, numbers)

    def start(self, rows: int) -> Cursor:
        """Plans of which nothing is written."""
        nothing = torch.full((rows,), PAD, device=self._number_at.device)
        return Cursor(nothing, torch.zeros_like(nothing), nothing)

    def advanced(self, cursor: Cursor, tokens: Tensor) -> Cursor:
        """After one more token of each plan (R,)."""
        begins = cursor.skill == PAD
        ends = tokens == self._break
        joins = self._number_at[tokens] >= 0
        place = self._places[cursor.skill, cursor.filled]
        named = (place == _Place.THING) | (place == _Place.ROOM)
        fills = ~begins & ~joins & (place != _Place.CALL_END)
        skill = torch.where(begins, tokens, cursor.skill).masked_fill(ends, PAD)
        filled = (cursor.filled + fills).clamp(max=_MOST_PLACES - 1).masked_fill(ends, 0)
        head = torch.where(fills & named, tokens, PAD)
        return Cursor(skill, filled, head)

    def barred(self, cursor: Cursor, names: Names) -> Tensor:
        """Words (R, V) that may not come next; ``names`` are those of each row's prompt. A plan may always end where
        nothing else could follow."""
        place = self._places[cursor.skill, cursor.filled]
        rows = torch.arange(len(place), device=place.device)
        allowed = self._fixed[place]
        allowed = allowed | (names.heads[:, 0] & (place == _Place.THING)[:, None])
        allowed = allowed | (names.heads[:, 1] & (place == _Place.ROOM)[:, None])
        open_name = cursor.head != PAD
        allowed = allowed & (~open_name | names.bare[rows, cursor.head])[:, None]
        allowed[:, self._numbers] |= names.numbers[rows, cursor.head] & open_name[:, None]
        allowed[:, END] |= ~allowed.any(dim=1)
        return ~allowed

    def barred_along(self, tokens: Tensor, names: Names) -> Tensor:
        """Words (R, T, V) that may not stand at each place of plans (R, T). What does stand there is never barred, so that
        a plan that breaks the grammar has a likelihood all the same."""
        cursor = self.start(len(tokens))
        masks = []
        for at in range(tokens.shape[1]):
            masks.append(self.barred(cursor, names))
            cursor = self.advanced(cursor, tokens[:, at])
        return torch.stack(masks, dim=1).scatter(2, tokens[:, :, None], False)
