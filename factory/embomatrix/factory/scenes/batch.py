"""Parallel building and checking of scenes, largest inventories first."""

from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from embomatrix.factory.importers.shelf import read_assets
from embomatrix.factory.scenes.report import SceneReport, report_on, report_on_file
from embomatrix.factory.scenes.scene_file import write_scene
from embomatrix.sim.process_pool import process_pool
from embomatrix.world.catalog import Catalog


@dataclass(frozen=True, slots=True)
class SceneBuildJob:
    """Scene to build and check. ``path`` is the output file, ``assets`` a folder of imported assets.

    A job with a ``source``, the file of an earlier build, only checks that file. A job with a ``house``, a house file, builds
    that floor plan.
    """

    scene_id: str
    seed: int
    path: Path | None = None
    assets: Path | None = None
    source: Path | None = None
    house: Path | None = None
    background: bool = True
    """Fill homes with background objects."""


def run_batch(jobs: Sequence[SceneBuildJob], *, processes: int) -> Iterator[SceneReport]:
    """Yield reports as they finish; a single job runs in this process.

    Raises CatalogError for an unknown scene before anything is built, ModelFileError for a damaged asset, OSError if a file
    can't be written. If a worker process dies, the reports of its unfinished jobs say so.
    """
    catalog = Catalog.load()
    counts = {job: _object_count(catalog, job) for job in jobs}
    if len(jobs) == 1:
        yield _run(jobs[0])
        return
    with process_pool(min(processes, len(jobs))) as pool:
        largest_first = sorted(jobs, key=lambda job: -counts[job])
        waiting = {pool.submit(_run, job): job for job in largest_first}
        for done in as_completed(waiting):
            job = waiting[done]
            try:
                yield done.result()
            except BrokenExecutor:
                yield SceneReport(job.scene_id, job.seed, error="its process died, perhaps out of memory")


def _run(job: SceneBuildJob) -> SceneReport:
    if job.source is not None:
        return report_on_file(job.scene_id, job.seed, job.source)
    imported = read_assets(job.assets) if job.assets is not None else {}
    report, scene = report_on(job.scene_id, job.seed, imported, background=job.background, house=job.house)
    if scene is not None and job.path is not None:
        try:
            write_scene(job.path, scene)
        except OSError as error:
            # The error of a full disk does not name the file.
            raise OSError(error.errno, error.strerror, str(job.path)) from error
    return report


def _object_count(catalog: Catalog, job: SceneBuildJob) -> int:
    """Return the number of objects to place, which predicts the time that the job takes."""
    if job.source is not None or job.house is not None:
        return 0
    return sum(count for room in catalog.inventory(job.scene_id).rooms for _, _, count in room.items)
