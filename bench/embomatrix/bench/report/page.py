"""The page of benchmarks: tables that are written anew every time, and parts that people write, which are kept."""

from __future__ import annotations

import re
import textwrap
from typing import TYPE_CHECKING, Final

from embomatrix.bench.cluster.ablation_page import EXPLANATION, ablation_lines
from embomatrix.bench.peers.page import CONTEST, PREFIX, contest_lines
from embomatrix.bench.report.figures import BenchError, is_shared

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from typing import Any

    from embomatrix.bench.report.figures import BenchResult
    from embomatrix.pages.figures import Figure

HEAD: Final = "<!-- Written by `embomatrix bench all`: edit the parts between the marks `by hand` only, they are kept. -->"
WIDTH: Final = 128
END: Final = "<!-- end by hand -->"
_PART: Final = re.compile(r"<!-- by hand: ([a-z-]+) -->\n(.*?)<!-- end by hand -->", re.DOTALL)
_MARK: Final = re.compile(r"<!-- (?:by hand: [a-z-]+|end by hand) -->")

ENGINE_SCENES: Final = (
    "restaurant_diner, office_bike, Wainscott_0_garden, house_double_floor_upper, restaurant_cafeteria, "
    "office_cubicles_right, restaurant_hotel, restaurant_asian, school_geography, Benevolence_1_int, Wainscott_0_int, "
    "restaurant_brunch, house_single_floor, Rs_int, hotel_gym_spa"
)
"""Base scenes of the pinned workload: nine that come to about 300 bodies, and some of the other sizes."""
TITLES: Final[Mapping[str, tuple[str, str]]] = {
    "engine": (
        "Engine",
        "`embomatrix bench engine` on the dataset of `embomatrix factory build --out=build/engine --seed=7 --train=120 "
        f"--heldout=0` with `--scene` for each of {ENGINE_SCENES}: "
        "10 calls a plan with two places, a door and five moves, all plans different, each executed once, in furnished "
        "scenes that have waited, as announced ones do, and have made their bodies meanwhile; "
        "the plans are pinned in `bench/embomatrix/bench/data/engine_workload.json`. Durations are CPU time of "
        "one thread, but for *slot_respawn_ms*, which is on the clock: from the order to kill a slot to the next one's "
        "first answer. *cold_load_ms* is from the bundle's bytes to a scene that executed an empty plan, in a fresh fork "
        "of the worker's root. *rollouts_per_s* is executed and scored in a slot, with all that goes over its stream. "
        "*private_mb_per_slot* is what a slot that waits holds for itself after fifty rollouts. A rollout checks every "
        "precondition, every placed thing for penetration, relations and the reward. Names without a size are for scenes "
        "of about 300 bodies. What bounds the time of a rollout and the memory of a slot, and what was tried, is told in "
        "decisions [0023](decisions/0023-python-and-bullet-calls-bound-a-rollout-the.md) "
        "and [0015](decisions/0015-slots-share-the-resident-s-pages-bundles-are.md).",
    ),
    "fidelity": (
        "Fidelity of the two modes",
        "`embomatrix bench fidelity --dataset=build/scenes --json FILE` on the dataset of `embomatrix factory build "
        "--out=build/scenes --scenes=all --train=208 --heldout=0`: the same plans in cached and in physical mode, counted as "
        "[decision 0010](decisions/0010-fidelity-counts-steps-reasons-and-final.md) says. "
        "*physical_plan_300_s* is processor time of a plan in "
        "scenes of about 300 bodies; *speed-up* is that of calls which succeed in both modes.",
    ),
    "rollout": (
        "One process",
        "`embomatrix bench rollout`: oracle plans of the dataset, executed and scored in one simulator, without a cluster. "
        "A worker builds scenes in clients that are connected before. *First* is a scene's first rollout, *cold* is decoding, "
        "loading and the first rollout together.",
    ),
    "cluster": (
        "Cluster on loopback",
        "`embomatrix bench cluster`: a manager and workers as processes of this machine, driven as a trainer drives them: "
        "steps of one group of eight for each slot. *Cold* scenes are new and unannounced, *prewarmed* ones were announced "
        "and loaded before their batches came, *repeated* ones were executed in before. *Steady* is one large group for each "
        "slot, *alone* one rollout with nothing else under way. Latency is from submission to result, so it includes waiting "
        "for the group's other rollouts. Overhead is the share of the slots' time in which they executed nothing. The manager "
        "holds every bundle before the clock starts. *rollouts_per_s* and *overhead_ratio* are of the ablation's last row, a "
        "worker with two slots: the ratio is the processor time of manager, worker beside its slots and trainer, over all. "
        "*prewarm_hit_rate*, *prewarm_waste* and *start_latency_ratio* are of steps of two scenes with loading slowed by 2 s, "
        "two steps announced ahead and 2.5 s of generation a step; a scene starts when its first rollout begins, and the ratio "
        "is to scenes that come unannounced. `--part` measures one part alone; `bench page` puts files of parts together.",
    ),
    "trainer": (
        "Trainer",
        "`embomatrix bench trainer --trl PYTHON`: a step of GRPO on one thread, of a random Llama of four layers of 256 over "
        "some hundred words, 4 prompts of the dataset × 8 plans of up to 48 tokens, learnt from at once, no KL, the reward at "
        "hand: the median of five steps' processor seconds, of ours and of TRL's GRPOTrainer one after the other. "
        "*sim_wait_share* and *overhead_ratio* are of 30 steps of the word-level policy with default settings, after 120 steps "
        "of imitation and 40 of GRPO, on a cluster of two workers on the same cores: the shares of the steps' time in which "
        "the trainer waited for simulation, and in which it neither sampled nor learnt; *first_steps_wait_share* is of the "
        "first 15 of those 40, while scenes are loaded for the first time. *eval_s* is from the command's start to its end, "
        "random plans for 100 tasks.",
    ),
    "operations": (
        "Operations",
        "`embomatrix bench operations --json FILE`, in a checkout on a machine with Docker and Chromium. "
        "*compose_first_rollout_s* is from `docker compose up`, with images that are built and volumes that are new, to the "
        "first result. Images are counted with their base. *join_s* is from `embomatrix worker run --join` to the worker's "
        "registration, by TLS, with a credential of its own. *dashboard_cpu_share* is what ten viewers of 1,000 workers add "
        "to the manager's processor time, of one core; *dashboard_paint_s* the median of five, from the address to the rows "
        "of workers, nothing cached.",
    ),
}
"""Heading and explanation of each bench, in the order of the page."""
INTRODUCTION: Final = (
    "`embomatrix bench all --dataset DIR --out docs/benchmarks.md` measures and writes this page; `embomatrix bench page "
    "FILE...` writes it of figures that were measured before. Ratios compare numbers of "
    "one run on one machine. Goals are for one core and scenes of up to 300 bodies; they come from what the physics engine "
    "needs at the least."
)
HAND_PARTS: Final = (("training", "Training runs"),)
"""Name and heading of the parts that people write."""


def render_page(results: Sequence[BenchResult], before: str) -> str:
    """The page in Markdown. ``before`` is the page that it replaces, empty when there is none. Raises BenchError."""
    parts = hand_parts(before)
    lines = [HEAD, "# Benchmarks", "", _paragraph(INTRODUCTION), "", *_machine_lines(results)]
    for result in sorted(results, key=lambda result: [*TITLES].index(result.bench)):
        heading, explanation = TITLES[result.bench]
        lines += ["", f"## {heading}", "", _paragraph(explanation), ""]
        if result.commit != results[0].commit:
            load = f"on {result.machine['cores']} cores with a load of {result.machine['load_before']} before"
            lines += [_paragraph(f"Measured at commit `{result.commit}`, {load}."), ""]
        for subheading, words, rows in _subparts(result):
            lines += [f"### {subheading}", "", _paragraph(words), "", *rows, ""]
        # What the contest's own table shows is not told twice.
        lines += _table([figure for figure in result.figures if not figure.name.startswith(PREFIX)])
    headings = dict(HAND_PARTS)
    for name in dict.fromkeys([*headings, *parts]):
        lines += [""] + ([f"## {headings[name]}", ""] if name in headings else [])
        lines += [f"<!-- by hand: {name} -->\n{parts.get(name, '')}{END}"]
    return "\n".join(lines) + "\n"


def _subparts(result: BenchResult) -> Iterator[tuple[str, str, list[str]]]:
    """Heading, explanation and table of what has a table of its own form, before the bench's own table."""
    ablation = ablation_lines(result.figures)
    if ablation:
        yield "The paper's ablation", EXPLANATION, ablation
    contest = contest_lines(result.figures)
    if contest:
        yield "Against what one would pick instead", CONTEST, contest


def hand_parts(page: str) -> dict[str, str]:
    """What people wrote on a page, by the name of the part; an empty page has none.

    Raises BenchError when it is another page, or its marks don't pair: replacing it would lose text.
    """
    if page.strip() and not page.startswith(HEAD):
        raise BenchError(
            "the page to replace was not written by this command: name another file with --out, or move it away"
        )
    found = _PART.findall(page)
    parts = dict(found)
    marks = len(_MARK.findall(page))
    if len(parts) * 2 != marks:
        raise BenchError(
            f"the page to replace has {marks} marks 'by hand' that make {len(parts)} parts: expected '<!-- by hand: NAME -->' "
            f"and '{END}' in turn, each name once; mend them, so that nothing is lost"
        )
    return parts


def _machine_lines(results: Sequence[BenchResult]) -> list[str]:
    first = results[0]
    machine: Mapping[str, Any] = first.machine
    lines = ["| machine | |", "| --- | --- |", f"| commit | `{first.commit}` |"]
    lines += [
        f"| {name.replace('_', ' ')} | {_cell(value)} |" for name, value in machine.items() if value != ""
    ]
    busiest = max((result.machine for result in results), key=lambda machine: float(machine["load_before"]))
    if is_shared(busiest):
        lines += [
            "",
            _paragraph(
                f"The machine was shared: a load of {busiest['load_before']} on {busiest['cores']} cores before a bench "
                "began. Alone it is faster; ratios suffer less than times."
            ),
        ]
    return lines


def _table(figures: Sequence[Figure]) -> list[str]:
    lines = ["| figure | value | goal | | n |", "| --- | ---: | ---: | --- | ---: |"]
    for figure in figures:
        lines.append(
            f"| {_cell(figure.name)} | {figure.told} {figure.unit} | {figure.bound} | {figure.verdict} | {figure.n:,} |"
        )
    short = [figure.name for figure in figures if figure.verdict not in ("", "reached")]
    goals = sum(figure.goal is not None for figure in figures)
    told = f"Short of their goals: {'; '.join(short)}." if short else "Every goal is reached."
    return [*lines, "", _paragraph(told)] if goals else lines


def _paragraph(text: str) -> str:
    return textwrap.fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)


def _cell(value: object) -> str:
    return str(value).replace("|", "\\|")
