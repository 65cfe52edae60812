"""Runs of an experiment, one after the other, by the user's own commands. Finished runs are not repeated."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from embomatrix.bench.experiments.design import Arm, Budget, Design, toml_of
from embomatrix.cli.local_cluster import cluster_problem, local_cluster, no_problem, run_command
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.logging.outcome import OUTCOME
from embomatrix.world.whole_file import write_whole

IMITATED = "imitated"
"""Folder of a seed's imitation, beside those of its arms."""


@dataclass(frozen=True, slots=True)
class Venue:
    """Place of execution: options that name it, and a function that returns a problem, or an empty string."""

    arguments: tuple[str, ...]
    problem: Callable[[], str]


@contextlib.contextmanager
def own_venue(folder: Path, workers: int, slots: int) -> Iterator[Venue]:
    """Run a cluster on this machine for the duration of the experiment."""
    cluster = local_cluster(folder / "cluster", workers=workers, slots=slots)
    with cluster.supervisor:
        yield Venue((f"--manager={cluster.address}",), lambda: cluster_problem(cluster))


@dataclass(frozen=True, slots=True)
class Conductor:
    """Runs a design in a folder; ``announce`` gets the heading of each run. Raises TrainerError, OSError, SystemExit."""

    design: Design
    dataset: Path
    folder: Path
    announce: Callable[[str], None]

    def conduct(self, venue: AbstractContextManager[Venue]) -> None:
        """Run all imitations, then all arms. The venue is entered for the arms only."""
        for seed in self.design.seeds:
            self.imitate(seed)
        with venue as entered:
            for seed in self.design.seeds:
                for arm in self.design.arms:
                    self.train(seed, arm, entered)

    def imitate(self, seed: int) -> None:
        """Train the policy that this seed's arms start from."""
        out = self.folder_of(seed, IMITATED)
        if (out / "reference").is_dir():
            return
        self.announce(f"seed {seed}: imitation")
        design = self.design
        self._run(
            out,
            design.shared,
            no_problem,
            "imitate",
            f"--model={design.model}",
            _budget("seconds", design.imitation.seconds, design.imitation),
            f"--patience={design.patience}",
            f"--seed={seed}",
        )

    def train(self, seed: int, arm: Arm, venue: Venue) -> None:
        """Train one arm of one seed."""
        out = self.folder_of(seed, arm.name)
        if (out / OUTCOME).is_file():
            return
        self.announce(f"seed {seed}: {arm.name}")
        self._run(
            out,
            {**self.design.shared, **arm.settings},
            venue.problem,
            "train",
            f"--model={self.folder_of(seed, IMITATED) / 'reference'}",
            "--imitate-seconds=0",
            _budget("minutes", self.design.grpo.seconds / 60, self.design.grpo),
            f"--seed={seed}",
            *venue.arguments,
        )
        if not (out / OUTCOME).is_file():
            raise TrainerError(
                f"the run in {out} ended without an outcome: give the same command again to resume it"
            )

    def folder_of(self, seed: int, name: str) -> Path:
        """Folder of a run."""
        return self.folder / f"seed-{seed}" / name

    def _run(
        self, out: Path, settings: Mapping[str, str], problem: Callable[[], str], *arguments: str
    ) -> None:
        out.mkdir(parents=True, exist_ok=True)
        written = out / "settings.toml"
        write_whole(written, toml_of(settings).encode("utf-8"))
        resumes = any((out / "checkpoints").glob("[!.]*"))
        # A checkpoint holds the settings already.
        rest = ("--resume",) if resumes else (f"--settings={written}",)
        run_command(
            "experiment",
            problem,
            *arguments,
            f"--dataset={self.dataset}",
            f"--out={out}",
            f"--threads={self.design.threads}",
            *rest,
        )


def _budget(unit: str, amount: float, budget: Budget) -> str:
    """Option that gives a command its budget."""
    return f"--{unit}={amount}" if budget.steps is None else f"--steps={budget.steps}"
