"""Adapter for verl: an agent loop that plays episodes, call by call. Its rows are those of ``adapters.rows.verl_rows``.

verl finds it by a file of agent loops, which also has its settings: `docs/examples/verl_episodes.yaml`. Episodes run in the
process of verl's agent loop workers, or on the cluster that ``EMBOMATRIX_MANAGER`` names.
"""

import time
import uuid
from typing import Any

try:
    from verl.experimental.agent_loop.agent_loop import AgentLoopBase, AgentLoopMetrics, AgentLoopOutput
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"embomatrix.envs.verl needs the package {error.name}: pip install 'verl>=0.9.1'",
        name=error.name,
    ) from None

from embomatrix.envs.rules import Visibility
from embomatrix.envs.shared import in_thread, shared_environment
from embomatrix.skills.seeds import split_seed
from embomatrix.skills.syntax import MAX_STEPS


class EpisodeAgentLoop(AgentLoopBase):
    """Plays the task of a row. The model answers with one call, is told what the robot observes, and answers again.

    Tokens are appended and never encoded anew; the mask is 1 on those that the model sampled. The reward is the episode's, and
    its tiers, success, calls and failed calls are logged beside it. ``dataset``: ``starter``, ``search`` or a folder;
    ``visibility``: full or seen; ``calls``: budget of an episode; ``seed``: that of the simulation, drawn anew for each task.
    """

    def __init__(
        self,
        *arguments: Any,
        dataset: str,
        visibility: str = Visibility.SEEN.value,
        calls: int = MAX_STEPS,
        seed: int = 0,
        **named: Any,
    ) -> None:
        super().__init__(*arguments, **named)
        self._dataset, self._visibility, self._calls, self._seed = dataset, visibility, calls, seed
        self._longest = self.rollout_config.response_length

    async def run(self, sampling_params: dict[str, Any], **row: Any) -> AgentLoopOutput:
        """Play an episode. Raises what executing a turn raises: verl has no mark for a rollout without a result."""
        task_id, split = str(row["reward_model"]["ground_truth"]), str(row["extra_info"]["split"])
        environment = await in_thread(shared_environment, self._dataset, split, self._visibility, self._calls)
        (episode,) = await in_thread(environment.begin, [(task_id, split_seed(split, self._seed, task_id))])
        messages = [
            {"role": "system", "content": episode.prompt.system},
            {"role": "user", "content": episode.prompt.user},
        ]
        tokens = await self.ct_build_initial_tokens(messages)
        mask: list[int] = []
        logprobs: list[float] | None = []
        request, metrics, turns = uuid.uuid4().hex, AgentLoopMetrics(), 0
        while True:
            began_s = time.monotonic()
            answer = await self.server_manager.generate(
                request_id=request, prompt_ids=tokens, sampling_params=sampling_params
            )
            sampled_s = time.monotonic()
            metrics.generate_sequences += sampled_s - began_s
            merged, mask, logprobs = await self.ct_merge_assistant_token(
                tokens,
                answer.token_ids,
                mask,
                logprobs if logprobs or answer.log_probs else None,
                assistant_logprobs=answer.log_probs or None,
            )
            tokens, turns = merged.token_ids, turns + 1
            text = self.tokenizer.decode(answer.token_ids, skip_special_tokens=True)
            if len(mask) > self._longest:
                break  # the answer is cut off, and so are the gradients of what it would do
            (observation,) = await in_thread(environment.answer, [episode], [text])
            metrics.tool_calls += time.monotonic() - sampled_s
            if observation.end is not None or len(mask) == self._longest:
                break
            told = [*messages, {"role": "assistant", "content": text}]
            messages = [*told, {"role": "user", "content": observation.text}]
            merged, mask, logprobs = await self.ct_merge_context_msg(told, messages, tokens, mask, logprobs)
            tokens = merged.token_ids
            if len(mask) >= self._longest:
                break
        reward, sampled = episode.player.reward, len(tokens) - len(mask)
        return AgentLoopOutput(
            prompt_ids=tokens[:sampled],
            response_ids=tokens[sampled:][: self._longest],
            response_mask=mask[: self._longest],
            response_logprobs=logprobs[: self._longest] if logprobs else None,
            reward_score=reward.total,
            num_turns=2 * turns,
            metrics=metrics,
            extra_fields={
                **answer.extra_fields,
                "turn_scores": [],
                "tool_rewards": [],
                "reward_extra_info": {**reward.tiers.tiers, **reward.metrics},
            },
        )
