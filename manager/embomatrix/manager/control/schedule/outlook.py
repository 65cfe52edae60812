"""How far scenes are, as trainers and operators are told: warm, when they will be, or why not."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.rpc.wire.values import LookaheadAnswer, PlanCell, Warmth

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from embomatrix.manager.control.schedule.holders import Holders, SchedulerWorker
    from embomatrix.manager.control.schedule.lookahead_window import LookaheadWindow


class Outlook:
    """Of one moment. ``usual_load_s`` tells the seconds that loading a scene takes, 0 where nobody knows."""

    def __init__(
        self,
        holders: Holders,
        unplaceable: Mapping[str, str],
        usual_load_s: Callable[[str], float],
        now_s: float,
    ) -> None:
        self._holders = holders
        self._unplaceable = unplaceable
        self._usual_load_s = usual_load_s
        self._now_s = now_s

    def warmth(self, scene: str) -> Warmth:
        if self._holders.warm_on(scene):
            return Warmth.WARM
        if scene in self._unplaceable:
            return Warmth.UNPLACEABLE
        return Warmth.WARMING if self._loading(scene) else Warmth.QUEUED

    def answer(self, scene: str) -> LookaheadAnswer:
        """What its trainer is told."""
        warmth = self.warmth(scene)
        eta_s = 0.0
        if warmth is Warmth.WARMING:
            eta_s = min(self._left_s(holder, scene) for holder in self._loading(scene))
        return LookaheadAnswer(scene, warmth, eta_s, self._unplaceable.get(scene, ""))

    def grid(self, windows: Mapping[str, LookaheadWindow]) -> list[PlanCell]:
        """What the runs announced: by run, step and scene."""
        cells: dict[tuple[str, int, str], int] = {}
        for run_id, window in windows.items():
            for entry in window.entries:
                key = (run_id, entry.step, entry.bundle_digest)
                cells[key] = cells.get(key, 0) + entry.count
        return [
            PlanCell(*key, count, self.warmth(key[2]), tuple(sorted(self._holders.standing_on(key[2]))))
            for key, count in sorted(cells.items())
        ]

    def _loading(self, scene: str) -> list[SchedulerWorker]:
        """Those that were told to load it."""
        told: Iterable[SchedulerWorker] = (
            self._holders.by_id[name] for name in self._holders.standing_on(scene)
        )
        return [holder for holder in told if scene in (holder.desired or ())]

    def _left_s(self, holder: SchedulerWorker, scene: str) -> float:
        """A worker loads as many scenes at a time as it has slots, in the order in which it was told of them."""
        load_s = self._usual_load_s(scene)
        since_s = holder.loading_since_s.get(scene)
        if since_s is not None:
            return max(0.0, load_s - (self._now_s - since_s))
        ahead = holder.to_load(holder.desired or ()).index(scene)
        return load_s * (1 + ahead // holder.slots)


def why_not(holders: Holders, scene: str, size_mb: float, *, renders: bool) -> str:
    """Why no worker takes the scene, in words."""
    failing = (holders.by_id[name].failed_words for name in sorted(holders.failing))
    errors = [words[scene] for words in failing if scene in words]
    if errors:
        return f"scene {scene} fails to load: {next(filter(None, errors), 'no reason given')}"
    if renders and not any(holder.renders for holder in holders.by_id.values()):
        return f"scene {scene} needs slots that render on a GPU, and no worker has any"
    return (
        f"scene {scene} needs {size_mb:.0f} MB and the largest worker gives {holders.most_memory_mb} MB: "
        f"raise a worker's memory limit"
    )
