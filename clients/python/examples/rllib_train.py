"""Trains a policy with RLlib to follow a recorded drive from small images.

    pip install './clients/python[gym]' 'ray[rllib]' torch
    python rllib_train.py [STEPS] [TWIN]

RLlib has no default network for images beside numbers, so `Policy` is one. Each of the two workers has an environment
of its own, and both use one server. Prints the mean return of the episodes that have ended, once an iteration.
"""

import sys
from typing import Any

import ray
import torch
import wildcity
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import ValueFunctionAPI
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.tune.registry import register_env
from torch import nn
from wildcity.gym import DriveEnv


class Policy(TorchRLModule, ValueFunctionAPI):
    """Mean and deviation of acceleration and curvature, and the value, of the images, the speed and the route."""

    def setup(self) -> None:
        space = self.observation_space
        self.images = [key for key in space if key.startswith("image_")]
        self.encoder = nn.Sequential(
            nn.Conv2d(3 * len(self.images), 16, 5, stride=2), nn.ReLU(),
            nn.Conv2d(16, 32, 3, stride=2), nn.ReLU(),
            nn.Conv2d(32, 32, 3, stride=2), nn.ReLU(),
            nn.Flatten(), nn.LazyLinear(128), nn.ReLU(),
        )  # fmt: skip
        self.trunk = nn.Sequential(nn.LazyLinear(128), nn.ReLU())
        self.mean = nn.Linear(128, 2)
        self.value = nn.Linear(128, 1)
        self.ln_deviation = nn.Parameter(torch.full((2,), -0.7))
        # The sizes of lazy layers are those of a first batch.
        self.features({key: torch.zeros(1, *space[key].shape) for key in space})

    def features(self, seen: dict[str, Any]) -> Any:
        images = torch.cat([seen[key] for key in self.images], -1).float().movedim(-1, 1) / 255
        numbers = [seen["speed"] / 10, seen["route"].flatten(1) / 50]
        return self.trunk(torch.cat([self.encoder(images), *numbers], 1))

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        features = self.features(batch[Columns.OBS])
        mean = self.mean(features)
        return {
            Columns.ACTION_DIST_INPUTS: torch.cat([mean, self.ln_deviation.expand_as(mean)], 1),
            Columns.EMBEDDINGS: features,
        }

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        features = self.features(batch[Columns.OBS]) if embeddings is None else embeddings
        return self.value(features).squeeze(-1)


def main(steps: int, twin: str) -> None:
    register_env("wildcity", lambda config: DriveEnv(**config))
    ray.init(include_dashboard=False, log_to_driver=False)
    with wildcity.serve() as server:
        arguments = {"server": server.url, "twin": twin, "size": (48, 36), "horizon": 60, "off_route_m": 2.0}
        config = PPOConfig().environment("wildcity", env_config=arguments)
        config.env_runners(num_env_runners=2, num_cpus_per_env_runner=0.25, rollout_fragment_length=64)
        config.training(train_batch_size_per_learner=256, minibatch_size=64, num_epochs=4, lr=1e-3)
        config.rl_module(rl_module_spec=RLModuleSpec(module_class=Policy))
        config.debugging(seed=1)
        algorithm = config.build_algo()
        done = 0
        while done < steps:
            result = algorithm.train()["env_runners"]
            done = int(result["num_env_steps_sampled_lifetime"])
            print(f"{done} steps: mean return {result.get('episode_return_mean', float('nan')):.1f}", flush=True)
        algorithm.stop()
    ray.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2_000, sys.argv[2] if len(sys.argv) > 2 else "demo")
