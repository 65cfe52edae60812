"""Who makes the variants of a round: this process, or several."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from embomatrix.factory.pipeline.variants import VariantMaker, VariantOrder, VariantYield
from embomatrix.sim.process_pool import shared_work
from embomatrix.world.dataset import DatasetError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from embomatrix.factory.layout.jobs import LayoutAgents
    from embomatrix.factory.pipeline.settings import BuildSettings
    from embomatrix.factory.writer.tasks import TaskWriter

    Make = Callable[[Sequence[VariantOrder]], Iterator[VariantYield]]
    """Makes variants; what comes of them comes in the order of the orders."""


@contextlib.contextmanager
def makers(
    settings: BuildSettings, writer: TaskWriter | None, layout: LayoutAgents | None, jobs: int
) -> Iterator[Make]:
    """For as long as this is held. ``writer`` and ``layout`` work in this process alone: they may hold a connection."""
    if writer is not None or layout is not None:
        with contextlib.closing(VariantMaker(settings, writer, layout)) as maker:
            yield lambda orders: map(maker.make, orders)
        return
    died = DatasetError(
        "a process that makes scene variants died, perhaps for want of memory: what was built is kept; call the same "
        "command again, with fewer --jobs"
    )
    with shared_work(jobs, VariantMaker, VariantMaker.make, settings, died=died) as make:
        yield make
