"""Train with TRL's GRPO and rewards from a cluster: python train_with_trl.py DATASET MODEL OUT [--steps N]

EMBOMATRIX_MANAGER, EMBOMATRIX_TOKEN and EMBOMATRIX_CA give the cluster's address, token and CA certificate.
"""

import argparse

from datasets import Dataset
from trl import GRPOConfig, GRPOTrainer

from embomatrix.trainer.adapters.rows import prompt_rows
from embomatrix.trainer.adapters.trl import ClusterLookahead, ClusterReward


class Trainer(ClusterLookahead, GRPOTrainer):
    """GRPO trainer that announces the tasks of the next three generations to the cluster."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("dataset")
    parser.add_argument("model")
    parser.add_argument("out")
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--group", type=int, default=8)
    parser.add_argument("--tokens", type=int, default=1024)
    parser.add_argument("--cpu", action="store_true")
    chosen = parser.parse_args()

    trainer = Trainer(
        model=chosen.model,
        reward_funcs=[ClusterReward.at(chosen.dataset)],
        args=GRPOConfig(
            output_dir=chosen.out,
            max_steps=chosen.steps,
            per_device_train_batch_size=2 * chosen.group,
            num_generations=chosen.group,
            max_completion_length=chosen.tokens,
            loss_type="dapo",
            epsilon_high=0.28,
            logging_steps=1,
            report_to="none",
            use_cpu=chosen.cpu,
            bf16=not chosen.cpu,
        ),
        train_dataset=Dataset.from_list(prompt_rows(chosen.dataset)),
    )
    trainer.train()
    trainer.save_model()
    trainer.save_state()


if __name__ == "__main__":
    main()
