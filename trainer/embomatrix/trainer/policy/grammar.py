"""Token masks that keep plans in the ``names`` codec valid: only existing skills, objects and rooms can be sampled.

``PlanGrammar`` belongs to a vocabulary, ``PromptNames`` to a batch of prompts. Both are lookup tables, so the masks of
all rows are computed at once.

In an episode each answer is one call, and the observation after it may name further things.

Shapes: Q prompts of P tokens, R rows (plans), T tokens of a plan, V words, N number words (``_0`` ``_1`` ...).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
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

    def add(self, kind: int, rows: Tensor, stems: Tensor, numbers: Tensor) -> None:
        """Add names in place: of objects (``kind`` 0) or rooms (1), each with its row, first word and number (names,)."""
        self.stems[rows, kind, stems] = True
        self.numbers[rows, stems, numbers] = True
        count = self.numbers[rows, stems].sum(dim=1) + self.unnumbered[rows, stems]
        self.share[rows, stems] = 1 / count


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
    """Grammar tables of one vocabulary. With ``single_calls``, a text ends after its first call."""

    def __init__(self, vocabulary: Vocabulary, device: torch.device, *, single_calls: bool = False) -> None:
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
        self._fixed[_Expects.CALL_END, END] = True
        if single_calls:
            self._fixed[_Expects.SKILL, END] = True  # nothing more to do
        else:
            self._fixed[_Expects.CALL_END] |= self._fixed[_Expects.SKILL]

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

    def after_observation(self, state: GrammarState, observed: Tensor) -> GrammarState:
        """State of plans that go on after an observation: the next answer begins. ``observed`` (R,) marks them."""
        return GrammarState(
            state.skill.masked_fill(observed, PAD),
            state.arguments.masked_fill(observed, 0),
            state.open_stem.masked_fill(observed, PAD),
            state.taken,
        )

    def observe(self, names: PromptNames, tokens: Tensor, observed: Tensor) -> None:
        """Add the numbered names in tokens (R, T) of which ``observed`` (R, T) were not written by the policy, in place."""
        for at, rows, kind in self._observed_names(tokens, observed):
            names.add(kind, rows, tokens[rows, at - 1], self._number_index[tokens[rows, at]])

    def _observed_names(self, tokens: Tensor, observed: Tensor) -> Iterator[tuple[int, Tensor, int]]:
        """Yield the rows in which a name ends at a position, with that position and the kind of the name, in order."""
        joined = observed[:, 1:] & observed[:, :-1] & (self._number_index[tokens[:, 1:]] >= 0)  # (R, T - 1)
        ends = self._stems[:, tokens[:, :-1]] & joined  # (2, R, T - 1)
        for before in ends.any(dim=1).any(dim=0).nonzero()[:, 0].tolist():
            for kind in range(2):
                rows = ends[kind, :, before].nonzero()[:, 0]
                if len(rows):
                    yield before + 1, rows, kind

    def rules_of_plans(
        self,
        tokens: Tensor,
        names: PromptNames,
        shortlist: Shortlist,
        places: Tensor,
        observed: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return which words of a shortlist are masked at places (R, M) of plans (R, T), and their coverage: (R, M, K) each.

        The plans' own tokens are never masked, so a plan that breaks the grammar still has a likelihood. ``observed`` (R, T)
        marks tokens that the policy did not write. ``names`` belong to each row's prompt.
        """
        arguments, open_stems, taken = self._walk(tokens, names, observed)
        argument, open_stem = arguments.gather(1, places), open_stems.gather(1, places)  # (R, M)
        known = _KnownNames.of(
            names,
            [] if observed is None else self._observed_names(tokens, observed),
            tokens,
            self._number_index,
        )
        allowed = self._fixed[argument][..., shortlist.words]  # (R, M, K)
        for kind, expected in enumerate((_Expects.OBJECT, _Expects.ROOM)):
            allowed |= known.stems(kind, shortlist.words, places) & (argument == expected)[..., None]
        is_open = open_stem != PAD
        whole = names.unnumbered.gather(1, open_stem)  # (R, M): the name so far is complete
        allowed &= (~is_open | whole)[..., None]
        columns = shortlist.columns[self._numbers]
        present = columns >= 0
        allowed[..., columns[present]] |= (known.numbers(open_stem, places) & is_open[..., None])[
            ..., present
        ]
        allowed[..., shortlist.columns[END]] |= ~allowed.any(dim=2)
        own = shortlist.columns[tokens.gather(1, places)][..., None]
        masks = (~allowed).scatter(2, own, False)
        expects_object = argument == _Expects.OBJECT
        return masks, self._coverages(taken, known, shortlist, places, open_stem, expects_object)

    def _walk(
        self, tokens: Tensor, names: PromptNames, observed: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return what each position of plans expects and its open stem, (R, T) each, and the words taken, (R, T, 2)."""
        state = self.start(len(tokens))
        arguments, open_stems = [], []
        for at in range(tokens.shape[1]):
            arguments.append(self._arguments[state.skill, state.arguments])
            open_stems.append(state.open_stem)
            state = self.advance(state, tokens[:, at], names)
            if observed is not None:
                state = self.after_observation(state, observed[:, at])
        taken = state.taken if observed is None else state.taken.masked_fill(observed[..., None], PAD)
        return torch.stack(arguments, dim=1), torch.stack(open_stems, dim=1), taken

    def _coverages(
        self,
        taken: Tensor,
        known: _KnownNames,
        shortlist: Shortlist,
        places: Tensor,
        open_stem: Tensor,
        expects_object: Tensor,
    ) -> Tensor:
        """Return the coverage (R, M, K) at places (R, M), as ``coverage`` does for one state."""
        order = torch.argsort((taken[..., 0] == PAD).int(), dim=1, stable=True)
        order = order[
            :, : int((taken[..., 0] != PAD).sum(dim=1).amax())
        ]  # (R, E): only positions that take a thing
        stems, numbers = taken.gather(1, order[..., None].expand(-1, -1, 2)).unbind(dim=2)  # (R, E)
        before = order[:, None] < places[..., None]  # (R, M, E)
        found = torch.zeros(*places.shape, len(shortlist.words), device=taken.device)
        shares = known.shares(stems, places) * (before & expects_object[..., None])
        again = before & (stems[:, None] == open_stem[..., None]) & (stems != PAD)[:, None]
        found.scatter_add_(2, shortlist.columns[stems][:, None].expand_as(shares), shares)
        found.scatter_add_(2, shortlist.columns[numbers][:, None].expand_as(again), again.float())
        found[..., shortlist.columns[PAD]] = 0.0
        return found.clamp_(max=1.0)


@dataclass(frozen=True, slots=True)
class _KnownNames:
    """Names at each position of plans: those of the prompt, and those that observations named before.

    ``number_since`` (R, V, N) and ``stem_since`` (R, 2, V) are the positions after which names are known, -1 for those of the
    prompt; None if there are no others.
    """

    prompt: PromptNames
    number_since: Tensor | None
    stem_since: Tensor | None

    @staticmethod
    def of(
        names: PromptNames, observed: Iterable[tuple[int, Tensor, int]], tokens: Tensor, number_index: Tensor
    ) -> _KnownNames:
        """Collect the names in observations. ``observed`` has positions of the last words of names, rows and kinds."""
        found = [*observed]
        if not found:
            return _KnownNames(names, None, None)
        never = tokens.shape[1] + 1
        number_since = torch.where(names.numbers, -1, never)
        stem_since = torch.where(names.stems, -1, never)
        for at, rows, kind in found:
            stems, numbers = tokens[rows, at - 1], number_index[tokens[rows, at]]
            number_since[rows, stems, numbers] = number_since[rows, stems, numbers].clamp(max=at)
            stem_since[rows, kind, stems] = stem_since[rows, kind, stems].clamp(max=at)
        return _KnownNames(names, number_since, stem_since)

    def stems(self, kind: int, words: Tensor, places: Tensor) -> Tensor:
        """Return which words (K,) begin names of a kind at places (R, M): (R, M, K)."""
        if self.stem_since is None:
            return self.prompt.stems[:, kind, words][:, None].expand(-1, places.shape[1], -1)
        return self.stem_since[:, kind, words][:, None] < places[..., None]

    def numbers(self, stems: Tensor, places: Tensor) -> Tensor:
        """Return which numbers may follow a stem (R, M) at its place (R, M): (R, M, N)."""
        rows = torch.arange(len(stems), device=stems.device)[:, None]
        if self.number_since is None:
            return self.prompt.numbers[rows, stems]
        return self.number_since[rows, stems] < places[..., None]

    def shares(self, stems: Tensor, places: Tensor) -> Tensor:
        """Return one name's share of the names with a stem (R, E) at places (R, M): (R, M, E)."""
        rows = torch.arange(len(stems), device=stems.device)[:, None]
        if self.number_since is None:
            return self.prompt.share[rows, stems][:, None].expand(-1, places.shape[1], -1)
        known = (self.number_since[rows, stems][:, None] < places[:, :, None, None]).sum(dim=3)  # (R, M, E)
        return 1 / (known + self.prompt.unnumbered[rows, stems][:, None]).clamp(min=1)
