#!/usr/bin/env python3
"""Runs the test executables that cargo has built, and other commands, two at a time.

    cargo test --no-run --message-format=json-render-diagnostics >MESSAGES
    .ci/run_tests.py MESSAGES [NAME FOLDER COMMAND]...

One after the other, as `cargo test` runs them, they leave a quarter of two cores unused: some wait for disks, sockets
and time limits while others compute. Each runs in the folder of its package, as under cargo. What one prints appears
when it has ended. All run, whatever fails.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

# These compare times of a few milliseconds, and run before the others, one after the other.
ALONE = ["suite", "session"]
# These take longest, and begin first. One that computes stands before one that waits.
LONG = ["gpu", "command_line", "Python client", "stress", "store", "viewer", "render"]
AT_ONCE = 2
# Several times what the longest takes. One that takes longer is stopped, and has failed.
LIMIT_S = 1800


class Job(NamedTuple):
    name: str
    folder: str
    command: list[str]


def tests(messages: Path) -> list[Job]:
    """The test executables of all packages, unit tests among them."""
    jobs = []
    for line in messages.read_text().splitlines():
        message = json.loads(line)
        if message.get("reason") == "compiler-artifact" and message["executable"] and message["profile"]["test"]:
            folder = os.path.dirname(message["manifest_path"])
            kind = message["target"]["kind"][0]
            name = message["target"]["name"] if kind == "test" else f"{message['target']['name']} ({kind})"
            jobs.append(Job(name, folder, [message["executable"]]))
    return jobs


def run(job: Job) -> tuple[bool, float]:
    began = time.monotonic()
    with PRINTS:
        print(f"-- {job.name} begins", flush=True)
    with tempfile.TemporaryFile() as output:
        environment = {**os.environ, "CARGO_MANIFEST_DIR": job.folder}
        # Its own process group: what it has started is stopped with it.
        with STARTS:
            if STOPPED.is_set():
                return False, 0.0
            process = subprocess.Popen(
                job.command,
                cwd=job.folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            RUNNING.add(process)
        try:
            ended = f"exit status {process.wait(LIMIT_S)}"
        except subprocess.TimeoutExpired:
            stop(process)
            ended = f"stopped after {LIMIT_S} s"
        RUNNING.discard(process)
        took_s = time.monotonic() - began
        output.seek(0)
        said = output.read().decode(errors="replace")
    with PRINTS:
        print(f"\n== {job.name}: {took_s:.0f} s, {ended}\n{said}", flush=True)
    return process.returncode == 0, took_s


def stop(process: "subprocess.Popen[bytes]") -> None:
    # It may have ended meanwhile.
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


PRINTS = threading.Lock()
STOPPED = threading.Event()
STARTS = threading.Lock()
"""What is started while this is held is in `RUNNING`, and nothing is once the runner has stopped."""
RUNNING: "set[subprocess.Popen[bytes]]" = set()


def main() -> None:
    messages, *others = sys.argv[1:]
    jobs = tests(Path(messages))
    if not jobs:
        sys.exit(f"{messages} names no test executable")
    jobs += [
        Job(name, folder, ["bash", "-c", command]) for name, folder, command in zip(*[iter(others)] * 3, strict=True)
    ]
    names = [job.name for job in jobs]
    if unknown := [name for name in ALONE + LONG if name not in names and name not in ("Python client", "viewer")]:
        sys.exit(f".ci/run_tests.py: no test is called {', '.join(unknown)}")

    # Each, until it has passed: also one that could not be started.
    failed = list(jobs)
    times: list[tuple[float, str]] = []

    def finish(job: Job) -> None:
        passed, took_s = run(job)
        times.append((took_s, job.name))
        if passed:
            failed.remove(job)

    for job in jobs:
        if job.name in ALONE:
            finish(job)
    waiting = [job for job in jobs if job.name not in ALONE]
    waiting.sort(key=lambda job: LONG.index(job.name) if job.name in LONG else len(LONG))
    queue = iter(waiting)
    takes = threading.Lock()

    def work() -> None:
        while True:
            with takes:
                job = next(queue, None)
            if job is None or STOPPED.is_set():
                return
            finish(job)

    # An interruption ends this thread, and with it the others.
    threads = [threading.Thread(target=work, daemon=True) for _ in range(AT_ONCE)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    print("\n== times of tests")
    for took_s, name in sorted(times, reverse=True):
        if took_s >= 1.0:
            print(f"{took_s:6.0f} s  {name}")
    print(f"{len(jobs) - len(failed)} of {len(jobs)} passed")
    if failed:
        sys.exit(f"failed: {', '.join(job.name for job in failed)}")


signal.signal(signal.SIGTERM, lambda *_: sys.exit("stopped"))
try:
    main()
finally:
    with STARTS:
        STOPPED.set()
    for left in list(RUNNING):
        stop(left)
