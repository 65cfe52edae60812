"""``embomatrix play``: execute a plan in a task and explain every step and the reward.

The plan is a person's, the oracle's or a trained policy's.
"""

import contextlib
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

import typer
from rich.console import Console
from rich.markup import escape as without_markup
from rich.table import Table

from embomatrix.cli.plan_text import doubtful_angles, plan_with_names, rows_for_names
from embomatrix.cli.play_by_hand import explore_by_hand, play_by_hand
from embomatrix.envs.episode import Episode
from embomatrix.envs.opening import make
from embomatrix.envs.rules import EpisodeRules, Visibility
from embomatrix.factory.commands.terminal import counter, fail, user_errors
from embomatrix.host.own_files import prepare_output
from embomatrix.host.printable import printable
from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.reward.hierarchy import score, unparsable
from embomatrix.scripts.similarity import TermIndex, words_in
from embomatrix.sim.film import Film, film_cached
from embomatrix.sim.physical.actor import PhysicalActor
from embomatrix.sim.physical.film import film_physical
from embomatrix.sim.planner.oracle import PlanNotFound, find_plan
from embomatrix.sim.simulation import load_simulator
from embomatrix.sim.state.facts import FactError
from embomatrix.skills.describe import call_in_words
from embomatrix.skills.parse import PlanError, plan_to_lines, prose_lines
from embomatrix.skills.prompt import Codec, Situation, limited, prompt_for, situation_of
from embomatrix.skills.syntax import MAX_PLAN_BYTES, MAX_STEPS, Plan
from embomatrix.skills.trace import Trace
from embomatrix.starter.options import DatasetOrShipped
from embomatrix.starter.shipped import open_dataset
from embomatrix.world.bundle import Bundle
from embomatrix.world.dataset import Dataset, TaskRecord
from embomatrix.world.evaluate import GoalError
from embomatrix.world.task import Task

NO_PLAN: Final = 1

if TYPE_CHECKING:
    from embomatrix.trainer.config.settings import TrainSettings
    from embomatrix.trainer.policy.protocol import Policy

console = Console(highlight=False)


def escape(text: str) -> str:
    """Return text of a dataset or plan without markup and control characters."""
    return without_markup(printable(text))


class PlayMode(StrEnum):
    """Execution mode of a plan."""

    CACHED = "cached"
    PHYSICAL = "physical"


class LoadedPolicy(NamedTuple):
    """Trained policy, and the settings of its training."""

    policy: "Policy"
    settings: "TrainSettings"

    @property
    def plays_episodes(self) -> bool:
        """True if the policy was trained in episodes."""
        from embomatrix.trainer.policy.playing import plays_episodes

        return plays_episodes(self.policy)


def play(
    task: Annotated[
        str,
        typer.Argument(
            help="Id of a task, or words: the task whose instruction is most like them is played."
        ),
    ],
    plan: Annotated[
        str,
        typer.Option(
            "--plan",
            help="File with a plan, as JSON or one call per line, with rows or names of objects; '-' reads standard "
            "input.",
        ),
    ] = "",
    oracle: Annotated[bool, typer.Option("--oracle", help="Execute the oracle planner's plan.")] = False,
    policy: Annotated[
        str | None,
        typer.Option(
            help="Execute the plan of a trained policy: the folder of a run, such as runs/demo, or `shipped`. A policy "
            "for episodes plays one."
        ),
    ] = None,
    show: Annotated[
        bool,
        typer.Option(
            "--show", help="Print the object table and the prompt that a model gets; execute nothing."
        ),
    ] = False,
    interactive: Annotated[
        bool, typer.Option("--interactive", help="Play by hand: type one call a line, and see what it does.")
    ] = False,
    visibility: Annotated[
        Visibility,
        typer.Option(
            help="With --interactive. full: the whole table of the task. seen: only what the robot has seen."
        ),
    ] = Visibility.FULL,
    dataset: DatasetOrShipped = None,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the execution.")] = 0,
    mode: Annotated[
        PlayMode,
        typer.Option(help="cached: pre-verified outcomes; physical: a robot in stepped physics."),
    ] = PlayMode.CACHED,
    film: Annotated[
        Path | None, typer.Option(help="File for an animation of the plan: .gif, .webp, .png or .mp4.")
    ] = None,
) -> None:
    """Execute a plan in a task and print every step, the final state and the reward.

    Exit status: 0 if the plan was executed, 1 if the text is not a plan, 2 for other bad input.
    """
    with user_errors(film, more=(FactError, GoalError)):
        if film is not None:
            _check_film(film)
        if sum((bool(plan), oracle, policy is not None, show, interactive)) != 1:
            fail(
                "expected one of --plan FILE, --oracle, --policy FOLDER, --interactive and --show: give one of them"
            )
        if visibility is Visibility.SEEN and not interactive:
            fail("--visibility seen is for --interactive: a plan is written before anything is seen")
        data = open_dataset(dataset)
        record = _record_of(data, task)
        bundle = data.bundle(record.bundle_digest)
        text = _text_of(plan) if plan else None
        if visibility is Visibility.SEEN:
            _explore_by_hand(data.folder, record, seed)
            return
        trained = _load_policy(policy) if policy is not None else None
        if trained is not None and trained.plays_episodes:
            if film is not None or mode is PlayMode.PHYSICAL:
                fail(f"{policy} plays episodes and writes no plans: leave out --film and --mode")
            _watch(trained, data.folder, record, seed)
            return
        _show_task(record.task)
        if show:
            _show_prompt(bundle, record.task)
        elif interactive:
            _show_prompt(bundle, record.task)
            _play_by_hand(bundle, record.task, seed)
        else:
            found = _plan_of(bundle, record.task, text, trained, seed)
            _run(bundle, record.task, found, mode, seed, film)


def _record_of(data: Dataset, named: str) -> TaskRecord:
    """Return the task with an id, or the one whose instruction is most like some words. Raise DatasetError."""
    if len(named.split()) < 2 or not data.records:
        return data.find(named)
    index = TermIndex([words_in(record.task.instruction) for record in data.records])
    record = data.records[index.ranked(words_in(named))[0]]
    console.print(f"the task most like these words, of {len(data.records)}:", style="dim")
    return record


def _plan_of(bundle: Bundle, task: Task, text: str | None, policy: LoadedPolicy | None, seed: int) -> Plan:
    """Parse the text, or ask the policy, or else the oracle. Exit if there is no plan."""
    if text is None and policy is None:
        found = find_plan(load_simulator(bundle), task)
        if isinstance(found, PlanNotFound):
            fail(f"the oracle finds no plan for {task.task_id!r}: {found.reason}")
        return found
    try:
        if policy is not None:
            return _plan_of_policy(policy, situation_of(bundle.scene, task), seed)
        return _plan_of_person(text or "", task)
    except PlanError as error:
        console.print(f"[red]✗[/red] the text can't be parsed ({error.reason.value}): {escape(str(error))}")
        _show_reward(unparsable())
        raise typer.Exit(NO_PLAN) from None


def _plan_of_person(text: str, task: Task) -> Plan:
    """Parse a text. Print lines that are no calls, doubtful angles, and whether names were read. Raises PlanError."""
    for line in prose_lines(rows_for_names(text, task.table), task.profile)[:MAX_STEPS]:
        console.print(f"[yellow]![/yellow] not a call, and passed over: {escape(line)}")
    plan = plan_with_names(text, task)
    for doubt in doubtful_angles(plan):
        console.print(f"[yellow]![/yellow] {escape(doubt)}")
    if rows_for_names(text, task.table) != text:
        console.print("names of objects were read as rows; the cluster reads rows only\n", style="dim")
    return plan


def _explore_by_hand(folder: Path, record: TaskRecord, seed: int) -> None:
    """Play an episode that shows only what the robot has seen."""
    rules = EpisodeRules(Visibility.SEEN)
    with make(folder, split=record.split, rules=rules) as environment:
        reward = explore_by_hand(environment, record.task.task_id, seed, _read_line, _show_lines)
    if reward is not None:
        _show_reward(reward.tiers)


def _read_line() -> str | None:
    try:
        return console.input("> ")
    except EOFError:
        return None


def _show_lines(text: str) -> None:
    for line in text.splitlines():
        console.print(escape(line))


def _play_by_hand(bundle: Bundle, task: Task, seed: int) -> None:
    """Let a person play the task call by call, and print the reward at the end."""

    with contextlib.closing(load_simulator(bundle)) as simulator:
        episode = Episode(simulator, task, situation_of(bundle.scene, task))
        episode.reset(seed)
        reward, calls = play_by_hand(episode, _read_line, _show_lines, seed)
    if reward is not None:
        _show_reward(reward)
    if calls:
        console.print("\n[bold]Plan[/bold] of the calls that succeeded, for --plan FILE")
        console.print(plan_to_lines(calls), markup=False)


def _load_policy(named: str) -> LoadedPolicy:
    """Load a trained policy. Exit with a message if there is none."""
    from embomatrix.trainer.config.errors import TrainerError
    from embomatrix.trainer.evaluation.models import load_model

    try:
        return LoadedPolicy(*load_model(named, None, threads=None, device="cpu"))
    except TrainerError as error:
        fail(str(error))


def _plan_of_policy(loaded: LoadedPolicy, situation: Situation, seed: int) -> Plan:
    """Return the most probable plan of a trained policy. Raises PlanError if it writes none."""
    import torch

    from embomatrix.trainer.cluster.gateway import parse_policy_text
    from embomatrix.trainer.config.errors import TrainerError
    from embomatrix.trainer.policy.limits import TokenCounter, room_for

    policy, settings = loaded.policy, loaded.settings
    try:
        asked = limited(situation, settings.prompt.rows)
        prompt = prompt_for(asked, policy.codec)
        max_new = room_for(
            settings.grpo.max_new, {situation.instruction: prompt}, TokenCounter.of_policy(policy)
        )
    except TrainerError as error:
        fail(str(error))
    drawn = policy.sample([policy.encode(prompt)], 1, 0.0, max_new, torch.Generator().manual_seed(seed))
    return parse_policy_text(drawn.texts[0], asked, policy.codec)


def _watch(loaded: LoadedPolicy, folder: Path, record: TaskRecord, seed: int) -> None:
    """Let a policy that was trained in episodes play one, and print all that it says and is told."""
    from embomatrix.cli.play_by_policy import play_by_policy
    from embomatrix.skills.parse import plan_from_json
    from embomatrix.trainer.episodes.terms import EpisodeTerms

    terms = EpisodeTerms.of(loaded.settings.episodes)
    oracle = plan_from_json([*record.oracle], record.task.profile) if record.oracle else ()
    rules = EpisodeRules() if terms is None else terms.rules(oracle)
    longest = loaded.settings.episodes.answer_tokens
    with make(folder, split=record.split, rules=rules, codec=loaded.policy.codec) as environment:
        reward = play_by_policy(
            environment, loaded.policy, record.task.task_id, seed, _show_lines, longest=longest
        )
    if reward is not None:
        _show_reward(reward.tiers)


def _show_prompt(bundle: Bundle, task: Task) -> None:
    """Print the object table, and the prompt for plans of one call per line."""
    table = Table("row", "object", "category", "room", title="Object table", title_justify="left")
    for row, name in enumerate(task.table):
        item = bundle.scene.by_name[name]
        table.add_row(
            str(row), escape(name), escape(bundle.scene.assets[item.asset_id].category), escape(item.room)
        )
    console.print(table)
    prompt = prompt_for(situation_of(bundle.scene, task), Codec.LINES)
    console.print("\n[bold]Prompt[/bold]")
    console.print(printable(f"{prompt.system}\n\n{prompt.user}", lines=True), markup=False, soft_wrap=True)


def _text_of(plan: str) -> str:
    """Read the text of a plan, at most one byte more than a plan may have."""
    try:
        if plan == "-":
            if sys.stdin is None:
                fail("standard input is closed: expected --plan FILE")
            raw = sys.stdin.buffer.read(MAX_PLAN_BYTES + 1)
        else:
            with Path(plan).open("rb") as file:
                raw = file.read(MAX_PLAN_BYTES + 1)
    except OSError as error:
        fail(f"the plan {plan!r} can't be read ({error.strerror}): expected a text file")
    # The parser judges the text, so invalid bytes are replaced here and not refused.
    return raw.decode("utf-8", errors="replace")


def _run(bundle: Bundle, task: Task, plan: Plan, mode: PlayMode, seed: int, film: Path | None) -> None:
    actor = PhysicalActor(bundle) if mode is PlayMode.PHYSICAL else None
    simulator = load_simulator(bundle, actor=actor)
    trace = simulator.execute(task, plan, seed)
    _show_steps(task, trace)
    console.print("\n[bold]Final state[/bold]")
    for line in trace.final:
        console.print(f"  {escape(line)}")
    _show_reward(score(task, trace.touched, simulator.facts))
    if film is None:
        return
    if actor is None:
        _draw(film_cached(simulator, task, plan, seed), film)
    else:
        _draw(film_physical(simulator, actor, task, plan, seed), film)


def _check_film(path: Path) -> None:
    """Refuse a file that can't be written before anything is executed: drawing takes minutes."""
    from embomatrix.factory.pictures.film import FilmError, check_suffix

    try:
        check_suffix(path)
    except FilmError as error:
        fail(str(error))
    prepare_output("play", path)


def _draw(film: Film, path: Path) -> None:
    """Draw the film with a progress bar and write it."""
    # Only films need Pillow, so playing works without it.
    from embomatrix.factory.pictures.film import Caption, draw_film, write_film

    done = [step.ok for step in film.steps]
    captions = [
        Caption(call_in_words(call, film.task.table), done[number] if number < len(done) else None)
        for number, call in enumerate(film.plan)
    ]
    with counter("drawing", len(film.frames)) as count:
        pictures = draw_film(film, captions, on_frame=lambda drawn, _: count(drawn))
    write_film(path, pictures)
    console.print(f"\nfilm of {len(pictures)} frames: {path}", markup=False)


def _show_task(task: Task) -> None:
    console.print(f"[bold]{escape(task.task_id)}[/bold]  {task.category.words} in {escape(task.scene_id)}")
    console.print(f"  {escape(task.instruction)}")
    console.print(f"  [dim]{escape(task.goal_bddl)}[/dim]\n")


def _show_steps(task: Task, trace: Trace) -> None:
    table = Table(box=None, show_header=False, padding=(0, 1))
    table.add_column(justify="right", style="dim")
    table.add_column()
    table.add_column()
    table.add_column(overflow="fold")
    for number, call in enumerate(trace.plan, start=1):
        words = escape(call_in_words(call, task.table))
        if number > len(trace.steps):
            table.add_row(str(number), "[dim]·[/dim]", f"[dim]{words}[/dim]", "[dim]not executed[/dim]")
            continue
        step = trace.steps[number - 1]
        if step.failure is None:
            table.add_row(str(number), "[green]✓[/green]", words, escape(step.message))
        else:
            reason = f"[red]{step.failure.value}[/red]: {escape(step.message)}"
            table.add_row(str(number), "[red]✗[/red]", words, reason)
    console.print(table)


def _show_reward(reward: RewardBreakdown) -> None:
    table = Table(title="Reward", title_justify="left", title_style="bold", show_footer=True)
    table.add_column("tier", footer="total")
    table.add_column("reason", overflow="fold", footer=_verdict(reward))
    table.add_column("points", justify="right", footer=f"{reward.total:.2f}")
    if reward.format < 0:
        table.add_row("format", "the text is not a plan and was not executed", f"{reward.format:.2f}")
    else:
        _add_tiers(table, reward)
    console.print()
    console.print(table)


def _add_tiers(table: Table, reward: RewardBreakdown) -> None:
    holding = sum(atom.holds for atom in reward.atoms)
    table.add_row("format", "the text is a plan", f"{reward.format:.2f}")
    table.add_row("relevance", "goal objects on which a call succeeded", f"{reward.relevance:.2f}")
    table.add_row("goal", f"{holding} of {len(reward.atoms)} atoms hold", f"{reward.goal:.2f}")
    for atom in reward.atoms:
        mark = "[green]✓[/green]" if atom.holds else "[red]✗[/red]"
        points = reward.goal / holding if atom.holds else 0.0
        table.add_row("", f"{mark} {escape(atom.text)}", f"[dim]{points:.2f}[/dim]")


def _verdict(reward: RewardBreakdown) -> str:
    return "[green]success[/green]" if reward.success else "[red]the goal is not reached[/red]"
