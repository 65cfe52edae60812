"""Start of a run: settings, tasks and policy, new or from a checkpoint."""

import contextlib
import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from embomatrix.host.limits import usable_cores
from embomatrix.host.own_files import is_own
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import (
    LANGUAGE_MODEL_DEFAULTS,
    TrainSettings,
    read_settings,
    with_changes,
)
from embomatrix.trainer.data.tasks import TaskSet, TrainingTask, load_tasks
from embomatrix.trainer.data.variation import Variation
from embomatrix.trainer.episodes.terms import EpisodeTerms
from embomatrix.trainer.lifecycle.checkpoint import (
    CHECKPOINTS,
    TrainingProgress,
    newest_checkpoint,
    read_state,
)
from embomatrix.trainer.logging.evaluations import EVALUATIONS
from embomatrix.trainer.logging.outcome import OUTCOME
from embomatrix.trainer.logging.recorder import IMITATION, METRICS, SAMPLES
from embomatrix.trainer.logging.report import REPORT
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.limits import (
    Limits,
    TokenCounter,
    expressibility,
    prompts_of,
    sentence_about,
    with_limits,
)
from embomatrix.trainer.policy.loading import TINY, configure_torch, is_word_level, new_policy, saved_policy
from embomatrix.trainer.policy.prompts import PromptBuilder
from embomatrix.trainer.policy.protocol import Policy
from embomatrix.trainer.serving.sampler import ServerSampler, open_sampler

LOG_MARK: Final = b'{"step"'
"""First bytes of each log of a run."""
REFERENCE: Final = "reference"
"""Folder of the policy after imitation in a run's folder."""
CHANGEABLE: Final = frozenset(
    {
        *("device", "threads", "processes", "track", "checkpoint_every", "keep_checkpoints", "samples_every"),
        *("grpo.minutes", "grpo.steps", "imitation.seconds", "imitation.steps", "imitation.chunk"),
        *("evaluation.every", "evaluation.samples_during"),
        *(
            "sampler.url",
            "sampler.kind",
            "sampler.folder",
            "sampler.timeout_s",
            "sampler.retry_s",
            "sampler.tolerance",
        ),
    }
)
"""Settings that may change on resume: budget, hardware, memory use and logging."""
SERVED: Final = "sampler.url"
"""Setting that moves a run to another server on resume, but neither to a first server nor back to the trainer's process."""
AFTER_IMITATION: Final = ("grpo.", "reward.", "evaluation.")
"""Prefixes of settings that may also change until imitation is finished."""


@dataclass(frozen=True)
class RunStart:
    """Everything a run starts with.

    ``progress`` comes from the checkpoint of a resumed run. ``reference`` is the policy after imitation, None
    until then and without a KL term.
    """

    settings: TrainSettings
    tasks: TaskSet
    policy: Policy
    progress: TrainingProgress
    reference: Policy | None = None

    @property
    def prompt_builder(self) -> PromptBuilder:
        """Builder of the run's prompts."""
        prompt = self.settings.prompt
        variation = Variation(self.tasks.kinds, prompt.rename_share, prompt.drop_share)
        return PromptBuilder(self.policy, prompt.rows, variation, prompt.practice_rename_share)

    @contextlib.contextmanager
    def model_server(self, out: Path, *, key: str = "") -> Iterator[ServerSampler | None]:
        """Connect to the model server of the settings and check it, None without one. Raises TrainerError."""
        if not self.settings.sampler.url or not isinstance(self.policy, HfPolicy):
            yield None
            return
        prompts = prompts_of(
            (*self.tasks.train, *self.tasks.heldout), self.settings.prompt.rows, self.policy.codec
        )
        longest = max((self.policy.encode(prompt) for prompt in prompts.values()), key=len)
        with open_sampler(self.policy, self.settings, longest, out, key=key) as sampler:
            yield sampler

    @property
    def evaluated(self) -> tuple[TrainingTask, ...]:
        """Held-out tasks of the run's evaluations, in the order of the dataset."""
        heldout, number = self.tasks.heldout, self.settings.evaluation.tasks
        if number is None:
            return tuple(heldout)
        order = np.random.default_rng(np.random.SeedSequence((self.settings.seed, 5))).permutation(
            len(heldout)
        )
        return tuple(heldout[int(at)] for at in sorted(order[:number]))

    @property
    def about_limits(self) -> tuple[str, ...]:
        """Sentences about the limits of prompts and plans, and about the tasks that can't be expressed within them.

        Of episodes, the sentence says what the policy is told and how many calls it may make.
        """
        if (terms := EpisodeTerms.of(self.settings.episodes)) is not None:
            return (terms.sentence,)
        limits = Limits(self.settings.prompt.rows, self.settings.grpo.max_new)
        counter = TokenCounter.of_policy(self.policy)
        splits = {"training tasks": self.tasks.train, "held-out tasks": self.tasks.heldout}
        return (
            f"limits: {limits.rows} object rows in a prompt (prompt.rows), {limits.max_new} tokens in a plan (grpo.max_new)",
            *(
                sentence_about(expressibility(tasks, limits, counter), named, limits, "grpo.max_new")
                for named, tasks in splits.items()
                if tasks
            ),
        )


def start_run(
    dataset: Path, out: Path, model: str, settings_file: Path | None, changes: Mapping[str, Any]
) -> RunStart:
    """Start a new run in the folder ``out``, which is created. Raises TrainerError if it holds a run already."""
    settings = new_settings(model, settings_file, changes)
    given = settings.model_fields_set
    processes = settings.processes if "processes" in given else _processes_for(settings)
    threads = settings.threads if "threads" in given else default_threads(processes)
    settings = settings.model_copy(update={"processes": processes, "threads": threads})
    if any((out / CHECKPOINTS).glob("[!.]*")):
        raise TrainerError(f"{out} holds another run: pass --resume to continue it, or another --out")
    _check_free(out)
    configure_torch(settings.threads, settings.device)
    tasks = load_tasks(dataset)
    policy = new_policy(settings, tasks)
    settings = with_limits(settings, policy, tasks)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrainerError(
            f"the folder {out} can't be created ({error.strerror}): pass another --out"
        ) from error
    return RunStart(settings, tasks, policy, TrainingProgress(dataset=digest_of(tasks)))


def new_settings(model: str, settings_file: Path | None, changes: Mapping[str, Any]) -> TrainSettings:
    """Return the settings of a new run, before its limits, processes and threads are derived. Raises TrainerError."""
    defaults = {} if is_word_level(model) else _language_defaults(model)
    return read_settings(settings_file, {**changes, "model": model}, defaults)


def _check_free(out: Path) -> None:
    """Raise TrainerError if a new run would overwrite or change a file in its folder.

    The logs of a run that ended before its first checkpoint may go on.
    """
    results = (out / name for name in (REFERENCE, REPORT, OUTCOME))
    logs = (out / name for name in (METRICS, SAMPLES, IMITATION, EVALUATIONS))
    found = [path for path in results if path.exists()]
    found += [path for path in logs if path.exists() and path.stat().st_size and not is_own(path, LOG_MARK)]
    if found:
        raise TrainerError(f"a new run would overwrite {found[0]}: pass another --out, or move it away")


def default_threads(processes: int = 1) -> int:
    """Threads of each process: half of the cores in all, because simulation on the same machine needs the others."""
    return max(1, usable_cores() // 2 // processes)


def _language_defaults(model: str) -> dict[str, Any]:
    """Defaults for a language model. A model that was trained here keeps its codec."""
    codec = HfPolicy.codec_in(Path(model))
    return {**LANGUAGE_MODEL_DEFAULTS, **({} if codec is None else {"codec": codec})}


def _processes_for(settings: TrainSettings) -> int:
    """Default number of processes.

    On a CPU, two processes halve the step time of the word-level policy. For a language model they would double the memory.
    """
    return min(2, usable_cores()) if is_word_level(settings.model) and settings.device == "cpu" else 1


def resume_run(
    dataset: Path,
    out: Path,
    changes: Mapping[str, Any],
    *,
    model: str = TINY,
    settings_file: Path | None = None,
) -> RunStart:
    """Resume the run in ``out`` from its newest checkpoint.

    Raises TrainerError if there is none, or the tasks or unchangeable settings differ.
    """
    newest = newest_checkpoint(out)
    if newest is None:
        raise TrainerError(
            f"no checkpoint in {out} to resume from: leave out --resume, or pass the run's --out"
        )
    progress, original = read_state(newest)
    given = _flat(read_settings(settings_file, {}).model_dump(exclude_unset=True))
    given |= {key: value for key, value in changes.items() if value is not None}
    given |= {} if model == TINY else {"model": model}
    settings = with_changes(original.model_dump(), given)
    _check_unchanged(out, original, settings, grpo_ready=progress.grpo_ready)
    configure_torch(settings.threads, settings.device)
    tasks = load_tasks(dataset)
    if progress.dataset != digest_of(tasks):
        raise TrainerError(
            f"the run in {out} was started with other tasks than those of {dataset}: pass its original --dataset, "
            "or start a new run with another --out"
        )
    policy = saved_policy(newest / "policy", settings)
    has_reference = progress.grpo_ready and settings.grpo.kl_coef
    reference = saved_policy(out / REFERENCE, settings).frozen_copy() if has_reference else None
    return RunStart(settings, tasks, policy, progress, reference)


def _check_unchanged(out: Path, original: TrainSettings, now: TrainSettings, *, grpo_ready: bool) -> None:
    """Raise TrainerError for the first differing setting that would change what is learned."""
    before, after = _flat(original.model_dump()), _flat(now.model_dump())
    for key, value in after.items():
        moves = key != SERVED or bool(value) == bool(before[key]) or not grpo_ready
        changeable = (key in CHANGEABLE and moves) or (not grpo_ready and key.startswith(AFTER_IMITATION))
        if value != before[key] and not changeable:
            raise TrainerError(
                f"the run in {out} was started with {key} = {before[key]!r}, and can't be resumed with {value!r}: leave "
                "that out, or start a new run with another --out"
            )


def imitation_identity(settings: TrainSettings) -> dict[str, Any]:
    """Return the settings, by dotted names, that the policy during imitation depends on."""
    flat = _flat(settings.model_dump(mode="json"))
    return {
        name: value
        for name, value in flat.items()
        if name not in CHANGEABLE and not name.startswith(AFTER_IMITATION)
    }


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested settings to dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def digest_of(tasks: TaskSet) -> str:
    """Digest of all tasks and their bundles."""
    lines = (f"{task.task.task_id} {task.bundle_digest}" for task in (*tasks.train, *tasks.heldout))
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]
