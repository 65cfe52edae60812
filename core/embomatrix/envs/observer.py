"""Knowledge of a policy within an episode: turns of the simulator become observations.

The observer follows the true state of every row, and tells of those rows that the rules let the policy know. It decides
nothing by itself and draws nothing, so equal turns give equal observations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from embomatrix.envs.rules import Visibility
from embomatrix.skills.describe import read_line
from embomatrix.skills.episode_text import Wording, observation_text, opening, row_after
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.prompt import subset
from embomatrix.skills.trace import Step

if TYPE_CHECKING:
    from embomatrix.skills.describe import ObjectDescription
    from embomatrix.skills.prompt import Codec, Prompt, PromptRow, Situation
    from embomatrix.skills.syntax import SkillCall
    from embomatrix.skills.turns import TurnObservation


@dataclass(frozen=True, slots=True)
class RememberedRow:
    """Row as the robot saw it last, after so many calls."""

    row: PromptRow
    calls: int


class Observer:
    """Knowledge of a policy in one episode of a task.

    ``situation`` is the whole situation at the start. With ``Visibility.SEEN``, every turn must have been made with sight.
    """

    def __init__(self, situation: Situation, codec: Codec, visibility: Visibility) -> None:
        self._codec = codec
        self._seen = visibility is Visibility.SEEN
        self._whole = replace(situation, full_names=self._seen)
        self._true = {row.name: row for row in situation.rows}
        self._by_index = {row.index: row.name for row in situation.rows}
        self._room = situation.robot_room
        self._held: tuple[str, ...] = ()
        self.memory: dict[int, RememberedRow] = (
            {} if self._seen else {row.index: RememberedRow(row, 0) for row in situation.rows}
        )
        """Rows that the policy knows, as it saw them last."""
        self._wording = Wording(self._whole, codec, self.memory.__contains__)

    @property
    def situation(self) -> Situation:
        """Knowledge of the policy as a situation: that of the known rows as they were seen last, for a prompt from here on."""
        rows = {index: seen.row for index, seen in self.memory.items()}
        known = replace(
            self._whole,
            robot_room=self._room,
            held=self._held,
            rows=tuple(rows.get(row.index, row) for row in self._whole.rows),
        )
        return subset(known, rows) if self._seen else known

    def begin(self, start: TurnObservation | None, at_once: int) -> Prompt:
        """Prompt at the start. With ``Visibility.SEEN``, ``start`` is the observation of a look.

        ``at_once`` is the number of calls that an answer may have.
        """
        if start is not None:
            self._follow(start, 0)
        return opening(self.situation, self._codec, seen=self._seen, at_once=at_once)

    @property
    def naming(self) -> Situation:
        """Situation of the whole table, with the names that the policy is told."""
        return self._whole

    def refusal(self, call: SkillCall) -> Step | None:
        """Return the failed step of a call with a row that the policy does not know; None for other calls.

        Such a call must not be executed: its outcome would tell whether the row exists.
        """
        index = next((index for index in _rows_of(call) if index not in self.memory), None)
        if not self._seen or index is None:
            return None
        sentence = f"there is no object with index {index} among those that you have seen"
        return Step(call, FailureReason.UNKNOWN_INDEX, sentence)

    def comes_to_know(self, call: SkillCall, turn: TurnObservation) -> bool:
        """Return whether the policy knows all rows of a call once it is told of the turn."""
        return {*_rows_of(call)} <= self.memory.keys() | {*self._true_rows(turn)}

    def outcomes(self, steps: Sequence[Step]) -> tuple[str, ...]:
        """Return the message of each step in the policy's words."""
        return tuple(map(self._wording.outcome, steps))

    def tell(
        self, steps: Sequence[Step], turn: TurnObservation | None, calls: int, notes: Sequence[str] = ()
    ) -> str:
        """Text of the observation after these steps.

        ``turn`` is the observation of their turn, None if nothing was executed. ``calls`` is the number of calls so far,
        ``notes`` are sentences about the answer.
        """
        new, changed = ((), ()) if turn is None else self._follow(turn, calls)
        return observation_text(self._wording, self._codec, steps, new, changed, self.situation, notes)

    def _follow(
        self, turn: TurnObservation, calls: int
    ) -> tuple[tuple[PromptRow, ...], tuple[PromptRow, ...]]:
        """Take in a turn. Return the rows that the policy gets to know by it, and those known ones that it sees changed.

        What is in the hand is told with the robot.
        """
        self._room, self._held = turn.room, turn.held
        for text in turn.changes:
            described = _described(text)
            if described is not None and described.name in self._true:
                self._true[described.name] = row_after(self._true[described.name], described, self._true)
        now = set(self._true_rows(turn)) if self._seen else set(self._by_index)
        new = tuple(self._row(index) for index in sorted(now - self.memory.keys()))
        changed = tuple(
            self._row(index)
            for index in sorted(now & self.memory.keys())
            if self._row(index) != self.memory[index].row and self._by_index[index] not in self._held
        )
        for index in now:
            self.memory[index] = RememberedRow(self._row(index), calls)
        return new, changed

    def _true_rows(self, turn: TurnObservation) -> tuple[int, ...]:
        """Rows in sight, and those that hold or carry one of them: who sees the apple in the fridge sees the fridge."""
        rows = [index for index in turn.sees if index in self._by_index]
        hosts = {self._true[self._by_index[index]].host for index in rows}
        return (*rows, *(self._true[host].index for host in hosts if host in self._true))

    def _row(self, index: int) -> PromptRow:
        return self._true[self._by_index[index]]


def _rows_of(call: SkillCall) -> tuple[int, ...]:
    return tuple(index for index in (call.object_index, call.source_index) if index is not None)


def _described(text: str) -> ObjectDescription | None:
    """Read a line about an object; None for the line that counts those left out."""
    try:
        return read_line(text)
    except ValueError:
        return None
