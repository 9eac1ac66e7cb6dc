"""Trains a policy with Stable-Baselines3 to follow a recorded drive from small images.

    pip install './clients/python[gym]' stable-baselines3
    python train.py [STEPS] [TWIN]

Prints the mean return of 5 episodes, from the same 5 places, before and after the training.
"""

import sys
from typing import Any

import gymnasium
import wildcity
import wildcity.gym  # registers the environment
from stable_baselines3 import PPO


def main(steps: int, twin: str) -> None:
    arguments: dict[str, Any] = {"twin": twin, "size": (48, 36), "horizon": 60, "speed": 5.0, "off_route_m": 2.0}
    with wildcity.serve() as server:
        env = gymnasium.make("wildcity/Drive-v0", server=server.url, **arguments)
        model = PPO("MultiInputPolicy", env, n_steps=256, batch_size=64, learning_rate=1e-3, seed=1, device="cpu")
        before = mean_return(model, env)
        model.learn(steps)
        after = mean_return(model, env)
        env.close()
    print(f"mean return of 5 episodes: {before:.1f} before, {after:.1f} after {steps} steps")


def mean_return(model: PPO, env: "gymnasium.Env[Any, Any]") -> float:
    total = 0.0
    for seed in range(100, 105):
        seen, _ = env.reset(seed=seed)
        ended = False
        while not ended:
            action, _ = model.predict(seen, deterministic=True)
            seen, reward, terminated, truncated, _ = env.step(action)
            total += float(reward)
            ended = terminated or truncated
    return total / 5


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2_000, sys.argv[2] if len(sys.argv) > 2 else "demo")
