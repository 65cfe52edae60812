"""What a person sees while training runs: a live panel in a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Protocol, Self

from rich.console import Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from rich.console import Console

    from embomatrix.trainer.evaluation.held_out import HeldOutEvaluation
    from embomatrix.trainer.grpo.records import StepRecord
    from embomatrix.trainer.imitation.teacher_forcing import ImitationProgress

_SMOOTHING = 0.9
_LINE_EVERY_S = 10.0


class Display(Protocol):
    """Context manager that is told what happens."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def imitation(self, progress: ImitationProgress) -> None: ...

    def evaluating(self, label: str, done: int, total: int) -> None: ...

    def evaluated(self, label: str, result: HeldOutEvaluation) -> None: ...

    def stepped(self, record: StepRecord, share: float, rollouts_per_s: float) -> None: ...


class LineDisplay:
    """One line now and then: for logs and pipes."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._said_s = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...

    def _say(self, text: str, *, always: bool = False) -> None:
        now_s = time.monotonic()
        if always or now_s - self._said_s >= _LINE_EVERY_S:
            self._said_s = now_s
            self._console.print(text, highlight=False, markup=False)

    def imitation(self, progress: ImitationProgress) -> None:
        measured = "" if progress.validation is None else f", {progress.validation:.3f} on tasks set aside"
        self._say(f"imitation {progress.share:.0%}: step {progress.step}, loss {progress.loss:.3f}{measured}")

    def evaluating(self, label: str, done: int, total: int) -> None:
        self._say(f"evaluation {label}: {done} of {total} tasks")

    def evaluated(self, label: str, result: HeldOutEvaluation) -> None:
        self._say(f"evaluation {label}: success {result.success().as_percent()}", always=True)

    def stepped(self, record: StepRecord, share: float, rollouts_per_s: float) -> None:
        self._say(
            f"GRPO {share:.0%}: step {record.step}, reward {record.reward:.2f}, success {record.success:.0%}, "
            f"{rollouts_per_s:.0f} rollouts/s, warm starts {record.warm:.0%}, entropy {_told(record.entropy)}, "
            f"dead groups {record.dead_groups:.0%}"
        )


class LiveDisplay:
    """A panel that is redrawn in place, with figures smoothed over about ten steps."""

    def __init__(self, console: Console) -> None:
        self._live = Live(Text("starting"), console=console, refresh_per_second=4)
        self._console = console
        self._began_s = 0.0
        self._smooth: dict[str, float] = {}
        self._validation = ""

    def __enter__(self) -> Self:
        self._live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.__exit__(None, None, None)

    def imitation(self, progress: ImitationProgress) -> None:
        loss = self._smoothed("loss", progress.loss)
        figures = {"step": f"{progress.step}", "loss": f"{loss:.3f}"}
        if progress.validation is not None:
            self._validation = f"{progress.validation:.3f}"
        if self._validation:
            figures["on tasks set aside"] = self._validation
        self._draw("imitation of the oracle", progress.share, figures)

    def evaluating(self, label: str, done: int, total: int) -> None:
        self._draw(f"held-out evaluation {label}", done / total, {"tasks": f"{done} of {total}"})

    def evaluated(self, label: str, result: HeldOutEvaluation) -> None:
        self._console.print(
            f"held-out success {label}: {result.success().as_percent()}", highlight=False, markup=False
        )

    def stepped(self, record: StepRecord, share: float, rollouts_per_s: float) -> None:
        if not self._began_s:
            self._began_s = time.monotonic()
        figures = {
            "step": f"{record.step}",
            "reward": f"{self._smoothed('reward', record.reward):.2f}",
            "success": f"{self._smoothed('success', record.success):.0%}",
            "rollouts/s": f"{self._smoothed('rate', rollouts_per_s):.0f}",
            "warm starts": f"{self._smoothed('warm', record.warm):.0%}",
            "entropy": _told(record.entropy),
            "dead groups": f"{self._smoothed('dead', record.dead_groups):.0%}",
            "left": _minutes(self._left_s(share)),
        }
        self._draw("GRPO", share, figures)

    def _left_s(self, share: float) -> float:
        return (time.monotonic() - self._began_s) * (1 - share) / share if share > 0 else 0.0

    def _smoothed(self, name: str, value: float) -> float:
        last = self._smooth.get(name, value)
        self._smooth[name] = _SMOOTHING * last + (1 - _SMOOTHING) * value
        return self._smooth[name]

    def _draw(self, title: str, share: float, figures: dict[str, str]) -> None:
        table = Table.grid(padding=(0, 2))
        table.add_row(*(Text(name, style="dim") for name in figures))
        table.add_row(*figures.values())
        bar = ProgressBar(total=1.0, completed=min(1.0, share), width=60)
        self._live.update(Group(Text(f"{title}  {min(1.0, share):.0%}", style="bold"), bar, table))


def _told(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _minutes(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def display_for(console: Console) -> Display:
    """The live panel where it can be redrawn, lines elsewhere."""
    return LiveDisplay(console) if console.is_terminal else LineDisplay(console)
