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

if TYPE_CHECKING:
    from embomatrix.trainer.evaluation.held_out import HeldOutEvaluation
    from embomatrix.trainer.imitation.teacher_forcing import ImitationProgress

_LINE_INTERVAL_S: Final = 10.0
_GUESS_AFTER_S: Final = 5.0
"""Seconds of a phase after which its remaining time is shown."""


class RemainingTime:
    """Estimate of the time that a phase will still take, from the time of its share so far."""

    def __init__(self) -> None:
        self._phase = ""
        self._began_s = 0.0
        self._began_at = 0.0

    def guess_s(self, phase: str, share: float) -> float | None:
        """Return seconds, None at the beginning of a phase. A resumed phase may begin at any share."""
        now_s = time.monotonic()
        if phase != self._phase:
            self._phase, self._began_s, self._began_at = phase, now_s, share
        spent_s, done = now_s - self._began_s, share - self._began_at
        if spent_s < _GUESS_AFTER_S or done <= 0:
            return None
        return spent_s * max(0.0, 1.0 - share) / done


class LineDisplay:
    """Context manager that prints at most one line per ``_LINE_INTERVAL_S``."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._printed_s = -_LINE_INTERVAL_S
        self._validation = ""
        self._remaining = RemainingTime()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...

    def imitation(self, progress: ImitationProgress) -> None:
        figures = {"step": f"{progress.step}", "loss": f"{progress.loss:.3f}"}
        if progress.validation is not None:
            self._validation = f"{progress.validation:.3f}"
        if self._validation:
            figures["validation loss"] = self._validation
        self._show("imitation", progress.share, figures)

    def evaluating(self, label: str, done: int, total: int) -> None:
        self._show(f"held-out evaluation {label}", done / total, {"tasks": f"{done} of {total}"})

    def evaluated(self, label: str, result: HeldOutEvaluation) -> None:
        self._print(f"held-out success {label}: {result.success().as_percent()}")

    def stepped(self, record: StepRecord, share: float, rollouts_per_s: float) -> None:
        figures = {
            "step": f"{record.step}",
            "reward": f"{record.reward:.2f}",
            "success": f"{record.success:.0%}",
            "rollouts/s": f"{rollouts_per_s:.0f}",
            "warm starts": f"{record.warm:.0%}",
            "shared steps": f"{record.shared:.0%}",
            "entropy": "–" if record.entropy is None else f"{record.entropy:.2f}",
            "zero-variance groups": f"{record.zero_variance_groups:.0%}",
        }
        self._show("GRPO", share, figures)

    def _show(self, title: str, share: float, figures: Mapping[str, str]) -> None:
        now_s = time.monotonic()
        left = self._left(title, share)
        if now_s - self._printed_s >= _LINE_INTERVAL_S:
            self._printed_s = now_s
            self._print(
                f"{title} {share:.0%}{left}: {', '.join(f'{name} {value}' for name, value in figures.items())}"
            )

    def _left(self, title: str, share: float) -> str:
        """Return the remaining time of the phase in words, empty if it can't be guessed yet."""
        guess_s = self._remaining.guess_s(title, share)
        if guess_s is None:
            return ""
        minutes, seconds = divmod(round(guess_s), 60)
        return f", {minutes} min {seconds:02} s left" if minutes else f", {seconds} s left"

    def _print(self, text: str) -> None:
        self._console.print(text, highlight=False, markup=False)


class LiveDisplay(LineDisplay):
    """Panel that is redrawn in place."""

    def __init__(self, console: Console) -> None:
        super().__init__(console)
        self._live = Live(Text("starting"), console=console, refresh_per_second=4)

    def __enter__(self) -> Self:
        self._live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.__exit__(None, None, None)

    def _show(self, title: str, share: float, figures: Mapping[str, str]) -> None:
        table = Table.grid(padding=(0, 2))
        table.add_row(*(Text(name, style="dim") for name in figures))
        table.add_row(*figures.values())
        share = min(1.0, share)
        bar = ProgressBar(total=1.0, completed=share, width=60)
        shown = f"{title}  {share:.0%}{self._left(title, share)}"
        self._live.update(Group(Text(shown, style="bold"), bar, table))


def display_on(console: Console) -> LineDisplay:
    """Return a live panel on a terminal, else plain lines."""
    return LiveDisplay(console) if console.is_terminal else LineDisplay(console)
