"""Stable-Baselines3 trains on `wildcity/Drive-v0` as it is. It needs PyTorch, so that the gate does not install it."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import wildcity.gym
from test_end_to_end import PAIR, Server, server

pytest.importorskip("stable_baselines3", reason="pip install stable-baselines3, which needs PyTorch")

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor

STEPS = 2_000


def test_the_return_of_ppo_rises(server: Server) -> None:
    """Keeping the lane: an episode ends 0.5 m beside the drive, and untrained steering leaves it soon."""
    # The images are small; more threads only wait for each other.
    torch.set_num_threads(1)
    made = gymnasium.make(
        "wildcity/Drive-v0",
        server=server.url,
        twin="corridor",
        rig=PAIR,
        size=(48, 36),
        horizon=30,
        speed=5.0,
        dynamics="kinematic",
        off_route_m=0.5,
        start_m=(0.0, 1.0),
    )
    env = Monitor(made)
    model = PPO(
        "MultiInputPolicy", env, n_steps=128, batch_size=64, learning_rate=1e-3, gamma=0.9, seed=1, device="cpu"
    )
    model.learn(STEPS)
    env.close()
    returns = np.array(env.get_episode_rewards())
    quarter = len(returns) // 4
    first, last = returns[:quarter].mean(), returns[-quarter:].mean()
    print(f"{len(returns)} episodes, mean return {first:.2f} in the first quarter and {last:.2f} in the last")
    assert last > 1.2 * first
