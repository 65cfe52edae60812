"""Train with TRL's GRPO in episodes on a cluster: python train_with_trl_episodes.py DATASET MODEL OUT [--steps N]

The model calls skills as tools and is told what happened. Its chat template must know tools, as Qwen3's does.
EMBOMATRIX_MANAGER, EMBOMATRIX_TOKEN and EMBOMATRIX_CA give the cluster's address, token and CA certificate.
"""

import argparse

from datasets import Dataset
from trl import GRPOConfig, GRPOTrainer

from embomatrix.trainer.adapters.trl import ClusterLookahead
from embomatrix.trainer.adapters.trl_episodes import ClusterEpisodes


class Trainer(ClusterLookahead, GRPOTrainer):
    """GRPO trainer that announces the tasks of the next three generations to the cluster."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("dataset")
    parser.add_argument("model")
    parser.add_argument("out")
    parser.add_argument("--visibility", default="seen", choices=["full", "seen"])
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--group", type=int, default=8)
    parser.add_argument("--calls", type=int, default=40)
    parser.add_argument("--tokens", type=int, default=8192)
    parser.add_argument("--cpu", action="store_true")
    chosen = parser.parse_args()

    episodes = ClusterEpisodes.at(chosen.dataset, visibility=chosen.visibility)
    trainer = Trainer(
        model=chosen.model,
        environment_factory=episodes.factories,
        reward_funcs=[episodes],
        args=GRPOConfig(
            output_dir=chosen.out,
            max_steps=chosen.steps,
            per_device_train_batch_size=2 * chosen.group,
            num_generations=chosen.group,
            max_completion_length=chosen.tokens,
            max_tool_calling_iterations=chosen.calls,
            loss_type="dapo",
            epsilon_high=0.28,
            logging_steps=1,
            report_to="none",
            use_cpu=chosen.cpu,
            bf16=not chosen.cpu,
        ),
        train_dataset=Dataset.from_list(episodes.rows()),
    )
    trainer.train()
    trainer.save_model()
    trainer.save_state()
    episodes.close()


if __name__ == "__main__":
    main()
