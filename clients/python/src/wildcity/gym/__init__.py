"""Gymnasium environments: `wildcity/Drive-v0`, and N of them in sessions of one server.

    import gymnasium
    import wildcity.gym

    env = gymnasium.make("wildcity/Drive-v0", twin="demo")
    envs = gymnasium.make_vec("wildcity/Drive-v0", num_envs=8, vectorization_mode="vector_entry_point", twin="demo")

The arguments are those of `DriveConfig`. Needs `pip install wildcity[gym]`.
"""

import gymnasium

from .env import DriveEnv
from .route import Route
from .task import DriveConfig, DriveState, Reward
from .vector import DriveVectorEnv

__all__ = ["DriveConfig", "DriveEnv", "DriveState", "DriveVectorEnv", "Reward", "Route"]

gymnasium.register(
    "wildcity/Drive-v0",
    entry_point="wildcity.gym.env:DriveEnv",
    vector_entry_point="wildcity.gym.vector:DriveVectorEnv",
)
