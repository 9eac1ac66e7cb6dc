"""Trains a policy with Stable-Baselines3 to follow a recorded drive from small images.

    pip install './clients/python[gym]' stable-baselines3
    python train.py [STEPS] [TWIN]

Prints the mean return of 5 episodes before and after the training.
"""

import sys
from typing import Any

import gymnasium
import numpy as np
import wildcity
import wildcity.gym  # registers the environment
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy


def main(steps: int, twin: str) -> None:
    arguments: dict[str, Any] = {"twin": twin, "size": (48, 36), "horizon": 60, "speed": 5.0, "off_route_m": 2.0}
    with wildcity.serve() as server:
        env = gymnasium.make("wildcity/Drive-v0", server=server.url, **arguments)
        model = PPO("MultiInputPolicy", env, n_steps=256, batch_size=64, learning_rate=1e-3, seed=1, device="cpu")
        before, _ = evaluate_policy(model, env, n_eval_episodes=5, warn=False)
        model.learn(steps)
        after, _ = evaluate_policy(model, env, n_eval_episodes=5, warn=False)
        env.close()
    print(f"mean return of 5 episodes: {np.mean(before):.1f} before, {np.mean(after):.1f} after {steps} steps")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2_000, sys.argv[2] if len(sys.argv) > 2 else "demo")
