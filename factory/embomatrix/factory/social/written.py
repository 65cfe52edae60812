"""Written request: an instruction and its wish, before a scene is laid out for them."""

from pydantic import Field

from embomatrix.factory.social.values import ROBOT, Cast, Conversation, DaySlot, StrictModel
from embomatrix.factory.social.wish import Condition, Quantity, Wish


class WrittenRequest(StrictModel):
    """Instruction with the wish that it states, and the conversation that led to it."""

    instruction: str = Field(min_length=1)
    wish: Wish
    cast: Cast
    conversation: Conversation

    @property
    def slot(self) -> DaySlot:
        """Time, room and person of the request."""
        return self.conversation.slot

    @property
    def signature(self) -> str:
        """Kind of goal: the conditions over kinds of objects, sorted."""
        return signature_of(self.wish)

    def transcript(self) -> str:
        """Return the conversation, its people and the conditions as Markdown."""
        people = "\n".join(
            f"* **{person.name}**, {person.age}, {person.job}, likes {person.hobby}"
            + "".join(f"; {tie} of {other}" for other, tie in person.ties.items())
            for person in self.cast.people
        )
        talk = "\n\n".join(
            f"**{'Robot' if turn.speaker == ROBOT else turn.speaker}** ({turn.act.value}): {turn.text}"
            for turn in self.conversation.turns
        )
        signs = "\n".join(f"* {_sign(condition, self.wish)}" for condition in self.wish.conditions)
        setting = f"{self.cast.setting[:1].upper()}{self.cast.setting[1:]}"
        return (
            f"# {self.instruction}\n\n## The people\n\n{setting}.\n\n{people}\n\n"
            f"## {self.slot.time}, {self.slot.room}: {self.slot.person} is {self.slot.activity}\n\n{talk}\n\n"
            f"## What is to be true\n\n{signs}\n"
        )


def signature_of(wish: Wish) -> str:
    """Return the conditions of a wish over kinds of objects, sorted."""
    return " ".join(sorted(_sign(condition, wish) for condition in wish.conditions))


def _sign(condition: Condition, wish: Wish) -> str:
    groups = wish.groups
    kinds = ",".join(groups[label].kind for label in (condition.things, condition.place) if label)
    sign = f"{condition.predicate.value}({kinds})"
    if groups[condition.things].count > 1:
        quantity = condition.quantity
        number = f" {condition.count}" if quantity is Quantity.EXACTLY else ""
        sign = f"{quantity.value}{number} {sign}"
    if not condition.holds:
        sign = f"not {sign}"
    if condition.otherwise is not None:
        sign = f"{sign} or {_sign(condition.otherwise, wish)}"
    if condition.provided is not None:
        sign = f"if {_sign(condition.provided, wish)} then {sign}"
    return sign
