"""Progress of a training run in the terminal: a live panel, or plain lines for logs and pipes."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, Self

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from embomatrix.trainer.grpo.records import StepRecord
from embomatrix.trainer.logging.run_clock import Phase, RunClock

if TYPE_CHECKING:
    from embomatrix.trainer.evaluation.held_out import HeldOutEvaluation
    from embomatrix.trainer.imitation.teacher_forcing import ImitationProgress

_LINE_INTERVAL_S: Final = 10.0


class LineDisplay:
    """Context manager that prints at most one line per ``_LINE_INTERVAL_S``. Without a ``clock`` no time is shown."""

    def __init__(self, console: Console, clock: RunClock | None = None) -> None:
        self._console = console
        self._printed_s = -_LINE_INTERVAL_S
        self._validation = ""
        self._clock = clock or RunClock({}, began_s=time.monotonic())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...

    def imitation(self, progress: ImitationProgress) -> None:
        figures = {"step": f"{progress.step}", "loss": f"{progress.loss:.3f}"}
        if progress.validation is not None:
            self._validation = f"{progress.validation:.3f}"
        if self._validation:
            figures["validation loss"] = self._validation
        self._clock.note(Phase.IMITATION, progress.share, time.monotonic())
        self._show("imitation", progress.share, figures)

    def playing_oracle(self, done: int, total: int) -> None:
        self._show("oracle episodes", done / total, {"episodes": f"{done} of {total}"})

    def played_oracle(self, count: int, total: int) -> None:
        self._print(f"{count} of {total} training tasks have an episode of the oracle to imitate")

    def teaching(self, number: int, done: int, total: int) -> None:
        self._show(f"round {number} of teaching", done / total, {"episodes": f"{done} of {total}"})

    def taught(self, number: int, count: int, total: int) -> None:
        self._print(
            f"round {number} of teaching: the oracle finished {count} of {total} episodes with success"
        )

    def evaluating(self, label: str, done: int, total: int) -> None:
        self._clock.note_evaluation(label, done, total, time.monotonic())
        self._show(f"held-out evaluation {label}", done / total, {"tasks": f"{done} of {total}"})

    def evaluated(self, label: str, result: HeldOutEvaluation) -> None:
        lost = sum(score.lost for score in result.scores)
        note = f"; {lost} rollouts without a result are left out" if lost else ""
        self._print(f"held-out success {label}: {result.success().as_percent()}{note}")

    def stepped(self, record: StepRecord, share: float, rollouts_per_s: float) -> None:
        figures = {
            "step": f"{record.step}",
            "reward": f"{record.reward:.2f}",
            "success": f"{record.success:.0%}",
            "rollouts/s": f"{rollouts_per_s:.0f}",
            "warm starts": "–" if record.warm is None else f"{record.warm:.0%}",
            "shared steps": "–" if record.shared is None else f"{record.shared:.0%}",
            "entropy": "–" if record.entropy is None else f"{record.entropy:.2f}",
            "zero-variance groups": f"{record.zero_variance_groups:.0%}",
        }
        if record.lost:
            figures["lost rollouts"] = f"{record.lost} of {record.rollouts}"
        if record.cut_off:
            figures["cut-off plans"] = f"{record.cut_off:.1%}"
        self._clock.note(Phase.GRPO, share, time.monotonic())
        self._show("GRPO", share, figures)

    def _show(self, title: str, share: float, figures: Mapping[str, str]) -> None:
        now_s = time.monotonic()
        self._warn_if_late(now_s)
        if now_s - self._printed_s >= _LINE_INTERVAL_S:
            self._printed_s = now_s
            shown = ", ".join(f"{name} {value}" for name, value in figures.items())
            self._print(f"{title} {share:.0%}{self._left()}: {shown}")

    def _left(self) -> str:
        """Return the remaining time of the run in words, empty if it can't be guessed yet."""
        left_s = self._clock.left_s()
        return "" if left_s is None else f", {_in_words(left_s)} of the run left"

    def _warn_if_late(self, now_s: float) -> None:
        if self._clock.is_late(now_s):
            self._print(
                f"warning: the run takes longer than announced{self._left()}. It goes on. Other work on this machine slows it "
                "down; Ctrl-C saves a checkpoint, and `embomatrix train --resume` continues from it"
            )

    def _print(self, text: str) -> None:
        # A line of a log stays one line, however wide.
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)


class LiveDisplay(LineDisplay):
    """Panel that is redrawn in place."""

    def __init__(self, console: Console, clock: RunClock | None = None) -> None:
        super().__init__(console, clock)
        self._live = Live(Text("starting"), console=console, refresh_per_second=4)

    def __enter__(self) -> Self:
        self._live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.__exit__(None, None, None)

    def _show(self, title: str, share: float, figures: Mapping[str, str]) -> None:
        self._warn_if_late(time.monotonic())
        table = Table.grid(padding=(0, 2))
        table.add_row(*(Text(name, style="dim") for name in figures))
        table.add_row(*figures.values())
        share = min(1.0, share)
        bar = ProgressBar(total=1.0, completed=share, width=60)
        shown = f"{title}  {share:.0%}{self._left()}"
        self._live.update(Group(Text(shown, style="bold"), bar, table))


def display_on(console: Console, clock: RunClock) -> LineDisplay:
    """Return a live panel on a terminal, else plain lines."""
    return LiveDisplay(console, clock) if console.is_terminal else LineDisplay(console, clock)


def _in_words(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02} s" if minutes else f"{rest} s"
