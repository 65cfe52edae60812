"""Token masks that keep plans in the ``names`` codec valid: only existing skills, objects and rooms can be sampled.

``PlanGrammar`` belongs to a vocabulary, ``PromptNames`` to a batch of prompts. Both are lookup tables, so the masks of
all rows are computed at once.

Shapes: Q prompts of P tokens, R rows (plans), T tokens of a plan, V words, N number words (``_0`` ``_1`` ...).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import torch
from torch import Tensor

from embomatrix.skills.syntax import SIGNATURES, Arg, PlaceRelation, Skill
from embomatrix.trainer.policy.decoder import Shortlist
from embomatrix.trainer.policy.vocabulary import BREAK, END, PAD, Vocabulary


class _Expects(IntEnum):
    """Kind of token that a call expects next."""

    SKILL = 0
    OBJECT = 1
    ROOM = 2
    RELATION = 3
    QUANTITY = 4
    CALL_END = 5


_EXPECTS_OF: Final[Mapping[Arg, _Expects]] = {
    Arg.OBJECT: _Expects.OBJECT,
    Arg.SOURCE: _Expects.OBJECT,
    Arg.RELATION: _Expects.RELATION,
    Arg.YAW: _Expects.QUANTITY,
    Arg.DISTANCE: _Expects.QUANTITY,
    Arg.ROOM: _Expects.ROOM,
}
_MAX_ARGUMENTS: Final = max(map(len, SIGNATURES.values())) + 1


@dataclass(frozen=True, slots=True)
class PromptNames:
    """Names of objects and rooms in a batch of prompts.

    ``stems`` (Q, 2, V): first words of object names and of room names. ``unnumbered`` (Q, V): first words that are complete
    names. ``numbers`` (Q, V, N): number words that may follow a first word. ``share`` (Q, V): one name's share of the names
    with a first word, 1 for words that begin no name.
    """

    stems: Tensor
    unnumbered: Tensor
    numbers: Tensor
    share: Tensor

    def select(self, prompts: Tensor) -> PromptNames:
        """Names of the prompts with these indices (R,). Indices may repeat."""
        return PromptNames(
            self.stems[prompts], self.unnumbered[prompts], self.numbers[prompts], self.share[prompts]
        )


@dataclass(frozen=True, slots=True)
class GrammarState:
    """Position in each plan, all (R,): skill of the last call (PAD: none), number of its arguments so far, and the stem of a
    name that may still get a number (PAD: none). A call ends with its last argument: the next word is a skill or the end.

    ``taken`` (R, S, 2): stem and number of the thing that each of the S words so far completes as one to be picked up. PAD
    for all other words, and for the number of an unnumbered name.
    """

    skill: Tensor
    arguments: Tensor
    open_stem: Tensor
    taken: Tensor

    def select(self, rows: Tensor) -> GrammarState:
        return GrammarState(self.skill[rows], self.arguments[rows], self.open_stem[rows], self.taken[rows])


class PlanGrammar:
    """Grammar tables of one vocabulary."""

    def __init__(self, vocabulary: Vocabulary, device: torch.device) -> None:
        size, index = len(vocabulary), vocabulary.index
        self._break, self._task = index[BREAK], index["task"]
        self._pick_up = index.get(Skill.PICK_UP.value, PAD)
        self._numbers = torch.tensor(vocabulary.number_tokens, dtype=torch.long, device=device)  # (N,)
        self._number_index = torch.full((size,), -1, device=device)
        self._number_index[self._numbers] = torch.arange(len(self._numbers), device=device)
        self._stems = torch.zeros(2, size, dtype=torch.bool, device=device)
        self._stems[0, list(vocabulary.object_tokens)] = True
        self._stems[1, list(vocabulary.room_tokens)] = True
        self._arguments = torch.full((size, _MAX_ARGUMENTS), int(_Expects.SKILL), device=device)
        self._fixed = torch.zeros(len(_Expects), size, dtype=torch.bool, device=device)
        for skill, signature in SIGNATURES.items():
            if skill.value in index:
                arguments = [*(_EXPECTS_OF[argument] for argument in signature), _Expects.CALL_END]
                self._arguments[index[skill.value], : len(arguments)] = torch.tensor(arguments, device=device)
                self._fixed[_Expects.SKILL, index[skill.value]] = True
        # Vocabularies of older checkpoints lack later relations.
        relations = [index[relation.value] for relation in PlaceRelation if relation.value in index]
        self._fixed[_Expects.RELATION, relations] = True
        self._fixed[_Expects.QUANTITY, list(vocabulary.quantity_tokens)] = True
        self._fixed[_Expects.CALL_END] = self._fixed[_Expects.SKILL]
        self._fixed[_Expects.CALL_END, END] = True

    def prompt_names(self, prompts: Tensor) -> PromptNames:
        """Collect the names in prompts (Q, P), up to the line with the instruction."""
        count, size = len(prompts), len(self._number_index)
        lines = torch.roll(prompts, 1, dims=1) == self._break
        in_table = ((prompts == self._task) & lines).flip(1).cumsum(dim=1).flip(
            1
        ) > 0  # (Q, P): before the task
        number = torch.roll(self._number_index[prompts], -1, dims=1)  # (Q, P): of the word after
        number[:, -1] = -1
        stems = torch.zeros(count, 2, size, dtype=torch.bool, device=prompts.device)
        unnumbered = torch.zeros(count, size, dtype=torch.bool, device=prompts.device)
        numbers = torch.zeros(count, size, len(self._numbers), dtype=torch.bool, device=prompts.device)
        for kind in range(2):
            row, at = (in_table & self._stems[kind][prompts]).nonzero(as_tuple=True)
            word, follows = prompts[row, at], number[row, at]
            stems[row, kind, word] = True
            unnumbered[row[follows < 0], word[follows < 0]] = True
            numbers[row[follows >= 0], word[follows >= 0], follows[follows >= 0]] = True
        share = 1 / (numbers.sum(dim=2) + unnumbered).clamp(min=1)
        return PromptNames(stems, unnumbered, numbers, share)

    def words(self, names: PromptNames) -> Tensor:
        """Return the mask (V,) of the words that plans for these prompts can contain."""
        found = self._fixed.any(dim=0) | names.stems.any(dim=1).any(dim=0)
        found[self._numbers] |= names.numbers.any(dim=1).any(dim=0)
        found[[PAD, END]] = True
        return found

    def start(self, rows: int) -> GrammarState:
        """State of empty plans."""
        nothing = torch.full((rows,), PAD, device=self._number_index.device)
        return GrammarState(nothing, torch.zeros_like(nothing), nothing, nothing.new_zeros(rows, 0, 2))

    def advance(self, state: GrammarState, tokens: Tensor, names: PromptNames) -> GrammarState:
        """State after one more token of each plan (R,). ``names`` belong to each row's prompt."""
        argument = self._arguments[state.skill, state.arguments]
        joins = self._number_index[tokens] >= 0
        begins = ~joins & ((argument == _Expects.SKILL) | (argument == _Expects.CALL_END))
        fills = ~joins & ~begins
        named = (argument == _Expects.OBJECT) | (argument == _Expects.ROOM)
        skill = torch.where(begins, tokens, state.skill)
        arguments = (state.arguments + fills).masked_fill(begins, 0)
        open_stem = torch.where(fills & named, tokens, PAD)
        rows = torch.arange(len(tokens), device=tokens.device)
        numbered = joins & (state.skill == self._pick_up)
        alone = fills & (state.skill == self._pick_up) & names.unnumbered[rows, tokens]
        stem = torch.where(numbered, state.open_stem, torch.where(alone, tokens, PAD))
        taken = torch.stack([stem, torch.where(numbered, tokens, PAD)], dim=1)[:, None]
        return GrammarState(skill, arguments, open_stem, torch.cat([state.taken, taken], dim=1))

    def coverage(self, state: GrammarState, names: PromptNames, shortlist: Shortlist) -> Tensor:
        """Return how far each word of a shortlist (R, K) leads to things that the plan has picked up before, 0 to 1.

        For a number it is 1 if the plan picked up the thing of that name. For a first word it is the share of the prompt's
        things of that word, if a call expects an object next.
        """
        stems, numbers = state.taken.unbind(dim=2)  # (R, S)
        rows = torch.arange(len(stems), device=stems.device)[:, None]
        expects_object = self._arguments[state.skill, state.arguments] == _Expects.OBJECT
        again = (stems == state.open_stem[:, None]) & (stems != PAD)
        columns = shortlist.columns
        found = torch.zeros(len(stems), len(shortlist.words), device=stems.device)
        found.scatter_add_(1, columns[stems], names.share[rows, stems] * expects_object[:, None])
        found.scatter_add_(1, columns[numbers], again.float())
        found[:, columns[PAD]] = 0.0
        return found.clamp_(max=1.0)

    def token_mask(self, state: GrammarState, names: PromptNames) -> Tensor:
        """Return the words (R, V) that must not come next. ``names`` belong to each row's prompt.

        The end token is allowed if nothing else is.
        """
        argument = self._arguments[state.skill, state.arguments]
        rows = torch.arange(len(argument), device=argument.device)
        allowed = self._fixed[argument]
        allowed = allowed | (names.stems[:, 0] & (argument == _Expects.OBJECT)[:, None])
        allowed = allowed | (names.stems[:, 1] & (argument == _Expects.ROOM)[:, None])
        open_name = state.open_stem != PAD
        allowed = allowed & (~open_name | names.unnumbered[rows, state.open_stem])[:, None]
        allowed[:, self._numbers] |= names.numbers[rows, state.open_stem] & open_name[:, None]
        allowed[:, END] |= ~allowed.any(dim=1)
        return ~allowed

    def rules_of_plans(
        self, tokens: Tensor, names: PromptNames, shortlist: Shortlist
    ) -> tuple[Tensor, Tensor]:
        """Return which words of a shortlist are masked at each position of plans (R, T), and their coverage: (R, T, K) each.

        The plans' own tokens are never masked, so a plan that breaks the grammar still has a likelihood.
        """
        state = self.start(len(tokens))
        masks, coverages = [], []
        for at in range(tokens.shape[1]):
            mask = self.token_mask(state, names)
            masks.append(mask.scatter_(1, tokens[:, at, None], False)[:, shortlist.words])
            coverages.append(self.coverage(state, names, shortlist))
            state = self.advance(state, tokens[:, at], names)
        return torch.stack(masks, dim=1), torch.stack(coverages, dim=1)
