"""Drives one episode in each of several Ray actors, which share a server or own one each.

    pip install './clients/python[gym]' 'ray[default]'
    python ray_drive.py [ACTORS] [TWIN]

Prints the hash of all frames of each actor: with the same seed they are equal. On a machine with GPUs, `num_gpus=1`
gives each actor a GPU and a server of its own. For RLlib see rllib_train.py.
"""

import contextlib
import hashlib
import sys
from typing import Any

import ray
import wildcity
from wildcity.gym import DriveEnv


class Driver:
    """An environment of a server, or a server of its own if no address is given."""

    def __init__(self, twin: str, server: str | None) -> None:
        self._own = contextlib.ExitStack()
        address = server or self._own.enter_context(wildcity.serve()).url
        self._env = DriveEnv(server=address, twin=twin, size=(96, 60), horizon=20)

    def drive(self, seed: int) -> str:
        """Drives straight on for 20 steps, and returns a hash of all frames."""
        _, info = self._env.reset(seed=seed)
        frames = hashlib.sha256(info["frame_hash"].encode())
        for _ in range(20):
            _, _, terminated, truncated, info = self._env.step([0.0, 0.0])
            frames.update(info["frame_hash"].encode())
            if terminated or truncated:
                break
        return frames.hexdigest()

    def close(self) -> None:
        """Ends the session, and the server if it is this actor's own."""
        self._env.close()
        self._own.close()


def main(actors: int, twin: str) -> None:
    ray.init(include_dashboard=False, log_to_driver=False)
    actor: Any = ray.remote(num_cpus=0.25)(Driver)
    with wildcity.serve() as server:
        drivers = [actor.remote(twin, server.url) for _ in range(actors)]
        hashes = ray.get([driver.drive.remote(7) for driver in drivers])
        ray.get([driver.close.remote() for driver in drivers])
    for frames in hashes:
        print(frames)
    assert len(set(hashes)) == 1, "the same seed gave other frames"
    ray.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 4, sys.argv[2] if len(sys.argv) > 2 else "demo")
