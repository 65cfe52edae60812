"""Experiment trackers: TensorBoard, Weights & Biases, trackio. Each is imported only if a run uses it."""

import contextlib
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

from embomatrix.trainer.config.errors import TrainerError, reason_of
from embomatrix.trainer.config.settings import TrackerKind, TrainSettings

PROJECT: Final = "embomatrix"
IMITATION_PHASE: Final = "imitation"
GRPO_PHASE: Final = "grpo"
WANDB_ID: Final = "wandb-id.txt"


class Tracker(Protocol):
    """Receiver of a step's numbers. Each phase of a run counts its own steps."""

    def log(self, phase: str, step: int, values: Mapping[str, float]) -> None: ...

    def close(self) -> None: ...


class TensorBoard:
    """Writes event files to ``folder/tensorboard``: view them with ``tensorboard --logdir FOLDER``."""

    def __init__(self, folder: Path, settings: TrainSettings) -> None:
        from torch.utils.tensorboard.writer import SummaryWriter

        self._writer: Any = SummaryWriter(str(folder / "tensorboard"))
        self._writer.add_text("settings", f"```json\n{settings.model_dump_json(indent=1)}\n```")

    def log(self, phase: str, step: int, values: Mapping[str, float]) -> None:
        for name, value in values.items():
            self._writer.add_scalar(f"{phase}/{name}", value, step)

    def close(self) -> None:
        self._writer.close()


class WandbLikeTracker:
    """W&B, or trackio with the same API. Both are configured by their own settings, for example ``WANDB_MODE=offline``."""

    def __init__(
        self, module: Any, folder: Path, settings: TrainSettings, options: Mapping[str, Any]
    ) -> None:
        self._module = module
        module.init(project=PROJECT, name=folder.name, config=settings.model_dump(mode="json"), **options)

    def log(self, phase: str, step: int, values: Mapping[str, float]) -> None:
        # Their own step counter never decreases, but each phase of a run counts from 0.
        named = {f"{phase}/{name}": value for name, value in values.items()}
        self._module.log({f"{phase}/step": step, **named})

    def close(self) -> None:
        self._module.finish()


def _wandb(folder: Path, settings: TrainSettings) -> Tracker:
    """A resumed run continues the W&B run whose id is stored in its folder."""
    import wandb

    id_file = folder / WANDB_ID
    if not id_file.exists():
        id_file.write_text(secrets.token_hex(4), encoding="utf-8")
    resume = {"id": id_file.read_text(encoding="utf-8"), "resume": "allow"}
    tracker = WandbLikeTracker(wandb, folder, settings, {"dir": str(folder), **resume})
    for phase in (IMITATION_PHASE, GRPO_PHASE):
        wandb.define_metric(f"{phase}/*", step_metric=f"{phase}/step")
    return tracker


def _trackio(folder: Path, settings: TrainSettings) -> Tracker:
    import trackio

    return WandbLikeTracker(trackio, folder, settings, {})


_TRACKERS: Final[Mapping[TrackerKind, Callable[[Path, TrainSettings], Tracker]]] = {
    TrackerKind.TENSORBOARD: TensorBoard,
    TrackerKind.WANDB: _wandb,
    TrackerKind.TRACKIO: _trackio,
}


@contextlib.contextmanager
def trackers_of(settings: TrainSettings, folder: Path) -> Iterator[Sequence[Tracker]]:
    """Open the trackers in the settings and close them at the end. Raises TrainerError if one can't start."""
    with contextlib.ExitStack() as open_ones:
        found = []
        for kind in dict.fromkeys(settings.track):
            tracker = _open(kind, settings, folder)
            open_ones.callback(tracker.close)
            found.append(tracker)
        yield tuple(found)


def _open(kind: TrackerKind, settings: TrainSettings, folder: Path) -> Tracker:
    try:
        return _TRACKERS[kind](folder, settings)
    except ImportError as error:
        raise TrainerError(
            f"--track {kind}: the package is missing ({reason_of(error)}): `pip install {kind}`, or leave the option out"
        ) from error
    except Exception as error:  # each raises its own errors: no account, no network, no permission
        raise TrainerError(
            f"--track {kind}: can't start it ({reason_of(error)}): configure it as its documentation says, or leave the "
            "option out"
        ) from error
