"""``embomatrix factory corpus``: the corpus in the parts that ship with the package and those that are built."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.build import make_dataset
from embomatrix.factory.commands.difficulty import script_results
from embomatrix.factory.commands.options import Jobs
from embomatrix.factory.commands.terminal import fail, say, user_errors
from embomatrix.factory.days.maker import DAYS, days_with_proofs
from embomatrix.factory.evaluate.difficulty import with_scripts
from embomatrix.factory.pipeline.build import Making
from embomatrix.factory.pipeline.corpus import (
    TASKS,
    check_free,
    freeze_hardest,
    holds_build_of,
    is_finished,
    join_parts,
    joined_part,
    part_folder,
    settings_of,
)
from embomatrix.factory.pipeline.store import BUILD_FILE
from embomatrix.host.own_files import Force, keep_foreign, prepare_output
from embomatrix.starter.archive import content_digest, pack, read_packed
from embomatrix.starter.recipes import PARTS
from embomatrix.starter.shipped import FROZEN_MARK, archive_of, holds_shipped, shipped_parts, unpack_part
from embomatrix.world.dataset import TASKS_FILE, Dataset, DatasetError, write_dataset


def corpus(
    out: Annotated[Path, typer.Option(help="Folder for the corpus.")] = Path("build/corpus"),
    part: Annotated[
        list[int] | None,
        typer.Option(help="Part to make, beside those that ship. Repeat the option for more. Default: all."),
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Build parts that ship again, resumably, and compare their digests with those of the shipped ones.",
        ),
    ] = False,
    packed: Annotated[
        Path | None,
        typer.Option(help="Build the parts, resumably, and pack each into a file of this folder."),
    ] = None,
    proofs: Annotated[
        Path | None,
        typer.Option(
            help="Build with the same settings, as a folder or packed, whose tasks are proved already: tasks that differ from "
            "them only in words are not proved again, and keep their poses and plans."
        ),
    ] = None,
    frozen: Annotated[
        Path | None,
        typer.Option(
            "--freeze", help="Write the ids of the hardest held-out tasks to this file: Internal-Verified 2."
        ),
    ] = None,
    count: Annotated[int, typer.Option(min=1, help="Number of tasks to freeze.")] = 100,
    jobs: Jobs = None,
    force: Force = False,
) -> None:
    """Unpack the parts of the corpus that ship, build the others, resumably, and join them.

    A part of 380 tasks takes about an hour on two cores.
    """
    if check and (packed or proofs or frozen):
        fail("--check compares builds from scratch: leave --packed, --proofs and --freeze out")
    shipped = shipped_parts()
    chosen = tuple(sorted(set(part or (shipped if check else PARTS))))
    _check_parts(chosen, shipped, check=check)
    together = tuple(sorted({*chosen, *shipped}))
    if packed is not None:
        _check_held_out(together, [number for number in chosen if PARTS[number].train], "--packed")
        _check_absent([packed / f"tasks-{number}.xz" for number in chosen], "--packed", force=force)
    if frozen is not None:
        _check_held_out(together, chosen, "--freeze")
        keep_foreign("factory corpus", [frozen], FROZEN_MARK, force=force)
        prepare_output("factory corpus", frozen)
    making = DAYS if proofs is None else _with_proofs(proofs, chosen[0])  # all parts have one way of proof
    with user_errors(packed):
        if packed is not None:
            packed.mkdir(parents=True, exist_ok=True)
    with user_errors(out):
        check_free(out)
        built = [number for number in chosen if check or packed is not None or number not in shipped]
        for number in together:  # before the builds, which take hours
            if number not in built:
                _unpack(part_folder(out, number), number)
        for number in built:
            _build(part_folder(out, number), number, jobs, making)
        joined = join_parts(out, together)
        tasks = Dataset.load(out / TASKS)
        say(
            f"{len(tasks.records)} tasks in {tasks.folder}; {joined.dropped} left out as too like a held-out one"
        )
        if check:
            _compare(out, built)
            return
        missing = [record for record in tasks.records if record.difficulty is None]
        records = with_scripts(tasks.records, script_results(tasks, missing, tasks, jobs))
        write_dataset(tasks.folder, records, {})
        for number in built:
            found = joined_part(out, number)
            digest = content_digest(found) if packed is None else pack(found, packed / f"tasks-{number}.xz")
            say(f"part {number}: {len(found.records)} tasks, {digest}")
        if frozen is not None:
            say(f"Internal-Verified 2: {count} tasks, {freeze_hardest(records, count, frozen).digest}")


def _with_proofs(proofs: Path, number: int) -> Making:
    """Return the making of days with these proofs for a part. Exit if they can't be read, or if its settings differ."""
    try:
        return days_with_proofs(proofs, settings_of(PARTS[number]))
    except (DatasetError, OSError) as error:
        fail(f"name the folder of a build or a packed part with --proofs: {error}")


def _check_parts(chosen: Sequence[int], shipped: Sequence[int], *, check: bool) -> None:
    """Exit if a part is unknown, or if it is to be checked and does not ship."""
    for number in chosen:
        if number not in PARTS:
            fail(f"there is no part {number}: name one of {_listed(PARTS)} with --part")
        if check and number not in shipped:
            fail(
                f"part {number} does not ship, so there is nothing to compare it with: name one of {_listed(shipped)}"
            )


def _check_held_out(together: Sequence[int], needed_by: Sequence[int], option: str) -> None:
    """Exit if held-out parts are missing: what they hold out must not be in a part that trains, nor be left out."""
    missing = [number for number, recipe in PARTS.items() if recipe.heldout and number not in together]
    if missing and needed_by:
        fail(f"{option} needs all held-out tasks: add --part {' --part '.join(map(str, missing))}")


def _check_absent(files: Sequence[Path], option: str, *, force: bool) -> None:
    """Exit if one of the files exists and may not be replaced."""
    there = next((file for file in files if file.exists() and not force), None)
    if there is not None:
        fail(f"{there} exists: name another folder with {option}, or pass --force to replace it")


def _listed(numbers: Iterable[int]) -> str:
    return ", ".join(map(str, numbers))


def _build(folder: Path, number: int, jobs: int | None, making: Making) -> None:
    """Build a part, or resume its build. Raises DatasetError if the folder holds a dataset that no build wrote."""
    if (folder / TASKS_FILE).exists() and not (folder / BUILD_FILE).exists():
        raise DatasetError(f"{folder} holds a dataset that no build wrote: name another folder with --out")
    make_dataset(folder, settings_of(PARTS[number]), jobs=jobs, making=making)


def _unpack(folder: Path, number: int) -> None:
    """Unpack a part, unless the folder holds a finished build of it. Raises DatasetError if it holds another dataset.

    The part is unpacked beside the log of an interrupted build, which a later call with --check can still resume.
    """
    if is_finished(folder):
        if not holds_build_of(folder, archive_of(number)):
            raise DatasetError(
                f"{folder} holds a build that differs from part {number} as it ships: name another folder with --out, remove "
                f"this one to unpack the part, or add --part {number} to a call with --packed to use the build"
            )
        return
    if (folder / TASKS_FILE).exists() and not holds_shipped(folder, [number]):
        raise DatasetError(
            f"{folder} holds another dataset than part {number}: name another folder with --out"
        )
    unpack_part(folder, number)


def _compare(out: Path, numbers: Sequence[int]) -> None:
    """Print for each part whether the build gives the shipped one, and exit with status 2 if one differs."""
    different = []
    for number in numbers:
        found = joined_part(out, number)
        digest = content_digest(found)
        records, _, expected = read_packed(archive_of(number))
        if digest == expected:
            say(f"part {number}: {len(found.records)} tasks, {digest}, as shipped")
        else:
            different.append(number)
            say(
                f"part {number}: the recipe gives {len(found.records)} tasks with {digest}, and the shipped part has "
                f"{len(records)} with {expected}"
            )
    if different:
        fail(f"this version builds other tasks than the shipped part {_listed(different)}")
