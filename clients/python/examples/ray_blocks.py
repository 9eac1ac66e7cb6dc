"""Trains the blocks of a twin as Ray tasks, on as many machines as the cluster has.

    pip install ./clients/python 'ray[default]'
    wildcity train LOG --out coarse.ply --twin TWIN --size 0.25 --cap 500000
    python ray_blocks.py TWIN@1 LOG BLOCKS [OPTION..]

Each task runs `wildcity train block TWIN@1 --block I/BLOCKS` on its own part of the route, with the options that
follow, and publishes its cells. A task that fails, or whose machine is lost, is tried again and goes on from its last
checkpoint. The log, the twins (`--twins`, a folder or an object store) and the working directory are shared.
`WILDCITY_CORES_PER_BLOCK=8` gives each block eight cores (1 without it), and `WILDCITY_GPUS_PER_BLOCK=1` a GPU.

A block makes a new version of the twin when it ends; after the last block the twin is the same in any order.
"""

import os
import subprocess
import sys

import ray
from wildcity.serving import binary

CORES_PER_BLOCK = int(os.environ.get("WILDCITY_CORES_PER_BLOCK", "1"))
GPUS_PER_BLOCK = float(os.environ.get("WILDCITY_GPUS_PER_BLOCK", "0"))


def train_block(twin: str, log: str, block: str, options: list[str]) -> str:
    """Trains one block, and returns what the program says about it."""
    checkpoint = f"{twin.replace('@', '-')}-block-{block.replace('/', '-of-')}.checkpoint"
    command = [str(binary()), "train", "block", twin, "--images", log, "--block", block, "--checkpoint", checkpoint]
    # A block has the cores and the GPU of its task.
    command += ["--threads", str(CORES_PER_BLOCK)]
    if GPUS_PER_BLOCK > 0:
        command += ["--device", str(ray.get_gpu_ids()[0])]
    done = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"block {block}: {done.stderr.strip()}")
    return done.stdout.strip()


def main(twin: str, log: str, blocks: int, options: list[str]) -> None:
    if "@" not in twin:
        raise SystemExit(f"give the version of the coarse twin, for example {twin}@1: all blocks begin from the same")
    ray.init(include_dashboard=False, log_to_driver=False)
    task = ray.remote(max_retries=3, retry_exceptions=True)(train_block)
    task = task.options(num_cpus=CORES_PER_BLOCK, num_gpus=GPUS_PER_BLOCK)
    pending = {task.remote(twin, log, f"{k}/{blocks}", options): k for k in range(1, blocks + 1)}
    while pending:
        [done], _ = ray.wait(list(pending), num_returns=1)
        print(f"block {pending.pop(done)}/{blocks}\n{ray.get(done)}", flush=True)
    ray.shutdown()


if __name__ == "__main__":
    if len(sys.argv) < 4:
        raise SystemExit(__doc__)
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), sys.argv[4:])
