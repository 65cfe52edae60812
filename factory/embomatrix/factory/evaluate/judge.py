"""The paper's judge of diversity: a language model that scores the commands of one scene. Its scale is the model's own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from pydantic import BaseModel, ConfigDict, Field

from embomatrix.llm.structured import ask
from embomatrix.llm.values import ChatRequest, Message, Speaker

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.llm.values import ChatModel

JUDGE: Final = "diversity judge"
PROMPT: Final = """\
Please analyze the diversity of the following generated commands and provide a score out of 10 based on the following criteria:

1. Variety: Do the commands include a diverse range of actions, objects, and scenarios? Do the commands cover different types \
of actions (e.g., picking up, placing, toggling) and involve various objects and locations? However the robot can only take \
concrete actions, such as pick up, move, toggle, place and so on, so don't be too strict about the action diversity.

2. Inclusion of Specific Characters: Do the commands explicitly mention specific individuals (their name or roles)? The \
characters number is limited to 2-4. Are the commands tailored to these characters, and do they reflect their unique roles or \
characteristics? If the commands don't include specific characters, please give a low score.

You need to be careful, just focus on the given criteria. After analyzing the commands, give your section scores and an \
overall score, provide a detailed explanation for the score.

Here are the commands: {commands}

Answer with JSON: variety, characters, overall (numbers from 0 to 10), explanation."""
"""As printed in the paper's appendix, with the form of the answer added. Commands are data and stand last."""


class DiversityScores(BaseModel):
    """Scores of 0 to 10."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    variety: float = Field(ge=0, le=10)
    characters: float = Field(ge=0, le=10)
    overall: float = Field(ge=0, le=10)
    explanation: str = Field(min_length=1)


async def judged(model: ChatModel, commands: Sequence[str], seed: int, attempts: int = 3) -> DiversityScores:
    """What the model thinks of one scene's commands. Raises LlmError."""
    listed = "\n".join(f"{number}. {command}" for number, command in enumerate(commands, start=1))
    request = ChatRequest(
        JUDGE, (Message(Speaker.USER, PROMPT.format(commands=f"\n{listed}\n")),), temperature=0.0, seed=seed
    )
    return (await ask(model, request, DiversityScores, attempts=attempts)).value
