"""Labels and answers of reward requests over HTTP."""

import pytest

from embomatrix.rpc.reward_label import answer_in
from embomatrix.rpc.status import InvalidRequestError


@pytest.mark.parametrize(
    ("query", "prompt", "answer"),
    [("<s>Tidy up. move 1", "Tidy up.", " move 1"), ("move 1", "", "move 1"), ("", "", "")],
)
def test_answer_is_the_text_after_the_prompt(query, prompt, answer):
    assert answer_in(query, prompt) == answer


def test_query_without_its_prompt_is_refused():
    with pytest.raises(InvalidRequestError, match="send both unchanged"):
        answer_in("move 1", "Tidy up.")
