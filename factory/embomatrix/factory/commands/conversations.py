"""``embomatrix factory conversations``: solved episodes as chats, for supervised tuning of language models."""

from pathlib import Path
from typing import Annotated

import typer

from embomatrix.envs.rules import Visibility
from embomatrix.factory.commands.options import Jobs, PlacesLearnedFrom, processes
from embomatrix.factory.commands.terminal import counter, fail, say, user_errors
from embomatrix.factory.evaluate.conversations import ConversationForm, conversation_schema, conversations
from embomatrix.factory.pipeline.export import SUFFIXES, encode_rows
from embomatrix.host.own_files import Force, prepare_output
from embomatrix.skills.prompt import Codec
from embomatrix.starter.options import DEFAULT_DATASET, DatasetOrName
from embomatrix.starter.shipped import open_dataset
from embomatrix.world.dataset import SPLITS
from embomatrix.world.whole_file import write_whole

FORMS = (Codec.LINES, Codec.JSON)
"""Codecs of language models."""


def conversations_(
    out: Annotated[Path, typer.Option(help="File to write, .jsonl or .parquet.")],
    dataset: DatasetOrName = DEFAULT_DATASET,
    training: PlacesLearnedFrom = None,
    split: Annotated[str, typer.Option(help="train or heldout.")] = "train",
    visibility: Annotated[
        Visibility, typer.Option(help="full: the whole table of the task. seen: what the robot has seen.")
    ] = Visibility.SEEN,
    codec: Annotated[Codec, typer.Option(help="Form of calls: lines or json.")] = Codec.LINES,
    jobs: Jobs = None,
    force: Force = False,
) -> None:
    """Play episodes with the searching oracle and write those that it solves as chats, one per task.

    A row has `messages`: system text, task, and then calls and observations in turns. The last answer is `done`.
    """
    if split not in SPLITS:
        fail(f"unknown split {split!r}: expected {' or '.join(SPLITS)}")
    if codec not in FORMS:
        fail(f"the codec `{codec}` is for word-level policies: expected {' or '.join(FORMS)}")
    if out.suffix not in SUFFIXES:
        fail(f"the suffix of {out} is {out.suffix!r}: expected {' or '.join(SUFFIXES)}")
    if out.exists() and not force:
        fail(f"{out} exists already: name another file with --out, or pass --force to replace it")
    prepare_output("factory conversations", out)
    with user_errors(out):
        encode_rows([], out.suffix, conversation_schema)  # pyarrow is missing now, or not at all
        found = open_dataset(dataset)
        learned = found if training is None else open_dataset(training)
        records = [record for record in found.records if record.split == split]
        with counter("tasks", len(records)) as count:
            form = ConversationForm(visibility, codec)
            rows = conversations(found, records, form, learned, jobs=processes(jobs), progress=count)
        write_whole(out, encode_rows(rows, out.suffix, conversation_schema))
    answers = sum(len(row["messages"]) // 2 for row in rows)
    say(f"{len(rows)} of {len(records)} tasks as conversations with {answers} answers: {out}")
