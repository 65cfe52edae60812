"""Programs that draw metrics: TensorBoard, Weights & Biases, trackio. Each is imported when a run asks for it."""

from __future__ import annotations

import contextlib
import secrets
from typing import TYPE_CHECKING, Any, Final, Protocol

from embomatrix.trainer.config.errors import TrainerError, reason_of
from embomatrix.trainer.config.settings import TrackerKind

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from embomatrix.trainer.config.settings import TrainSettings

PROJECT: Final = "embomatrix"
IMITATION_PHASE: Final = "imitation"
GRPO_PHASE: Final = "grpo"
WANDB_ID: Final = "wandb-id.txt"


class Tracker(Protocol):
    """Takes the numbers of a step. Each phase of a run counts its own steps."""

    def log(self, phase: str, step: int, values: Mapping[str, float]) -> None: ...

    def close(self) -> None: ...


class TensorBoard:
    """Event files in ``folder/tensorboard``: ``tensorboard --logdir FOLDER`` draws them."""

    def __init__(self, folder: Path, settings: TrainSettings) -> None:
        from torch.utils.tensorboard.writer import SummaryWriter

        self._writer: Any = SummaryWriter(str(folder / "tensorboard"))
        self._writer.add_text("settings", f"```json\n{settings.model_dump_json(indent=1)}\n```")

    def log(self, phase: str, step: int, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self._writer.add_scalar(f"{phase}/{name}", value, step)

    def close(self) -> None:
        self._writer.close()


class Hosted:
    """W&B, and trackio, which speaks its language. Where values go is set as these programs say (``WANDB_MODE=offline``)."""

    def __init__(self, module: Any, folder: Path, settings: TrainSettings, places: Mapping[str, Any]) -> None:
        self._module = module
        module.init(project=PROJECT, name=folder.name, config=settings.model_dump(mode="json"), **places)

    def log(self, phase: str, step: int, values: Mapping[str, float]) -> None:
        # Their own step counts all calls and never goes back, but a run has two phases.
        named = {f"{phase}/{name}": value for name, value in values.items()}
        self._module.log({f"{phase}/step": step, **named})

    def close(self) -> None:
        self._module.finish()


def _wandb(folder: Path, settings: TrainSettings) -> Tracker:
    """A run that goes on is drawn on under the id that its folder keeps; each phase is drawn over its own steps."""
    import wandb

    kept = folder / WANDB_ID
    if not kept.exists():
        kept.write_text(secrets.token_hex(4), encoding="utf-8")
    going_on = {"id": kept.read_text(encoding="utf-8"), "resume": "allow"}
    tracker = Hosted(wandb, folder, settings, {"dir": str(folder), **going_on})
    for phase in (IMITATION_PHASE, GRPO_PHASE):
        wandb.define_metric(f"{phase}/*", step_metric=f"{phase}/step")
    return tracker


def _trackio(folder: Path, settings: TrainSettings) -> Tracker:
    import trackio

    return Hosted(trackio, folder, settings, {})


_MAKERS: Final[Mapping[TrackerKind, Callable[[Path, TrainSettings], Tracker]]] = {
    TrackerKind.TENSORBOARD: TensorBoard,
    TrackerKind.WANDB: _wandb,
    TrackerKind.TRACKIO: _trackio,
}


@contextlib.contextmanager
def trackers_of(settings: TrainSettings, folder: Path) -> Iterator[Sequence[Tracker]]:
    """The trackers that the settings name, closed at the end. Raises TrainerError where one can't be had."""
    with contextlib.ExitStack() as open_ones:
        found = []
        for kind in dict.fromkeys(settings.track):
            tracker = _opened(kind, settings, folder)
            open_ones.callback(tracker.close)
            found.append(tracker)
        yield tuple(found)


def _opened(kind: TrackerKind, settings: TrainSettings, folder: Path) -> Tracker:
    try:
        return _MAKERS[kind](folder, settings)
    except ImportError as error:
        raise TrainerError(
            f"metrics can't go to {kind} ({reason_of(error)}): `pip install {kind}`, or leave out --track {kind}"
        ) from error
    except Exception as error:  # each raises its own: no account, no network, no rights
        raise TrainerError(
            f"{kind} can't be opened ({reason_of(error)}): set it up as it says, or leave out --track {kind}"
        ) from error
