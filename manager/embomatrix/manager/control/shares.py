"""How runs share the workers' memory and slots: by priority, then by weight, and nobody is kept from what others don't use."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping


@dataclass(frozen=True, slots=True)
class RunShare:
    """What a run may claim beside others."""

    run_id: str = ""
    weight: float = 1.0
    priority: int = 0


class Claim(Protocol):
    """Something that a run needs, at the ``rank``-th of its steps from now."""

    @property
    def rank(self) -> int: ...

    @property
    def share(self) -> RunShare: ...


ClaimT = TypeVar("ClaimT", bound=Claim)


def in_turns(claims: Iterable[ClaimT], cost: Callable[[ClaimT], float]) -> list[ClaimT]:
    """The claims in their order within each run; of one rank, the higher priority first, then by what each run had.

    The first to go is whose run then has least, cost over weight: of two equal runs one claim of the first, one of the
    second and so on, however many each of them has.
    """
    spent: dict[str, float] = {}
    keyed: list[tuple[int, int, float, int, ClaimT]] = []
    for index, claim in enumerate(claims):
        share = claim.share
        spent[share.run_id] = spent.get(share.run_id, 0.0) + cost(claim) / share.weight
        keyed.append((claim.rank, -share.priority, spent[share.run_id], index, claim))
    return [claim for *_, claim in sorted(keyed, key=lambda entry: entry[:4])]


def quotas(wanted: Mapping[RunShare, int], slots: int) -> dict[RunShare, float]:
    """How many of the slots each run may use: none more than it wants, the rest by weight, the higher priority first."""
    left = float(slots)
    given: dict[RunShare, float] = {}
    for priority in sorted({share.priority for share in wanted}, reverse=True):
        weights = sum(share.weight for share in wanted if share.priority == priority)
        equals = [share for share in wanted if share.priority == priority]
        # Whoever wants least for its weight is served in full before the rest is shared among the others.
        for share in sorted(equals, key=lambda share: (wanted[share] / share.weight, share.run_id)):
            given[share] = min(float(wanted[share]), left * share.weight / weights)
            left -= given[share]
            weights -= share.weight
    return given
