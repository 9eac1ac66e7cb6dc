"""Measures steps per second of N environments: the vector environment against Gymnasium's own two.

    python bench_gym.py [ENVIRONMENTS] [TWIN]

All three drive in sessions of one server, in turn, three times each; the best of each counts, because other programs
only add time.
"""

import sys
import time
from typing import Any

import gymnasium
import numpy as np
import wildcity
from wildcity.gym import DriveEnv, DriveVectorEnv

STEPS = 20
ROUNDS = 3


def main(count: int, twin: str) -> None:
    with wildcity.serve() as server:
        arguments: dict[str, Any] = {"server": server.url, "twin": twin, "size": (96, 60), "horizon": 10_000}
        makers = [lambda: DriveEnv(**arguments)] * count
        kinds: dict[str, gymnasium.vector.VectorEnv[Any, Any, Any]] = {
            "DriveVectorEnv": DriveVectorEnv(count, **arguments),
            "AsyncVectorEnv": gymnasium.vector.AsyncVectorEnv(makers),
            "SyncVectorEnv": gymnasium.vector.SyncVectorEnv(makers),
        }
        best = dict.fromkeys(kinds, 0.0)
        for envs in kinds.values():
            envs.reset(seed=1)
        for _ in range(ROUNDS):
            for name, envs in kinds.items():
                best[name] = max(best[name], steps_per_s(envs))
        for name, envs in kinds.items():
            print(f"{name:16} {best[name]:7.1f} steps/s with {count} environments")
            envs.close()


def steps_per_s(envs: "gymnasium.vector.VectorEnv[Any, Any, Any]") -> float:
    actions = np.zeros((envs.num_envs, 2), np.float32)
    began = time.perf_counter()
    for _ in range(STEPS):
        envs.step(actions)
    return STEPS * envs.num_envs / (time.perf_counter() - began)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 8, sys.argv[2] if len(sys.argv) > 2 else "demo")
